"""Adam (Kingma and Ba 2015), optionally with one step size for all numbers of a tensor.

It is no torch.optim.Optimizer: the first of these in a process imports torch's compiler, which takes some three seconds.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import torch
from torch import Tensor

BETAS = 0.9, 0.999  # decay of the means of gradients and of their squares


class Adam:
    """Steps of named tensors, each with a learning rate of its own. Tensors named in `uniform` are divided by their largest
    second moment instead of each number's own. A smooth gradient then gives a smooth step (Nicolet, Jacobson and Jakob
    2021)."""

    def __init__(self, values: Mapping[str, Tensor], rates: Mapping[str, float], uniform: Collection[str] = ()) -> None:
        self.values, self.rates, self.uniform = values, dict(rates), uniform
        # How many gradients there were, their mean, and that of their squares.
        self._moments: dict[str, dict[str, Any]] = {}

    @torch.no_grad()
    def step(self, gradients: Mapping[str, Tensor | None]) -> None:
        """Change the values in place; those without a gradient stay."""
        b1, b2 = BETAS
        for name, gradient in gradients.items():
            if gradient is None:
                continue
            value = self.values[name]
            if name not in self._moments:
                self._moments[name] = {"count": 0, "mean": torch.zeros_like(value), "square": torch.zeros_like(value)}
            state = self._moments[name]
            state["count"] += 1
            state["mean"].lerp_(gradient, 1.0 - b1)
            state["square"].lerp_(gradient.square(), 1.0 - b2)
            size = (state["square"] / (1.0 - b2 ** state["count"])).sqrt()
            size = size.max() if name in self.uniform else size
            # ε is relative to the largest, for losses have any units.
            epsilon = 1e-8 * float(size.max()) + 1e-30
            value.sub_(self.rates[name] / (1.0 - b1 ** state["count"]) * state["mean"] / (size + epsilon))

    def shorten(self, factor: float) -> None:
        """Multiply all learning rates."""
        self.rates = {name: rate * factor for name, rate in self.rates.items()}

    def forget(self) -> None:
        """Drop the moments of the gradients so far."""
        self._moments.clear()

    def state(self) -> dict[str, Any]:
        """Return what steps depend on besides the values."""
        return {"rates": self.rates, "moments": self._moments}

    def load(self, state: Mapping[str, Any]) -> None:
        self.rates, self._moments = dict(state["rates"]), dict(state["moments"])
