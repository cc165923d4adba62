"""Hypotheses about limbs: poses that a descent does not reach, where they lower the cost of a level.

Silhouettes hardly show which limb is where, so a descent ends where one lies in the place of another. Hypotheses are exchanged
limbs, limbs that are rotated at random, most often those about which pixels are off, and rotations about bones. Their costs on
the level are compared. The likeliest are refined by the limb's own numbers, which is cheap, and the best of these by all. It is
kept where its cost is lower by more than the noise of samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from tqdm import tqdm

from ...optim.parameter import Parameter
from ..descent.curvature import misfit
from ..descent.objective import Objective
from ..descent.region_loss import FINAL_STEP
from ..edge_support import MIN_EDGE_SUPPORT
from .free_parameters import rows_of, with_rows
from .joint_support import edge_support_by_joint
from .proposals import Limb, Proposals
from .settings import RIG

Values = dict[str, Tensor]
FIRST, OTHERS = (0,), (1, 2, 3)  # sets of samples: by the first hypotheses are chosen, by the others they are tested


@dataclass(frozen=True)
class HypothesisSearch:
    """The search on one level. `steps` descends from the values of parameters of an objective."""

    objective: Objective
    proposals: Proposals
    steps: Callable[[Objective, Mapping[str, Parameter]], Values]
    generator: torch.Generator

    @property
    def name(self) -> str:
        """The name of the value that is searched."""
        return self.proposals.name

    @property
    def parameter(self) -> Parameter:
        return self.proposals.free.parameters[self.name]

    @property
    def by_contour(self) -> bool:
        """Whether contours are compared, for losses by regions are of other colours for other silhouettes."""
        return self.objective.regions is not None

    def draw_limbs(self, values: Values, tries: int, progress: bool = False) -> Values:
        """Return the best values after exchanges of limbs, and so many draws."""
        best, limbs = values, self.proposals.limbs
        if self._fitted(best):
            return best
        for limb in limbs:
            if limb.twins is not None:
                best = self._refined(best, [self.proposals.exchanged(best, *limb.twins)], limb.rows)
        for _ in tqdm(range(tries), "limbs drawn", disable=not progress, leave=False):
            if self._fitted(best):
                break
            limb = limbs[int(torch.multinomial(self._chances(best), 1, generator=self.generator))]
            best = self._refined(best, self._drawn(best, limb), limb.rows)
        self._renew(best)
        return best

    def rotate_about_bones(self, values: Values) -> Values:
        """Return the best values after rotations about bones. These change a loss so little, and so far from quadratically,
        that steps stop 10° from its minimum, and a flat hand has a second minimum across its place."""
        best, rotations = values, self.proposals.axial_rotations(values)
        shared = [one for one in rotations if one.child is not None]
        limbs = [limb.rows for limb in self.proposals.limbs if limb.twins is None]
        for _ in range(RIG.sweeps if shared else 0):
            off = misfit(self.objective, best, 0)[self.name].mean(1)
            for one in sorted(shared, key=lambda one: -float(off[one.row]))[: RIG.worst_joints]:
                around = [rows for rows in limbs if {one.row, one.child} <= {*rows}]
                if around and not self._fitted(best):
                    (far,) = self._likeliest(self.proposals.about_bone(best, one, RIG.far_angles), best, 1)
                    found = self._alone(far, max(around, key=len))
                    best = found if self._cost(found) < self._cost(best) else best
        for one in rotations:
            (near,) = self._likeliest(self.proposals.about_bone(best, one, RIG.axial_angles), best, 1)
            best = near if self._lower(near, best) else best
        return best

    def _likeliest(self, turned: Sequence[Tensor], values: Values, count: int) -> list[Values]:
        """Return the `count` hypotheses of the lowest costs."""
        starts = [{**values, self.name: self.parameter.within(one)} for one in turned]
        return sorted(starts, key=lambda start: self._loss(start, FIRST))[:count]

    def _refined(self, best: Values, turned: Sequence[Tensor], rows: list[int]) -> Values:
        """Return what the likeliest hypotheses lead to, by their rows and then by all, or the best so far."""
        self._renew(best)
        likeliest = self._likeliest(turned, best, RIG.kept)
        found = min((self._alone(start, rows) for start in likeliest), key=self._cost, default=best)
        # Another limb in the true place must often leave it before the loss falls.
        if self.by_contour or self._cost(found) < RIG.most_worse * self._cost(best):
            found = self.steps(self.objective, self.proposals.free.starting_at(found))
        return found if self._lower(found, best) else best

    def _drawn(self, values: Values, limb: Limb) -> list[Tensor]:
        """Return random rotations of a limb that are not about where it is."""
        now, found = values[self.name], []
        across = now if limb.twins is None else self.proposals.exchanged(values, *limb.twins)
        for k in range(RIG.draws):
            turned = (across if k % 2 else now).clone()
            # Half of them start from rest, half from where the limb is; some rotate the first joint alone.
            chosen = limb.rows[: 1 if k % 4 > 1 else None]
            middle = turned[chosen] if k % 8 < 4 else self.proposals.rest[chosen].to(turned)
            noise = torch.randn(middle.shape, generator=self.generator, dtype=turned.dtype)
            turned[chosen] = middle + RIG.spreads[k % 3 % 2] * noise
            moved = (self.parameter.within(turned) - now)[limb.rows].reshape(len(limb.rows), -1).norm(dim=1)
            found += [turned] if float(moved.max()) > RIG.least_move else []
        return found

    def _alone(self, start: Values, rows: list[int]) -> Values:
        """Refine rows by their own numbers."""
        place, value = torch.tensor(rows), start[self.name]

        def whole(own: Mapping[str, Tensor]) -> Values:
            return {**start, self.name: with_rows(value, place, own[self.name])}

        own = rows_of(replace(self.parameter, value=value), place)
        return whole(self.steps(self.objective.reparametrized(whole), {self.name: own}))

    def _chances(self, values: Values) -> Tensor:
        """Return the chance of each limb, by how far pixels are from their pictures where it moves them."""
        off = self._off_contour(values) if self.by_contour else misfit(self.objective, values, 0)[self.name]
        by_row = off.reshape(len(off), -1).mean(1)
        found = torch.stack([by_row[limb.rows].mean() for limb in self.proposals.limbs]).square()
        return found + RIG.least_chance * found.max() + 1e-300

    def _cost(self, values: Values) -> float:
        return float(self._off_contour(values).mean()) if self.by_contour else self._loss(values, FIRST + OTHERS[:1])

    def _lower(self, found: Values, best: Values) -> bool:
        """Return whether a cost is lower than another one by more than noise."""
        if self.by_contour:
            return self._cost(found) < self._cost(best) - RIG.region_gain
        falls = torch.tensor([self._loss(best, (k,)) - self._loss(found, (k,)) for k in OTHERS], dtype=torch.float64)
        return float(falls.mean()) > RIG.deviations * float(falls.std()) / math.sqrt(len(falls))

    def _fitted(self, values: Values) -> bool:
        """Return whether the pictures show what they should, but for noise; by regions the contours of all joints."""
        if self.by_contour:
            return float(self._off_contour(values).max()) < 1.0 - MIN_EDGE_SUPPORT
        with torch.no_grad():
            return self.objective.residual(values) < RIG.fitted

    def _loss(self, values: Values, seeds: Sequence[int]) -> float:
        with torch.no_grad():
            return sum(float(self.objective(values, k)) for k in seeds) / len(seeds)

    def _off_contour(self, values: Values) -> Tensor:
        """Return (rows,), how little of the contour the pictures show where each row moves it."""
        self._renew(values)
        joints = self.proposals.free.joints[self.name]
        found = edge_support_by_joint(self.objective, values, {self.name: joints})
        return torch.tensor([1.0 - found.get(joint, 1.0) for joint in joints], dtype=torch.float64)

    def _renew(self, values: Values) -> None:
        self.objective.renew(values, FINAL_STEP)
