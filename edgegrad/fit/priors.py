"""Priors for fit_rig(): terms of its loss for what the pictures leave open.

Each is a function of a rig's values by name, rotations as rotation vectors. Weights are relative to the loss at full size, a
mean square difference of pictures in 0 … 1; fit_rig() raises them on coarse levels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

__all__ = ["mirrored", "near", "towards"]

Prior = Callable[[Mapping[str, Tensor]], Tensor]
PLACE = ("translation", "orientation", "scale")


def checked_priors(priors: Sequence[Prior], values: Mapping[str, Tensor]) -> list[Prior]:
    """Check that each returns one number for such values. Raises TypeError or ValueError."""
    if not isinstance(priors, Sequence) or isinstance(priors, str):
        raise TypeError(f"priors: expected a list of functions of values, got {type(priors).__name__}")
    for k, term in enumerate(priors):
        if not callable(term):
            raise TypeError(
                f"priors[{k}]: expected a function of values, as towards() makes one, got {type(term).__name__}"
            )
        given = term(values)
        if not isinstance(given, Tensor | float | int) or (isinstance(given, Tensor) and given.dim()):
            got = tuple(given.shape) if isinstance(given, Tensor) else type(given).__name__
            raise ValueError(f"priors[{k}]: expected it to return a number, got {got}; add up its terms")
    return list(priors)


def towards(rest: Mapping[str, Tensor], weight: float = 1e-6) -> Prior:
    """Return the prior weight · Σ (x − rest)² over all values but translation, orientation and scale.

    Parameters
    ----------
    rest, weight : mapping of names to Tensor, rotations in radians, and float, default 1e-6
    """

    return _squares({name: value for name, value in rest.items() if name not in PLACE}, weight)


def mirrored(
    name: str, pairs: Sequence[tuple[int, int]], signs: Sequence[float] = (1.0, -1.0, -1.0), weight: float = 1e-6
) -> Prior:
    """Return the prior weight · Σ |x_left − s x_right|² over pairs of rows of a control.

    Parameters
    ----------
    name, pairs : name of the control, and sequence of (left, right) places of rows
    signs : sequence of float, default (1, −1, −1)
        The signs s mirror rotation vectors at x = 0 if the joints' own axes are the world's.
    weight : float, default 1e-6
    """

    def prior(values: Mapping[str, Tensor]) -> Tensor:
        value = values[name]
        left, right = value[[a for a, _ in pairs]], value[[b for _, b in pairs]]
        return weight * (left - right * value.new_tensor(list(signs))).square().sum()

    return prior


def near(before: Mapping[str, Tensor], weight: float = 1e-5) -> Prior:
    """Return the prior weight · Σ (x − before)² over all values, which makes a sequence smooth.

    Parameters
    ----------
    before, weight : pose of the last frame, or its extrapolation, by names, and float, default 1e-5

    Examples
    --------
    >>> import torch, edgegrad as eg
    >>> prior = eg.fit.priors.near({"angles": torch.zeros(2)}, weight=0.5)
    >>> prior({"angles": torch.tensor([1.0, 2.0])})
    tensor(2.5000)
    """

    return _squares(before, weight)


def _squares(reference: Mapping[str, Tensor], weight: float) -> Prior:
    """Return weight · Σ (x − reference)² over the values that have one."""

    def prior(values: Mapping[str, Tensor]) -> Tensor:
        parts = [(x - reference[name].to(x)).square().sum() for name, x in values.items() if name in reference]
        return weight * torch.stack(parts).sum() if parts else torch.zeros((), dtype=torch.float64)

    return prior
