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

from .convergence import ConvergenceMonitor
from .tensors import Objective, Parameter, TensorDescent, detached, gradients_of

BETAS = 0.9, 0.999  # decay of the means of gradients and of their squares, as the paper has them


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


@dataclass(frozen=True)
class AdamSettings:
    """When learning rates are cut, and when a descent ends."""

    # Rates are cut where `patience` more steps would lower the loss by less than this share. 0: they never are.
    tolerance: float = 0.01
    patience: int = 40
    # Factor of the rates at a cut, and number of cuts before the end. The last rates are 0.3³ of the first, and so is the
    # spread of the values about the minimum. Half as many cuts end a third sooner, with three times the spread.
    cut: float = 0.3
    cuts: int = 3
    # Weight of earlier losses in the mean by which the best values are chosen: over some ten steps, for losses are noisy.
    smoothing: float = 0.9
    # Steps until the mean of losses is compared, where each loss is of a part of the data: the first may happen to be least.
    warm_up: int = 0


class AdamDescent(TensorDescent):
    """Descent by Adam. About a minimum steps go to and fro, so the result is the mean of the values after the last cut."""

    saved = (*TensorDescent.saved, "cuts", "since", "smooth", "least", "total")

    def __init__(self, objective: Objective, parameters: Mapping[str, Parameter], settings: AdamSettings) -> None:
        super().__init__(objective, parameters)
        self.settings = settings
        rates = {name: p.lr for name, p in parameters.items()}
        self.adam = Adam(self.values, rates, {name for name, p in parameters.items() if p.uniform})
        self.monitor = ConvergenceMonitor(self.values)
        self.cuts = self.since = 0  # `since` is the step of the last cut
        self.smooth, self.least = 0.0, math.inf
        self.total: dict[str, Tensor] = {}  # sums of the values since the last cut

    @property
    def falling(self) -> bool:
        """Whether as many more steps as the patience are predicted to lower the loss by more than tolerance and noise."""
        return self.monitor.is_ready and self._leads_down

    @property
    def _leads_down(self) -> bool:
        tolerance, patience = self.settings.tolerance, self.settings.patience
        return self.monitor.predicted_decrease(patience) > self.monitor.least_decrease(tolerance, patience)

    def advance(self) -> None:
        if self.renew(self.values):
            self.monitor.split_losses()
            self.least = math.inf
        settings = self.settings
        loss = self.objective(self.values, self.steps)
        gradients = gradients_of(loss, self.values)
        norms = {name: 0.0 if g is None else float(g.norm()) for name, g in gradients.items()}
        self.record(float(loss.detach()), norms, settings.cut**self.cuts)
        if not math.isfinite(self.loss + sum(norms.values())):
            # The step went too far: go back to the best values, with shorter steps.
            self._cut()
            self.adam.forget()
            self.set(self.best)
            return
        self.monitor.end_step(self.loss, gradients)
        self.smooth = settings.smoothing * self.smooth + (1.0 - settings.smoothing) * self.loss
        mean = self.smooth / (1.0 - settings.smoothing ** len(self.history))
        if mean <= self.least or len(self.history) <= settings.warm_up:
            self.least, self.best = mean, detached(self.values)
        self.total = {n: v.detach() + self.total.get(n, 0.0) for n, v in self.values.items()}
        self.monitor.begin_step()
        self.adam.step(gradients)
        self.set(self.values)
        if settings.tolerance > 0.0 and not self._leads_down:
            self._cut()

    def _cut(self) -> None:
        self.resting = self.cuts == self.settings.cuts
        count = self.steps - self.since
        if self.resting and self.total:
            self.best = {name: total / count for name, total in self.total.items()}
        self.cuts, self.since, self.total = self.cuts + 1, self.steps, {}
        self.monitor.reset()
        self.adam.shorten(self.settings.cut)

    def state(self) -> dict[str, Any]:
        return {**super().state(), "adam": self.adam.state(), "monitor": self.monitor.state()}

    def load(self, state: Mapping[str, Any]) -> None:
        super().load(state)
        self.adam.load(state["adam"])
        self.monitor.load(state["monitor"])
