"""Tensors that a descent finds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..check import as_tensor, check_finite, check_flag, check_float, check_positive


@dataclass(frozen=True)
class Parameter:
    """A tensor to find, and how it moves.

    Parameters
    ----------
    lr : float
        Learning rate: about how far each number moves in a step, in its own units.
    value : Tensor, optional
        Where the fit starts. By default it is the scene's tensor of this name.
    low, high : float or Tensor, optional
        Bounds, numbers or tensors that broadcast. By default there are none.
    uniform : bool, default False
        Whether all numbers of the tensor have one step size, as coordinates of one surface need, and not each its own.
    """

    lr: float
    value: Tensor | None = None
    low: float | Tensor | None = None
    high: float | Tensor | None = None
    uniform: bool = False

    def checked(self, name: str) -> Parameter:
        """Return a copy with a value of its own on the CPU. Raises TypeError or ValueError."""
        check_positive(f"{name}: lr", self.lr, least=0.0, most=1e30)
        if self.value is None:
            raise ValueError(f"{name}: expected a value to start from, got None; give Parameter(lr, value)")
        value = as_tensor(f"{name}: value", self.value, like=torch.empty(0, dtype=torch.float32)).detach().cpu().clone()
        check_float(name, value)
        check_finite(name, value)
        check_flag(f"{name}: uniform", self.uniform)
        low, high = (_bound(f"{name}: {end}", getattr(self, end), value) for end in ("low", "high"))
        if low is not None and high is not None and bool((low > high).any()):
            raise ValueError(f"{name}: expected low ≤ high, got {self.low} and {self.high}")
        found = replace(self, value=value, low=low, high=high)
        if not torch.equal(found.within(value), value):
            raise ValueError(
                f"{name}: expected a start within low and high, {self.low} and {self.high}, got {float(value.min()):g} to "
                f"{float(value.max()):g}; clamp it first"
            )
        return found

    def within(self, value: Tensor) -> Tensor:
        return value if self.low is None and self.high is None else value.clamp(self.low, self.high)  # type: ignore[arg-type]


def _bound(name: str, given: object, value: Tensor) -> Tensor | None:
    """Return a bound of a value as a tensor that broadcasts to it. Raises TypeError or ValueError."""
    if given is None:
        return None
    bound = as_tensor(name, given, like=value).detach().cpu().to(value.dtype)
    if bool(bound.isnan().any()):
        raise ValueError(f"{name}: expected a number, got NaN; leave it out where there is no bound")
    try:
        return bound.expand(value.shape)
    except RuntimeError:
        raise ValueError(
            f"{name}: expected a number or a shape that broadcasts to {tuple(value.shape)}, got shape {tuple(bound.shape)}"
        ) from None
