"""Steps of Adam, whose learning rates fall where they lead no further; after CUTS falls the fit ends."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ..history import Record
from ..options import Options, Parameter
from .adam import Adam
from .loop import Loss, Way, is_finite

CUT, CUTS = 0.3, 3  # learning rates fall by this factor when steps lead no further; so often before the fit ends
SMOOTH = 0.9  # on the way the best values are those of the least loss, averaged over some ten steps for its noise
WARM = 10  # steps of few views until their losses are averaged enough to be compared
_PLAIN = ("cuts", "since", "smooth", "least", "total")


class AdamSteps(Way[Loss]):
    """A way down by Adam. About a minimum the steps go to and fro: the values found are the mean over those after the last fall
    of the rates."""

    def __init__(self, parameters: Mapping[str, Parameter], options: Options) -> None:
        super().__init__(parameters, options)
        rates = {name: p.lr for name, p in parameters.items()}
        self.optimizer = Adam(self.values, rates, {name for name, p in parameters.items() if p.uniform})
        self.cuts = self.since = 0  # `since`: the step of the last cut
        self.smooth, self.least = 0.0, math.inf
        self.total: dict[str, Tensor] = {}  # of the values since the last cut

    def advance(self, objective: Loss) -> Record:
        if self.renew(objective, self.values):
            self.least = math.inf
        loss = objective(self.values, self.step)
        gradients = self.gradients(loss)
        record = self.record(float(loss.detach()), gradients, CUT**self.cuts)
        if not is_finite(record):
            # Too far: back to the best values, with shorter steps.
            self._cut()
            self.optimizer.forget()
            self.set(self.best)
            return record
        self.falls.observe(record.loss, gradients)
        self.smooth = SMOOTH * self.smooth + (1.0 - SMOOTH) * record.loss
        mean = self.smooth / (1.0 - SMOOTH ** len(self.history))
        # The first views of several may be those of the least loss, whatever the values.
        warming = self.options.views_per_step is not None and len(self.history) <= WARM
        if mean <= self.least or warming:
            self.least, self.best = mean, self.copied()
        with torch.no_grad():
            self.total = {n: v.detach() + self.total.get(n, 0.0) for n, v in self.values.items()}
        self.falls.note()
        self.optimizer.step(gradients)
        self.set(self.values)
        self._settle()
        return record

    def _settle(self) -> None:
        """Lowers the learning rates where the steps lead down no longer, or the loss falls no longer; when it has fallen often
        enough, it is flat."""
        p = self.options.patience
        if self.impatient:
            self._cut()
        elif self.options.tolerance > 0.0 and self.step - self.since >= 2 * p:
            losses = [record.loss for record in self.history[-2 * p :]]
            before, now = sum(losses[:p]) / p, sum(losses[p:]) / p
            # not <=, so that losses that are NaN count as flat
            if not before - now > self.options.tolerance * abs(before):
                self._cut()

    def _cut(self) -> None:
        self.flat = self.cuts == CUTS
        count = self.step - self.since
        if self.flat and self.total:
            self.best = {name: total / count for name, total in self.total.items()}
        self.cuts, self.since, self.total = self.cuts + 1, self.step, {}
        self.falls.forget()
        self.optimizer.shorten(CUT)

    def state(self) -> dict[str, Any]:
        plain = {name: getattr(self, name) for name in _PLAIN}
        return {**super().state(), **plain, "optimizer": self.optimizer.state()}

    def load(self, saved: Mapping[str, Any]) -> None:
        super().load(saved)
        for name in _PLAIN:
            setattr(self, name, saved[name])
        self.optimizer.load(saved["optimizer"])
