"""Descents by Adam (Kingma and Ba 2015), whose learning rates are cut where they lead no further.

Adam is no torch.optim.Optimizer: the first of these in a process imports torch's compiler, which takes some three seconds.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .convergence import Settling
from .parameter import Parameter
from .tensors import Objective, TensorDescent, detached, gradients_of

BETAS = 0.9, 0.999  # decay of the means of gradients and of their squares, as the paper has them


class Adam:
    """Steps of named tensors, each with a learning rate of its own. Tensors named in `uniform` are divided by their largest
    second moment instead of each number's own. A smooth gradient then gives a smooth step (Nicolet, Jacobson and Jakob
    2021)."""

    def __init__(self, values: Mapping[str, Tensor], rates: Mapping[str, float], uniform: Collection[str] = ()) -> None:
        self.values, self.rates, self.uniform = values, dict(rates), uniform
        # How many gradients there were, their mean, and that of their squares.
        self.moments: dict[str, dict[str, Any]] = {}

    @torch.no_grad()
    def step(self, gradients: Mapping[str, Tensor | None]) -> None:
        """Change the values in place; those without a gradient stay."""
        b1, b2 = BETAS
        for name, gradient in gradients.items():
            if gradient is None:
                continue
            value = self.values[name]
            if name not in self.moments:
                self.moments[name] = {"count": 0, "mean": torch.zeros_like(value), "square": torch.zeros_like(value)}
            state = self.moments[name]
            state["count"] += 1
            state["mean"].lerp_(gradient, 1.0 - b1)
            state["square"].lerp_(gradient.square(), 1.0 - b2)
            size = (state["square"] / (1.0 - b2 ** state["count"])).sqrt()
            size = size.max() if name in self.uniform else size
            # ε is relative to the largest, for losses have any units.
            epsilon = 1e-8 * float(size.max()) + 1e-30
            value.sub_(self.rates[name] / (1.0 - b1 ** state["count"]) * state["mean"] / (size + epsilon))

    def state(self) -> dict[str, Any]:
        """Return what steps depend on besides the values."""
        return {"rates": self.rates, "moments": self.moments}

    def load(self, state: Mapping[str, Any]) -> None:
        self.rates, self.moments = dict(state["rates"]), dict(state["moments"])


@dataclass(frozen=True)
class AdamSettings:
    """When learning rates are cut, and when a descent ends.

    Effects are those on six small fits of scenes (tests/fit/small_fits.py). They take 137 steps in the mean, and end 0.08 of
    the tolerated error off.
    """

    # Rates are cut where `patience` more steps would lower the loss by less than this share. 0: they never are.
    tolerance: float = 0.01
    patience: int = 40
    # Factor of the rates at a cut: 0.15 leaves 0.22 of the tolerated error, 0.6 leaves 0.06; steps are as many.
    cut: float = 0.3
    # Number of cuts before the end: one ends after 92 steps, 0.23 off, and six after 203, 0.06 off.
    cuts: int = 3
    # Means of the values over this part of the patience are compared. Halves take 220 steps, to 0.04 off; eighths end two of
    # the six too early, as Adam goes to and fro for longer.
    windows: int = 4
    # Rates are cut after so many means without a fall: one ends after 85 steps, 0.39 off, and four after 233, 0.04 off.
    settled_windows: int = 2
    # Standard deviations of its noise by which a loss must fall: four end after 127 steps, 0.23 off; one changes little.
    noise_deviations: float = 2.0


class AdamDescent(TensorDescent):
    """Descent by Adam. About a minimum steps go to and fro, so the result is a mean of the values since the loss last fell."""

    saved = (*TensorDescent.saved, "cuts", "good", "total", "summed", "mean", "means")

    def __init__(self, objective: Objective, parameters: Mapping[str, Parameter], settings: AdamSettings) -> None:
        super().__init__(objective, parameters)
        self.settings = settings
        rates = {name: p.lr for name, p in parameters.items()}
        self.adam = Adam(self.values, rates, {name for name, p in parameters.items() if p.uniform})
        self.settling = Settling()
        self.cuts = 0
        self.good = detached(self.values)  # where the loss last fell
        self.total: dict[str, Tensor] = {}  # sums of the values of some steps since the last comparison
        self.summed = 0  # of how many
        self.mean, self.means = self.good, 0  # the mean of so many means since the loss last fell

    @property
    def best(self) -> dict[str, Tensor]:
        """The present values while the loss falls, and the mean of those since it last fell afterwards."""
        return self.mean if self.settling.settled else detached(self.values)

    def advance(self) -> None:
        settings, window = self.settings, max(1, self.settings.patience // self.settings.windows)
        renewed = self.renew_objective(self.values)
        if not self.settling.points:
            self._compare(self.good)
        elif renewed:
            self.settling.rebase(self.settling.lowest, self.compared(self.good))
        loss = self.objective(self.values, self.steps)
        gradients = gradients_of(loss, self.values)
        norms = {name: 0.0 if g is None else float(g.norm()) for name, g in gradients.items()}
        self.record(float(loss.detach()), norms, settings.cut**self.cuts)
        if not math.isfinite(self.loss + sum(norms.values())):
            # The step went too far: go back to where the loss last fell, with shorter steps.
            self._cut()
            self.adam.moments.clear()
            self.set(self.good)
            return
        self.total = {n: v.detach() + (self.total[n] if self.summed else 0.0) for n, v in self.values.items()}
        self.summed += 1
        self.adam.step(gradients)
        self.set(self.values)
        if self.summed == window:
            self._compare({name: total / window for name, total in self.total.items()})
            self.summed = 0
            if settings.tolerance > 0.0 and self.settling.settled >= settings.settled_windows:
                self._cut()

    def _compare(self, mean: dict[str, Tensor]) -> None:
        """Note whether the loss of the mean of some values is lower than before."""
        settings = self.settings
        self.settling.add(self.compared(mean), settings.noise_deviations, settings.tolerance / settings.windows)
        if self.settling.settled == 0:
            self.good = mean
        self.means = self.means + 1 if self.settling.settled > 1 else 1
        self.mean = {name: value.lerp(mean[name], 1.0 / self.means) for name, value in self.mean.items()}

    def _cut(self) -> None:
        self.resting = self.cuts == self.settings.cuts
        if not self.resting:
            self.cuts, self.summed, self.settling.settled = self.cuts + 1, 0, 0
            self.adam.rates = {name: rate * self.settings.cut for name, rate in self.adam.rates.items()}

    def state(self) -> dict[str, Any]:
        return {**super().state(), "adam": self.adam.state(), "settling": dict(vars(self.settling))}

    def load(self, state: Mapping[str, Any]) -> None:
        super().load(state)
        self.adam.load(state["adam"])
        self.settling = Settling(**state["settling"])
