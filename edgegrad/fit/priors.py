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
    """Return the prior weight · Σ (x − rest)² over all values but PLACE; rotations are in radians."""

    def prior(values: Mapping[str, Tensor]) -> Tensor:
        total = torch.zeros((), dtype=torch.float64)
        for name, value in values.items():
            if name not in PLACE:
                total = total + (value - rest[name].to(value)).square().sum()
        return weight * total

    return prior


def mirrored(
    name: str, pairs: Sequence[tuple[int, int]], signs: Sequence[float] = (1.0, -1.0, -1.0), weight: float = 1e-6
) -> Prior:
    """Return the prior weight · Σ |x_left − s x_right|² over pairs of rows of a control. The signs s mirror rotation vectors at
    x = 0 if the joints' own axes are the world's."""

    def prior(values: Mapping[str, Tensor]) -> Tensor:
        value = values[name]
        left, right = value[[a for a, _ in pairs]], value[[b for _, b in pairs]]
        return weight * (left - right * value.new_tensor(list(signs))).square().sum()

    return prior


def near(before: Mapping[str, Tensor], weight: float = 1e-5) -> Prior:
    """Return the prior weight · Σ (x − before)² over all values. It makes a sequence smooth if `before` is the pose of the last
    frame, or its extrapolation."""

    def prior(values: Mapping[str, Tensor]) -> Tensor:
        parts = [(value - before[name].to(value)).square().sum() for name, value in values.items() if name in before]
        return weight * torch.stack(parts).sum() if parts else torch.zeros((), dtype=torch.float64)

    return prior
