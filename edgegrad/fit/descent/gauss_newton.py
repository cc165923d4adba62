"""Gauss-Newton steps, damped as Levenberg (1944) and Marquardt (1963) did: (H + λ diag H) δ = −g.

H is the curvature of the loss (curvature.py) and g its gradient, from samples of its own in each step. The losses of two points
are compared with the same samples, twice. How far the two differences are apart says by how much a loss may rise by noise; a
step that raises it by more is taken back. The damping follows the gain, the decrease of the loss over the one that H and g
predict (Nielsen, Damping Parameter in Marquardt's Method, 1999). Once the loss falls no longer, each full step lands about the
minimum, off by the noise of its own gradient. The mean of these places is the result.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from ..history import Record
from ..losses import REGION
from ..options import Settings
from ..parameter import Parameter
from .curvature import MAX_NUMBERS, check_pointwise, curvature
from .loop import Optimizer, is_finite
from .objective import Objective

START_LAMBDA, MIN_LAMBDA, MAX_LAMBDA = 0.03, 1e-4, 1e4  # λ
REGION_LAMBDA = 1.0  # the first λ by regions, whose start may be far (Nielsen's τ): colours are those of a wrong place
UNSEEN_DAMPING = 1e-4  # of the largest entry of H, added to λ diag H: what the pictures do not show stays at rest
MAX_STEP_RATES = 10.0  # learning rates, of a number in a step
LOSS_DEVIATIONS = 2.0  # standard deviations of the noise, by which the loss of an accepted step may rise
SETTLED_STEPS = 5  # steps in which the loss falls no longer, until the fit ends
COMPARISON_STEPS = 2**20, 2**21  # seeds of the losses that are compared: steps that no fit reaches
RAISE = 2.0  # factor of λ at the first step that is taken back; it doubles with each further one


class GaussNewtonOptimizer(Optimizer):
    """Descent by Gauss-Newton. Slope and curvature are in units of the learning rates."""

    saved = (
        *Optimizer.saved, "losses", "noise", "damping", "raised", "predicted_decrease", "settled", "accepted", "places", "here",
        "slope", "H",
    )  # fmt: skip

    def __init__(self, parameters: Mapping[str, Parameter], options: Settings) -> None:
        super().__init__(parameters, options, apart=False)
        count = sum(value.numel() for value in self.values.values())
        if count > MAX_NUMBERS:
            raise ValueError(
                f'options.method: expected at most {MAX_NUMBERS} numbers to be sought by "gauss-newton", got {count}; '
                'give method="adam"'
            )
        if options.views_per_step is not None:
            raise ValueError(
                'options.views_per_step: expected None for method="gauss-newton", which compares losses of all views'
            )
        rates = [torch.full((v.numel(),), parameters[n].lr, dtype=torch.float64) for n, v in self.values.items()]
        self.rates = torch.cat(rates)
        self.unseen_damping = UNSEEN_DAMPING
        self.losses: list[float] = []  # those of the last accepted point, one for each of COMPARISON_STEPS
        self.noise = 0.0  # variance of their mean difference
        self.damping, self.raised = REGION_LAMBDA if options.loss == REGION else START_LAMBDA, RAISE
        self.settled, self.accepted = 0, 0
        self.predicted_decrease = 0.0  # decrease of the loss by the present step
        self.places: list[Tensor] = []  # accepted points since the loss fell no longer
        self.here, self.slope, self.H = self._flat(self.values), torch.empty(0), torch.empty(0)

    def advance(self, objective: Objective) -> Record:
        if not self.step:
            check_pointwise(objective)
        step = self.step
        accepted, renewed = self.accepted, self.renew(objective, self._named(self.here))
        if renewed and accepted:
            # Losses that are compared must hold the same things fixed.
            self.losses = self._compared(objective, self._named(self.here))
        first = objective(self.values, step)
        gradients = self.gradients(first)
        record = self.record(float(first.detach()), gradients, 1.0)
        losses = self._compared(objective, self.values)
        self._judge(losses, gradients, objective, step, is_finite(record) and all(map(math.isfinite, losses)))
        self.set(self._named(self.here))
        if renewed and 0 < accepted == self.accepted:
            # The step was taken back to a point whose slope is still that of the loss before the renewal.
            self._observe(self.gradients(objective(self.values, step)), objective, step)
        self.monitor.begin_step()
        self.set(self._named(self.here + self._step()))
        return record

    @property
    def loss(self) -> float:
        """The loss of the last accepted point."""
        return sum(self.losses) / len(self.losses) if self.losses else math.inf

    def _compared(self, objective: Objective, values: Mapping[str, Tensor]) -> list[float]:
        with torch.no_grad():
            return [float(objective(values, at)) for at in COMPARISON_STEPS]

    def _judge(
        self, losses: list[float], gradients: Mapping[str, Tensor | None], objective: Objective, step: int, finite: bool
    ) -> None:  # fmt: skip
        """Accept the point, or take the step to it back."""
        known = self.accepted > 0
        falls = [here - there for here, there in zip(self.losses, losses, strict=True)] if known else [math.inf]
        square = 0.25 * (falls[0] - falls[1]) ** 2 if known and finite else 0.0
        fall, slack = sum(falls) / len(falls), LOSS_DEVIATIONS * math.sqrt(max(self.noise, square))
        if not finite or fall < -slack:
            self.damping, self.raised = self.damping * self.raised, 2.0 * self.raised
            self.flat = self.damping > MAX_LAMBDA or (not known and self.step > 20)
            return
        if known:
            self.noise = 0.7 * self.noise + 0.3 * square if self.accepted > 1 else square
            if fall <= slack and not objective.narrows():
                self.settled += 1
                if self.settled == 1:
                    self.monitor.reset()
            gain = fall / self.predicted_decrease if fall > slack and self.predicted_decrease > 0.0 else 1.0
            self.damping = max(self.damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), MIN_LAMBDA)
            self.raised = RAISE
        self.here, self.losses, self.accepted = self._flat(self.values), losses, self.accepted + 1
        self.monitor.end_step(self.loss, gradients)
        self._observe(gradients, objective, step)
        self.places = [*self.places, self.here] if self.settled else [self.here]
        self.best = self._named(torch.stack(self.places[-((len(self.places) + 1) // 2) :]).mean(0))
        self.flat = self.settled > SETTLED_STEPS and self.impatient

    def _observe(self, gradients: Mapping[str, Tensor | None], objective: Objective, step: int) -> None:
        """Compute slope and curvature at the present values."""
        self.slope = self._flat({
            n: torch.zeros_like(v) if (g := gradients[n]) is None else g for n, v in self.values.items()
        }) * self.rates  # fmt: skip
        if self.settled <= 1:
            self.H = curvature(objective, self.values, step) * self.rates * self.rates[:, None]

    def _step(self) -> Tensor:
        """Return the step from the last accepted point, in the parameters' units."""
        if not self.accepted:
            return torch.zeros_like(self.here)
        step = self._solved(torch.ones_like(self.slope, dtype=torch.bool))
        # Numbers that would pass a bound they stand at stay; the others are solved for again.
        ends = self._named(self.here + step)
        within = self._flat({name: parameter.within(ends[name]) for name, parameter in self.parameters.items()})
        stuck = (within == self.here) & (step != 0.0)
        step = self._solved(~stuck) if bool(stuck.any()) else step
        taken = step / self.rates
        self.predicted_decrease = -float(self.slope @ taken + 0.5 * taken @ self.H @ taken)
        return step

    def _solved(self, free: Tensor) -> Tensor:
        """Return the damped step of the free numbers, with the others at rest."""
        diagonal = self.H.diagonal()
        A = self.H + torch.diag(self.damping * diagonal + self.unseen_damping * diagonal.max() + 1e-300)
        step = torch.zeros_like(self.slope)
        step[free] = -torch.linalg.solve(A[free][:, free], self.slope[free])
        return step * min(1.0, MAX_STEP_RATES / max(float(step.abs().max()), 1e-300)) * self.rates

    def _flat(self, tensors: Mapping[str, Tensor]) -> Tensor:
        return torch.cat([tensor.detach().double().flatten() for tensor in tensors.values()])

    def _named(self, flat: Tensor) -> dict[str, Tensor]:
        parts = flat.split([value.numel() for value in self.values.values()])
        return {n: p.reshape(v.shape).to(v.dtype) for (n, v), p in zip(self.values.items(), parts, strict=True)}
