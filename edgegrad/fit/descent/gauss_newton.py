"""Steps of Gauss and Newton, damped as Levenberg (1944) and Marquardt (1963) did: (H + λ diag H) δ = −g.

H is the curvature of the loss (curvature.py), g its gradient, from samples of its own in each step. The losses of two points are
compared with the same samples, twice: how far both differences are apart says by how much the loss may seem to rise by noise.
Where it rises by more, the step is taken back. The damping follows the gain, how far the loss falls by how far H and g promise
(Nielsen, Damping Parameter in Marquardt's Method, 1999). Once the loss falls no longer, each full step lands about the minimum,
apart by the noise of its own gradient: the mean over these places is the answer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ..history import Record
from ..losses import REGION
from ..options import Options, Parameter
from .curvature import MOST, check_pointwise, curvature
from .loop import Way, is_finite
from .objective import Objective

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 0.03, 1e-4, 1e4  # λ
FAR_DAMPING = (
    1.0  # the first of regions, whose colours are those of a wrong place (Nielsen's τ where the start may be far)
)
UNSEEN = 1e-4  # of the largest entry of H, beside λ: what the pictures do not show stays at rest
LONGEST = 10.0  # learning rates, of a number in a step
DEVIATIONS = 2.0  # of the noise, by which the loss of an accepted step may rise
SETTLED = 5  # steps in which the loss falls no longer, until the fit ends
COMPARED = 2**20, 2**21  # steps that no fit comes to: seeds of the losses that are compared
RAISED = 2.0  # factor of λ at the first step that is taken back; twice as much at the next one
_PLAIN = ("losses", "noise", "damping", "raised", "promised", "settled", "accepted", "places", "here", "slope", "H")


class GaussNewtonSteps(Way[Objective]):
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
        self.unseen = UNSEEN
        self.losses: list[float] = []  # of the last accepted point, as they are compared
        self.noise = 0.0  # variance of their mean difference
        self.damping, self.raised = FAR_DAMPING if options.loss == REGION else FIRST_DAMPING, RAISED
        self.settled, self.accepted = 0, 0
        self.promised = 0.0  # fall of the loss by the present step
        self.places: list[Tensor] = []  # since the loss fell no longer
        self.here, self.slope, self.H = self._flat(self.values), torch.empty(0), torch.empty(0)

    def advance(self, objective: Objective) -> Record:
        if not self.step:
            check_pointwise(objective)
        step = self.step
        accepted, renewed = self.accepted, self.renew(objective, self._named(self.here))
        if renewed and accepted:
            # That what is compared with it is compared by the same.
            self.losses = self._compared(objective, self._named(self.here))
        first = objective(self.values, step)
        gradients = self.gradients(first)
        record = self.record(float(first.detach()), gradients, 1.0)
        losses = self._compared(objective, self.values)
        self._judge(losses, gradients, objective, step, is_finite(record) and all(map(math.isfinite, losses)))
        self.set(self._named(self.here))
        if renewed and 0 < accepted == self.accepted:
            # Taken back to where slopes are still those of the loss before.
            self._observe(self.gradients(objective(self.values, step)), objective, step)
        self.falls.note()
        self.set(self._named(self.here + self._step()))
        return record

    @property
    def loss(self) -> float:
        """Of the last accepted point."""
        return sum(self.losses) / len(self.losses) if self.losses else math.inf

    def _compared(self, objective: Objective, values: Mapping[str, Tensor]) -> list[float]:
        with torch.no_grad():
            return [float(objective(values, at)) for at in COMPARED]

    def _judge(
        self, losses: list[float], gradients: Mapping[str, Tensor | None], objective: Objective, step: int, finite: bool
    ) -> None:  # fmt: skip
        """Accepts the point, or takes the step to it back."""
        known = self.accepted > 0
        falls = [here - there for here, there in zip(self.losses, losses, strict=True)] if known else [math.inf]
        square = 0.25 * (falls[0] - falls[1]) ** 2 if known and finite else 0.0
        fall, slack = sum(falls) / len(falls), DEVIATIONS * math.sqrt(max(self.noise, square))
        if not finite or fall < -slack:
            self.damping, self.raised = self.damping * self.raised, 2.0 * self.raised
            self.flat = self.damping > MOST_DAMPING or (not known and self.step > 20)
            return
        if known:
            self.noise = 0.7 * self.noise + 0.3 * square if self.accepted > 1 else square
            if fall <= slack and not objective.narrows():
                self.settled += 1
                if self.settled == 1:
                    self.falls.forget()
            gain = fall / self.promised if fall > slack and self.promised > 0.0 else 1.0
            self.damping = max(self.damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), LEAST_DAMPING)
            self.raised = RAISED
        self.here, self.losses, self.accepted = self._flat(self.values), losses, self.accepted + 1
        self.falls.observe(self.loss, gradients)
        self._observe(gradients, objective, step)
        self.places = [*self.places, self.here] if self.settled else [self.here]
        self.best = self._named(torch.stack(self.places[-((len(self.places) + 1) // 2) :]).mean(0))
        self.flat = self.settled > SETTLED and self.impatient

    def _observe(self, gradients: Mapping[str, Tensor | None], objective: Objective, step: int) -> None:
        """Slope and curvature where the values are."""
        self.slope = self._flat({
            n: torch.zeros_like(v) if (g := gradients[n]) is None else g for n, v in self.values.items()
        }) * self.rates  # fmt: skip
        if self.settled <= 1:
            self.H = curvature(objective, self.values, step) * self.rates * self.rates[:, None]

    def _step(self) -> Tensor:
        """From the last accepted point, in the parameters' units."""
        if not self.accepted:
            return torch.zeros_like(self.here)
        step = self._solved(torch.ones_like(self.slope, dtype=torch.bool))
        # What stands at a bound and would pass it stays, and the others go as if it were known.
        ends = self._named(self.here + step)
        within = self._flat({name: parameter.within(ends[name]) for name, parameter in self.parameters.items()})
        stuck = (within == self.here) & (step != 0.0)
        step = self._solved(~stuck) if bool(stuck.any()) else step
        taken = step / self.rates
        self.promised = -float(self.slope @ taken + 0.5 * taken @ self.H @ taken)
        return step

    def _solved(self, free: Tensor) -> Tensor:
        """With the others at rest."""
        diagonal = self.H.diagonal()
        A = self.H + torch.diag(self.damping * diagonal + self.unseen * diagonal.max() + 1e-300)
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
