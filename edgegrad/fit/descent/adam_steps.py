"""Steps of Adam whose learning rates are cut where they lead no further. After MAX_CUTS cuts the fit ends."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ..history import Record
from ..options import Settings
from ..parameter import Parameter
from .adam import Adam
from .loop import Optimizer, is_finite
from .objective import Objective

CUT, MAX_CUTS = 0.3, 3  # factor of the learning rates, and how often they are cut before the fit ends
SMOOTHING = 0.9  # of the averaged loss by which the best values are chosen: over some ten steps, for losses are noisy
WARM_UP = 10  # steps of few views until their losses are averaged enough to be compared


class AdamOptimizer(Optimizer):
    """Descent by Adam. About a minimum steps go to and fro, so the result is the mean of the values after the last cut."""

    saved = (*Optimizer.saved, "cuts", "since", "smooth", "least", "total")

    def __init__(self, parameters: Mapping[str, Parameter], options: Settings) -> None:
        super().__init__(parameters, options)
        rates = {name: p.lr for name, p in parameters.items()}
        self.adam = Adam(self.values, rates, {name for name, p in parameters.items() if p.uniform})
        self.cuts = self.since = 0  # `since` is the step of the last cut
        self.smooth, self.least = 0.0, math.inf
        self.total: dict[str, Tensor] = {}  # sums of the values since the last cut

    def advance(self, objective: Objective) -> Record:
        if self.renew(objective, self.values):
            self.least = math.inf
        loss = objective(self.values, self.step)
        gradients = self.gradients(loss)
        record = self.record(float(loss.detach()), gradients, CUT**self.cuts)
        if not is_finite(record):
            # The step went too far: go back to the best values, with shorter steps.
            self._cut()
            self.adam.forget()
            self.set(self.best)
            return record
        self.monitor.end_step(record.loss, gradients)
        self.smooth = SMOOTHING * self.smooth + (1.0 - SMOOTHING) * record.loss
        mean = self.smooth / (1.0 - SMOOTHING ** len(self.history))
        # The first views of several may happen to have the least loss, whatever the values.
        warming = self.options.views_per_step is not None and len(self.history) <= WARM_UP
        if mean <= self.least or warming:
            self.least, self.best = mean, self.copied()
        with torch.no_grad():
            self.total = {n: v.detach() + self.total.get(n, 0.0) for n, v in self.values.items()}
        self.monitor.begin_step()
        self.adam.step(gradients)
        self.set(self.values)
        self._settle()
        return record

    def _settle(self) -> None:
        """Cut the learning rates where steps lead down no longer, or where the mean loss falls no longer."""
        p = self.options.patience
        if self.impatient:
            self._cut()
        elif self.options.loss_tolerance > 0.0 and self.step - self.since >= 2 * p:
            losses = [record.loss for record in self.history[-2 * p :]]
            before, now = sum(losses[:p]) / p, sum(losses[p:]) / p
            # With `not >` instead of `<=`, losses that are NaN count as flat.
            if not before - now > self.options.loss_tolerance * abs(before):
                self._cut()

    def _cut(self) -> None:
        self.flat = self.cuts == MAX_CUTS
        count = self.step - self.since
        if self.flat and self.total:
            self.best = {name: total / count for name, total in self.total.items()}
        self.cuts, self.since, self.total = self.cuts + 1, self.step, {}
        self.monitor.reset()
        self.adam.shorten(CUT)

    def state(self) -> dict[str, Any]:
        return {**super().state(), "adam": self.adam.state()}

    def load(self, state: Mapping[str, Any]) -> None:
        super().load(state)
        self.adam.load(state["adam"])
