"""Hypotheses about limbs: poses that a descent does not reach, where they lower the cost of a level.

Silhouettes hardly show which limb is where, so a descent ends where one lies in the place of another. Hypotheses are exchanged
limbs, limbs that are rotated at random, most often those about which pixels are off, and rotations about bones. Their costs on
the level are compared. The likeliest are refined by the limb's own numbers, which is cheap, and the best of these by all. It is
kept where its cost is lower by more than the noise of samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..descent.curvature import misfit, residuals
from ..descent.objective import Objective
from ..descent.region_loss import FINAL_STEP
from ..edge_support import MIN_EDGE_SUPPORT
from ..parameter import Parameter
from .joint_support import edge_support_by_joint
from .proposals import Limb, Proposals
from .settings import RIG

Values = dict[str, Tensor]
FIRST, OTHERS = (0,), (1, 2, 3)  # sets of samples: by the first hypotheses are chosen, by the others they are tested


@dataclass
class HypothesisSearch:
    """The search on one level.

    joints  names of the rows of the value that is searched
    steps   descends from the values of parameters of an objective
    """

    objective: Objective
    proposals: Proposals
    joints: Sequence[str]
    parameters: Mapping[str, Parameter]
    rest: Tensor
    steps: Callable[[Objective, Mapping[str, Parameter]], Values]
    generator: torch.Generator
    report: Callable[[], Any] = lambda: None

    def __post_init__(self) -> None:
        self.name, self.limbs = self.proposals.name, self.proposals.limbs
        self.by_contour = self.objective.regions is not None

    def draw_limbs(self, values: Values, tries: int) -> Values:
        """Return the best values after exchanges of limbs, and so many draws."""
        best, idle = values, 0
        if self._fitted(best, RIG.fitted):
            return best
        for limb in self.limbs:
            if limb.twins is not None:
                best = self._refined(best, [self._with(best, self.proposals.exchanged(best, *limb.twins))], limb.rows)
        before = self._cost(best)
        for _ in range(tries):
            if self._fitted(best, RIG.fitted) or (idle >= RIG.idle and self._fitted(best, RIG.idle_fitted)):
                break
            limb = self.limbs[int(torch.multinomial(self._chances(best), 1, generator=self.generator))]
            best = self._refined(best, self._drawn(best, limb), limb.rows)
            now = self._cost(best)
            idle, before = 0 if now < (1.0 - RIG.idle_fall) * before else idle + 1, now
            self.report()
        self._renew(best)
        return best

    def rotate_about_bones(self, values: Values) -> Values:
        """Return the best values after rotations about bones. These change a loss so little, and so far from quadratically,
        that steps stop 10° from its minimum, and a flat hand has a second minimum across its place."""
        best, rotations = values, self.proposals.axial_rotations(values)
        shared = [one for one in rotations if one.child is not None]
        for _ in range(RIG.sweeps if shared and self._residual(values) < RIG.nearly_fitted else 0):
            off = residuals(self.objective, best, 0)[self.name].mean(1)
            for one in sorted(shared, key=lambda one: -float(off[one.row]))[: RIG.worst_joints]:
                rows = [limb.rows for limb in self.limbs if limb.twins is None and {one.row, one.child} <= {*limb.rows}]
                if rows and not self._fitted(best, RIG.fitted):
                    starts = [
                        self._with(best, turned) for turned in self.proposals.about_bone(best, one, RIG.far_angles)
                    ]
                    found = self._alone(min(starts, key=lambda start: self._loss(start, FIRST)), max(rows, key=len))
                    best = found if self._cost(found) < self._cost(best) else best
        for one in rotations:
            starts = [self._with(best, turned) for turned in self.proposals.about_bone(best, one, RIG.axial_angles)]
            found = min(starts, key=lambda start: self._loss(start, FIRST))
            best = found if self._lower(found, best) else best
        return best

    def _refined(self, best: Values, starts: Sequence[Values], rows: list[int]) -> Values:
        """Return what the likeliest starts lead to, by their rows and then by all, or the best so far."""
        self._renew(best)
        likeliest = sorted(starts, key=lambda start: self._loss(start, FIRST))[: RIG.kept]
        found = min((self._alone(start, rows) for start in likeliest), key=self._cost, default=None)
        if found is None:
            return best
        # Another limb in the true place must often leave it before the loss falls.
        if self.by_contour or self._cost(found) < RIG.most_worse * self._cost(best):
            found = self.steps(self.objective, _started(self.parameters, found))
        return found if self._lower(found, best) else best

    def _drawn(self, values: Values, limb: Limb) -> list[Values]:
        """Return random rotations of a limb that are not about where it is."""
        now, found = values[self.name], []
        across = now if limb.twins is None else self.proposals.exchanged(values, *limb.twins)
        for k in range(RIG.draws):
            turned = (across if k % 2 else now).clone()
            # Half of them start from rest, half from where the limb is; some rotate the first joint alone.
            chosen = limb.rows[: 1 if k % 4 > 1 else None]
            middle = turned[chosen] if k % 8 < 4 else self.rest[chosen].to(turned)
            noise = torch.randn(middle.shape, generator=self.generator, dtype=turned.dtype)
            turned[chosen] = middle + RIG.spreads[k % 3 % 2] * noise
            start = self._with(values, turned)
            moved = (start[self.name] - now)[limb.rows].reshape(len(limb.rows), -1).norm(dim=1)
            found += [start] if float(moved.max()) > RIG.least_move else []
        return found

    def _alone(self, start: Values, rows: list[int]) -> Values:
        """Refine rows by their own numbers."""
        place, parameter = torch.tensor(rows), self.parameters[self.name]

        def whole(own: Mapping[str, Tensor]) -> Values:
            value, part = start[self.name], own[self.name]
            at = part.dim() - value.dim()
            moved = value.expand(*part.shape[:at], *value.shape).index_copy(at, place, part)
            return {**start, self.name: moved}

        low, high = (None if b is None else torch.as_tensor(b)[place] for b in (parameter.low, parameter.high))
        own = Parameter(parameter.lr, start[self.name][place], low, high)
        return whole(self.steps(self.objective.reparametrized(whole), {self.name: own}))

    def _chances(self, values: Values) -> Tensor:
        """Return the chance of each limb, by how far pixels are from their pictures where it moves them."""
        off = self._off_contour(values) if self.by_contour else misfit(self.objective, values, 0)[self.name]
        by_row = off.reshape(len(off), -1).mean(1)
        found = torch.stack([by_row[limb.rows].mean() for limb in self.limbs]).square()
        return found + RIG.least_chance * found.max() + 1e-300

    def _cost(self, values: Values) -> float:
        return float(self._off_contour(values).mean()) if self.by_contour else self._loss(values, FIRST + OTHERS[:1])

    def _lower(self, found: Values, best: Values) -> bool:
        """Return whether a cost is lower than another one by more than noise."""
        if self.by_contour:
            return self._cost(found) < self._cost(best) - RIG.region_gain
        falls = torch.tensor([self._loss(best, (k,)) - self._loss(found, (k,)) for k in OTHERS], dtype=torch.float64)
        return float(falls.mean()) > RIG.deviations * float(falls.std()) / math.sqrt(len(falls))

    def _fitted(self, values: Values, most: float) -> bool:
        """Return whether pictures are explained but for so many times the noise. By regions there is none, and no finer level
        that draws limbs."""
        if self.by_contour:
            return most == RIG.fitted and float(self._off_contour(values).max()) < 1.0 - MIN_EDGE_SUPPORT
        return self._residual(values) < most

    def _residual(self, values: Values) -> float:
        with torch.no_grad():
            return self.objective.residual(values)

    def _loss(self, values: Values, seeds: Sequence[int]) -> float:
        with torch.no_grad():
            return sum(float(self.objective(values, k)) for k in seeds) / len(seeds)

    def _off_contour(self, values: Values) -> Tensor:
        """Return (rows,), how little of the contour the pictures show where each row moves it. Losses by regions are of other
        colours for other silhouettes."""
        self._renew(values)
        found = edge_support_by_joint(self.objective, values, {self.name: self.joints})
        return torch.tensor([1.0 - found.get(joint, 1.0) for joint in self.joints], dtype=torch.float64)

    def _renew(self, values: Values) -> None:
        self.objective.renew(values, FINAL_STEP)

    def _with(self, values: Values, turned: Tensor) -> Values:
        return {**values, self.name: self.parameters[self.name].within(turned)}


def _started(parameters: Mapping[str, Parameter], values: Values) -> dict[str, Parameter]:
    return {n: Parameter(p.lr, p.within(values[n]), p.low, p.high) for n, p in parameters.items()}
