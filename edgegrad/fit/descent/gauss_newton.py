"""Steps of Gauss and Newton, damped as Levenberg (1944) and Marquardt (1963) did: (H + λ diag H) δ = −g.

H is the curvature of the loss (curvature.py), g its gradient, from samples of its own in each step. Where the loss rises by more
than its noise, the step is taken back and the damping raised. Once the loss falls no longer, each full step lands about the
minimum, apart by the noise of its own gradient: the mean over these places is the answer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..history import Record
from ..options import Options, Parameter
from .curvature import MOST, check_pointwise, curvature
from .loop import Way, is_finite

if TYPE_CHECKING:
    from .objective import Objective

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 0.03, 1e-4, 1e4  # λ
UNSEEN = 1e-4  # of the largest entry of H, beside λ: what the pictures do not show stays at rest
LONGEST = 10.0  # learning rates, of a number in a step
DEVIATIONS = 2.0  # of the noise, by which the loss of an accepted step may rise
SETTLED = 5  # steps in which the loss falls no longer, until the fit ends
AGAIN = 2**20  # steps apart: seeds of a second render
_PLAIN = ("loss", "noise", "damping", "settled", "accepted", "places", "here", "slope", "H")


class GaussNewtonSteps(Way):
    """A way down by Gauss-Newton. All in units of the learning rates."""

    def __init__(self, parameters: Mapping[str, Parameter], options: Options) -> None:
        super().__init__(parameters, options, apart=False)
        count = sum(value.numel() for value in self.values.values())
        if count > MOST:
            raise ValueError(
                f'method: expected at most {MOST} numbers to be sought by "gauss-newton", got {count}; give method="adam"'
            )
        if options.views_per_step is not None:
            raise ValueError(
                'views_per_step: expected None for method="gauss-newton", which compares losses of all views'
            )
        self.rates = torch.cat(
            [
                torch.full((value.numel(),), parameters[name].lr, dtype=torch.float64)
                for name, value in self.values.items()
            ]
        )
        self.loss, self.noise = math.inf, 0.0  # of the last accepted point; variance of the loss
        self.damping, self.settled, self.accepted = FIRST_DAMPING, 0, 0
        self.places: list[Tensor] = []  # since the loss fell no longer
        self.here, self.slope, self.H = self._flat(self.values), torch.empty(0), torch.empty(0)

    def advance(self, objective: Objective) -> Record:
        if not self.step:
            check_pointwise(objective)
        step = self.step
        if self.renew(objective, self._named(self.here)) and self.accepted:
            # That what is compared with it is compared by the same.
            with torch.no_grad():
                self.loss = 0.5 * sum(float(objective(self._named(self.here), at)) for at in (step, step + AGAIN))
        first = objective(self.values, step)
        gradients = self.gradients(first)
        with torch.no_grad():
            second = float(objective(self.values, step + AGAIN))
        record = self.record(float(first.detach()), gradients, 1.0)
        loss = 0.5 * (record.loss + second)
        self._judge(loss, 0.25 * (record.loss - second) ** 2, gradients, objective, step, is_finite(record))
        self.set(self._named(self.here))
        self.falls.note()
        self.set(self._named(self.here + self._step()))
        return record

    def _judge(
        self, loss: float, square: float, gradients: Mapping[str, Tensor | None], objective: Objective, step: int, finite: bool
    ) -> None:  # fmt: skip
        """Accepts the point, or takes the step to it back."""
        slack = DEVIATIONS * math.sqrt(2.0 * max(self.noise, square))
        if not finite or not loss <= self.loss + slack:
            self.damping *= 5.0
            self.flat = self.damping > MOST_DAMPING or (not self.accepted and self.step > 20)
            return
        known = self.accepted > 0
        self.noise = 0.7 * self.noise + 0.3 * square if known else square
        if known and not loss < self.loss - slack:
            self.settled += 1
            if self.settled == 1:
                self.falls.forget()
        self.damping = max(self.damping / 3.0, LEAST_DAMPING) if known else self.damping
        self.falls.observe(loss, gradients)
        self.here, self.loss, self.accepted = self._flat(self.values), loss, self.accepted + 1
        self.slope = self._flat({
            n: torch.zeros_like(v) if (g := gradients[n]) is None else g for n, v in self.values.items()
        }) * self.rates  # fmt: skip
        if self.settled <= 1:
            self.H = curvature(objective, self.values, step) * self.rates * self.rates[:, None]
        self.places = [*self.places, self.here] if self.settled else [self.here]
        self.best = self._named(torch.stack(self.places[-((len(self.places) + 1) // 2) :]).mean(0))
        self.flat = self.settled > SETTLED and self.impatient

    def _step(self) -> Tensor:
        """From the last accepted point, in the parameters' units."""
        if not self.accepted:
            return torch.zeros_like(self.here)
        step = self._solved(torch.ones_like(self.slope, dtype=torch.bool))
        # What stands at a bound and would pass it stays, and the others go as if it were known.
        ends = self._named(self.here + step)
        within = self._flat({name: parameter.within(ends[name]) for name, parameter in self.parameters.items()})
        stuck = (within == self.here) & (step != 0.0)
        return self._solved(~stuck) if bool(stuck.any()) else step

    def _solved(self, free: Tensor) -> Tensor:
        """With the others at rest."""
        diagonal = self.H.diagonal()
        A = self.H + torch.diag(self.damping * diagonal + UNSEEN * diagonal.max() + 1e-300)
        step = torch.zeros_like(self.slope)
        step[free] = -torch.linalg.solve(A[free][:, free], self.slope[free])
        return step * min(1.0, LONGEST / max(float(step.abs().max()), 1e-300)) * self.rates

    def _flat(self, tensors: Mapping[str, Tensor]) -> Tensor:
        return torch.cat([tensor.detach().double().flatten() for tensor in tensors.values()])

    def _named(self, flat: Tensor) -> dict[str, Tensor]:
        parts = flat.split([value.numel() for value in self.values.values()])
        return {n: p.reshape(v.shape).to(v.dtype) for (n, v), p in zip(self.values.items(), parts, strict=True)}

    def state(self) -> dict[str, Any]:
        return {**super().state(), **{name: getattr(self, name) for name in _PLAIN}}

    def load(self, saved: Mapping[str, Any]) -> None:
        super().load(saved)
        for name in _PLAIN:
            setattr(self, name, saved[name])
