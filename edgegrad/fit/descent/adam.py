"""Adam (Kingma and Ba 2015), with one step size for coordinates that belong together.

Not a torch.optim.Optimizer: the first of these in a process imports torch's compiler, for some three seconds.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import torch
from torch import Tensor


class Adam:
    """Steps of tensors by name, each at its rate. Those of names in `uniform` are divided by the largest second moment instead of
    each number's by its own: then a smooth gradient gives a smooth step (Nicolet, Jacobson and Jakob 2021)."""

    def __init__(
        self, values: Mapping[str, Tensor], rates: Mapping[str, float], uniform: Collection[str] = (),
        betas: tuple[float, float] = (0.9, 0.999),
    ) -> None:  # fmt: skip
        self.values, self.rates, self.uniform, self.betas = values, dict(rates), uniform, betas
        # Of the gradients so far: how many, their mean, and that of their squares.
        self._moments: dict[str, dict[str, Any]] = {}

    @torch.no_grad()
    def step(self, gradients: Mapping[str, Tensor | None]) -> None:
        """Those without a gradient stay."""
        b1, b2 = self.betas
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
            # Relative to the largest, for losses have any units.
            floor = 1e-8 * float(size.max()) + 1e-30
            value.sub_(self.rates[name] / (1.0 - b1 ** state["count"]) * state["mean"] / (size + floor))

    def shorten(self, factor: float) -> None:
        """All steps from here on."""
        self.rates = {name: rate * factor for name, rate in self.rates.items()}

    def forget(self) -> None:
        """The gradients so far."""
        self._moments.clear()

    def state(self) -> dict[str, Any]:
        """What it keeps between steps, beside the values."""
        return {"rates": self.rates, "moments": self._moments}

    def load(self, state: Mapping[str, Any]) -> None:
        self.rates, self._moments = dict(state["rates"]), dict(state["moments"])
