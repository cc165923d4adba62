"""Poses of a rig that a descent from the start does not reach: random limbs, where they lower the loss.

Silhouettes hardly show which limb is where, so a descent ends where one of them lies in the place of another. Limbs, a joint
and all below it, are rotated at random, most often those about which pixels are off. The best of many rotations take a few
steps by the limb's own numbers, which is cheap, then by all, and the result is kept where the loss is lower than before. The
search ends where the remaining loss is the noise of its samples.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ...rig.rig import Rig
from ..descent.curvature import misfit, residuals
from ..descent.objective import Objective
from ..descent.region_loss import FINAL_STEP
from ..edge_support import MIN_EDGE_SUPPORT
from ..parameter import Parameter
from .alternatives import Alternatives
from .joint_support import edge_support_by_joint

DRAWS = 64  # rotations of a limb that are compared
SPREADS = 0.2, 0.4  # radians, of each component, alternating
MAX_LIMB_SHARE = 0.4  # A joint with more of all rows below it is rotated alone.
FITTED_LOSS = 1.5  # relative to the loss by noise alone
NEARLY_FITTED_LOSS = 4.0  # A smaller loss is left to a finer level after IDLE tries that lowered it by less than FALL.
IDLE, FALL = 6, 0.05
MIN_JOINT_MOVE = 0.3  # least rotation of a joint, in radians, that counts as another place
AXIAL_ANGLES = -0.7, -0.35, 0.35, 0.7  # radians
SWEEPS, WORST_JOINTS = 2, 5  # sweeps, and joints in each: those with the largest residuals in units of noise
REFINED_DRAWS = 2
MIN_CHANCE = 0.05  # relative to the largest chance of a limb to be drawn
COMPARED_SEEDS = 0, 1  # for comparing losses
Values = dict[str, Tensor]


@dataclass(frozen=True)
class Limb:
    """Rows that are drawn together."""

    rows: list[int]
    twins: tuple[list[int], list[int]] | None = None  # rows of two limbs of one build


def limbs(rig: Rig, rows: Sequence[int]) -> list[Limb]:
    """Return each of the joints `rows` with those below it, as places in `rows`; and pairs that hang on one joint, as two
    legs do."""
    parents, whole, found = rig.deformer.parents, {}, []
    for row in rows:
        group = []
        for place, other in enumerate(rows):
            at = other
            while at >= 0 and at != row:
                at = parents[at]
            if at == row:
                group.append(place)
        if len(group) <= max(1.0, MAX_LIMB_SHARE * len(rows)):
            whole[row] = group
        found.append(Limb(whole.get(row, [list(rows).index(row)])))
    for a, b in itertools.combinations(whole, 2):
        one, other = whole[a], whole[b]
        if parents[a] == parents[b] and len(one) > 1 and _hung(parents, rows, one) == _hung(parents, rows, other):
            found.append(Limb([*one, *other], (one, other)))
    return found


def _hung(parents: Sequence[int], rows: Sequence[int], limb: Sequence[int]) -> list[int]:
    """Return for each joint of a limb which of these it hangs on, −1 for none."""
    places = {rows[place]: k for k, place in enumerate(limb)}
    return [places.get(parents[rows[place]], -1) for place in limb]


@dataclass(frozen=True)
class ByLoss:
    """Compare poses by their loss: pictures and masks that the rig matches but for noise."""

    objective: Objective
    name: str
    worse: float = 2.0  # A start whose cost exceeds the least by a larger factor is not refined.
    gain: float = 0.0  # least decrease of the cost

    def cost(self, values: Values) -> float:
        return loss_of(self.objective, values)

    def matches(self, values: Values) -> bool:
        return self._residual(values) < FITTED_LOSS

    def nearly_matches(self, values: Values) -> bool:
        return self._residual(values) < NEARLY_FITTED_LOSS

    def _residual(self, values: Values) -> float:
        with torch.no_grad():
            return self.objective.residual(values)

    def off(self, values: Values) -> Tensor:
        return misfit(self.objective, values, 0)[self.name]

    def renew(self, values: Values) -> None:
        pass


@dataclass(frozen=True)
class ByContour:
    """Compare poses by how much of their limbs' contours the pictures show: losses by regions are of different colours for
    different silhouettes."""

    objective: Objective
    name: str
    joints: Sequence[str]
    worse: float = math.inf
    gain: float = 0.05

    def cost(self, values: Values) -> float:
        return float(self.off(values).mean())

    def matches(self, values: Values) -> bool:
        return float(self.off(values).max()) < 1.0 - MIN_EDGE_SUPPORT

    def nearly_matches(self, values: Values) -> bool:
        return False  # No finer level draws limbs.

    def off(self, values: Values) -> Tensor:
        """Return (rows, …), how wrong the pictures are where each row of the sought value moves them."""
        self.renew(values)
        found = edge_support_by_joint(self.objective, values, {self.name: self.joints})
        return torch.tensor([1.0 - found.get(joint, 1.0) for joint in self.joints], dtype=torch.float64)

    def renew(self, values: Values) -> None:
        """Compute what losses of compared poses hold fixed at these values."""
        self.objective.renew(values, FINAL_STEP)


Judge = ByLoss | ByContour


def loss_of(objective: Objective, values: Values, seeds: Sequence[int] = COMPARED_SEEDS) -> float:
    with torch.no_grad():
        return sum(float(objective(values, k)) for k in seeds) / len(seeds)


@dataclass
class LimbSearch:
    """A search at groups of rows of one of the values.

    steps  descends from the values of parameters of an objective
    """

    objective: Objective
    judge: Judge
    name: str
    groups: Sequence[Limb]
    parameters: Mapping[str, Parameter]
    rest: Tensor
    alternatives: Alternatives
    steps: Callable[[Objective, Mapping[str, Parameter]], Values]
    seed: int
    report: Callable[[], Any] = lambda: None
    generator: torch.Generator = field(init=False)

    def run(self, values: Values, tries: int) -> Values:
        """Return the best values of so many tries."""
        if self.judge.matches(values):
            return values
        self.generator = torch.Generator().manual_seed(self.seed)
        best = values, self.judge.cost(values)
        for pair in self.groups:
            if pair.twins is not None:
                start = {**best[0], self.name: self.within(self.alternatives.exchanged(best[0], *pair.twins))}
                best = self.better(best, [start], pair)
        chances, idle = self.chances(best[0]), 0
        for _ in range(0 if self.judge.matches(best[0]) else tries):
            limb = self.groups[int(torch.multinomial(chances, 1, generator=self.generator))]
            found = self.better(best, self.drawn(best[0], limb), limb)
            idle = 0 if found[1] < (1.0 - FALL) * best[1] else idle + 1
            if found is not best:
                best = found
                if self.judge.matches(best[0]):
                    break
                chances = self.chances(best[0])
            self.report()
            if idle >= IDLE and self.judge.nearly_matches(best[0]):
                break
        self.judge.renew(best[0])
        return best[0]

    def rotated(self, values: Values) -> Values:
        """Try axial rotations that joints of a limb share otherwise, each followed by the limb's own steps, until the
        pictures match."""
        rotations = [one for one in self.alternatives.axial_rotations(values) if one.child is not None]
        if not rotations or self.judge.matches(values):
            return values
        best, least = values, self.judge.cost(values)
        for _ in range(SWEEPS):
            remaining, before = residuals(self.objective, best, 0)[self.name].mean(1), least
            for rotation in sorted(rotations, key=lambda one: -float(remaining[one.row]))[:WORST_JOINTS]:
                if self.judge.matches(best):
                    return best
                rows = {rotation.row, rotation.child}
                among = [limb for limb in self.groups if limb.twins is None and rows <= set(limb.rows)]
                if among:
                    rotate = partial(self.alternatives.with_rotation, best, rotation)
                    starts = [{**best, self.name: self.within(rotate(angle))} for angle in AXIAL_ANGLES]
                    start = min(starts, key=lambda start: loss_of(self.objective, start, COMPARED_SEEDS[:1]))
                    found = self.alone(start, max(among, key=lambda limb: len(limb.rows)))
                    if (now := self.judge.cost(found)) < least:
                        best, least = found, now
            if least == before:
                break
        return best

    def better(self, best: tuple[Values, float], starts: Sequence[Values], limb: Limb) -> tuple[Values, float]:
        """Return what starts of a limb lead to, where its cost is lower than that of the best so far; else that."""
        values, least = best
        self.judge.renew(values)
        found = min((self.alone(start, limb) for start in starts), key=self.judge.cost, default=None)
        # Another limb in the true place must often leave it before the loss falls.
        if found is not None and self.judge.cost(found) < self.judge.worse * least:
            found = self.steps(self.objective, self.started(found))
            if (now := self.judge.cost(found)) < least - self.judge.gain:
                return found, now
        return best

    def chances(self, values: Values) -> Tensor:
        """Return the chance of each limb, by how far pixels are from their pictures where it moves them."""
        by_row = self.judge.off(values)
        by_row = by_row.reshape(len(by_row), -1).mean(1)
        found = torch.stack([by_row[limb.rows].mean() for limb in self.groups]).square()
        return found + MIN_CHANCE * found.max() + 1e-300

    def drawn(self, values: Values, limb: Limb) -> list[Values]:
        """Return the best of many random rotations of a limb that are not about where it is."""
        now, low = values[self.name], []
        across = now if limb.twins is None else self.alternatives.exchanged(values, *limb.twins)
        for k in range(DRAWS):
            turned = now.clone()
            if limb.twins is not None and k % 2:
                turned = across.clone()
            # Half of them start from rest, half from where the limb is; some rotate the first joint alone.
            chosen = limb.rows[: 1 if k % 4 > 1 else None]
            middle = turned[chosen] if k % 8 < 4 else self.rest[chosen].to(turned)
            noise = torch.randn(middle.shape, generator=self.generator, dtype=turned.dtype)
            turned[chosen] = middle + SPREADS[k % 3 % 2] * noise
            start = {**values, self.name: self.within(turned)}
            moved = (start[self.name] - now)[limb.rows].reshape(len(limb.rows), -1).norm(dim=1)
            if float(moved.max()) > MIN_JOINT_MOVE:
                low.append((loss_of(self.objective, start, COMPARED_SEEDS[:1]), k, start))
        return [start for _, _, start in sorted(low)[:REFINED_DRAWS]]

    def alone(self, start: Values, limb: Limb) -> Values:
        """Refine a limb from there by its own numbers."""
        place, parameter = torch.tensor(limb.rows), self.parameters[self.name]

        def whole(own: Mapping[str, Tensor]) -> Values:
            value, part = start[self.name], own[self.name]
            at = part.dim() - value.dim()
            moved = value.expand(*part.shape[:at], *value.shape).index_copy(at, place, part)
            return {**start, self.name: moved}

        low, high = (None if b is None else torch.as_tensor(b)[place] for b in (parameter.low, parameter.high))
        own = Parameter(parameter.lr, start[self.name][place], low, high)
        return whole(self.steps(self.objective.reparametrized(whole), {self.name: own}))

    def within(self, value: Tensor) -> Tensor:
        return self.parameters[self.name].within(value)

    def started(self, values: Values) -> dict[str, Parameter]:
        return {n: Parameter(p.lr, p.within(values[n]), p.low, p.high) for n, p in self.parameters.items()}
