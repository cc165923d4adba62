"""Poses of a rig that a descent from the start does not reach: limbs drawn anew, where that lowers the loss.

Silhouettes say little of which limb they show, so that a descent ends where one of them lies in the place of another. Limbs, a
joint and all below it, are turned at random, most often those about which pixels are off; the best of many turns go down a few
steps by the limb's own numbers, which is cheap, then by all, and the result is kept where the loss is lower than before. The
search ends where what is left of the loss is the noise of its samples.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from ...rig.rig import Rig
from ..descent.curvature import misfit, residuals
from ..descent.objective import Objective
from ..descent.region_loss import FINAL_STEP
from ..edge_support import MIN_EDGE_SUPPORT
from ..options import Parameter
from .alternatives import Alternatives
from .shown import explained_by_joint

DRAWS = 64  # turns of a limb that are looked at
SPREADS = 0.2, 0.4  # radians, of each component, by turns
SHARE = 0.4  # of all rows: a joint with more below it is turned alone
EXPLAINED = 1.5  # of the loss by noise alone: less is not to be mended
NEARLY = 4.0  # and less than this is left to a finer level, once
IDLE, FALL = 6, 0.05  # so many tries one after the other have not lowered the loss by this part
APART = 0.3  # radians of a joint at least, by which a turn is another place
TWISTS = -0.7, -0.35, 0.35, 0.7  # radians
SWEEPS, WORST = 2, 5  # and the joints in each, where most is left of the pictures in units of noise
STARTS = 2  # of the turns, that go down
LEAST = 0.05  # of the largest chance of a limb to be drawn
SEEDS = 0, 1  # by which losses are compared
Values = dict[str, Tensor]


@dataclass(frozen=True)
class Limb:
    """Rows that are drawn together."""

    rows: list[int]
    twins: tuple[list[int], list[int]] | None = None  # where they are two limbs of one build: their rows


def limbs(rig: Rig, rows: Sequence[int]) -> list[Limb]:
    """Of the joints `rows`, each with those below it, as places in `rows`; and pairs that hang on one joint, as two legs do."""
    parents, whole, found = rig.deformer.parents, {}, []
    for row in rows:
        group = []
        for place, other in enumerate(rows):
            at = other
            while at >= 0 and at != row:
                at = parents[at]
            if at == row:
                group.append(place)
        if len(group) <= max(1.0, SHARE * len(rows)):
            whole[row] = group
        found.append(Limb(whole.get(row, [list(rows).index(row)])))
    for a, b in itertools.combinations(whole, 2):
        one, other = whole[a], whole[b]
        if parents[a] == parents[b] and len(one) > 1 and _hung(parents, rows, one) == _hung(parents, rows, other):
            found.append(Limb([*one, *other], (one, other)))
    return found


def _hung(parents: Sequence[int], rows: Sequence[int], limb: Sequence[int]) -> list[int]:
    """Of each joint of a limb, which of these it hangs on, −1 of none."""
    places = {rows[place]: k for k, place in enumerate(limb)}
    return [places.get(parents[rows[place]], -1) for place in limb]


class Judge(Protocol):
    """Which of two poses is better, and whether one is good."""

    @property
    def worse(self) -> float:
        """Factor of the least cost, from which no way down is tried."""
        ...

    @property
    def gain(self) -> float:
        """By how much the cost must fall."""
        ...

    def cost(self, values: Values) -> float: ...

    def explained(self, values: Values) -> bool: ...

    def nearly(self, values: Values) -> bool:
        """Whether it is explained but for what a finer level tells better."""
        ...

    def off(self, values: Values) -> Tensor:
        """(rows, …): how wrong the pictures are where each row of the value that is searched moves them."""
        ...

    def renew(self, values: Values) -> None:
        """What losses of poses that are compared hold fixed is what it is at these values."""
        ...


@dataclass(frozen=True)
class ByLoss:
    """Poses by their loss: pictures and masks that the rig explains but for noise."""

    objective: Objective
    name: str
    worse: float = 2.0
    gain: float = 0.0

    def cost(self, values: Values) -> float:
        return loss_of(self.objective, values)

    def explained(self, values: Values) -> bool:
        return self._left(values) < EXPLAINED

    def nearly(self, values: Values) -> bool:
        return self._left(values) < NEARLY

    def _left(self, values: Values) -> float:
        with torch.no_grad():
            return self.objective.residual(values)

    def off(self, values: Values) -> Tensor:
        return misfit(self.objective, values, 0)[self.name]

    def renew(self, values: Values) -> None:
        pass


@dataclass(frozen=True)
class ByContour:
    """Poses by how much of the contours of their limbs the pictures show: by regions, whose losses of different silhouettes are
    none of the same colours."""

    objective: Objective
    name: str
    joints: Sequence[str]
    worse: float = math.inf
    gain: float = 0.05

    def cost(self, values: Values) -> float:
        return float(self.off(values).mean())

    def explained(self, values: Values) -> bool:
        return float(self.off(values).max()) < 1.0 - MIN_EDGE_SUPPORT

    def nearly(self, values: Values) -> bool:
        return False  # no finer level draws limbs anew

    def off(self, values: Values) -> Tensor:
        self.renew(values)
        found = explained_by_joint(self.objective, values, {self.name: self.joints})
        return torch.tensor([1.0 - found.get(joint, 1.0) for joint in self.joints], dtype=torch.float64)

    def renew(self, values: Values) -> None:
        self.objective.renew(values, FINAL_STEP)


def loss_of(objective: Objective, values: Values, seeds: Sequence[int] = SEEDS) -> float:
    with torch.no_grad():
        return sum(float(objective(values, k)) for k in seeds) / len(seeds)


@dataclass
class Search:
    """At groups of rows of one of the values.

    steps  goes down from the values of parameters, of an objective
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
    tell: Callable[[], Any] = lambda: None
    generator: torch.Generator = field(init=False)

    def run(self, values: Values, tries: int) -> Values:
        """The best values of so many tries."""
        if self.judge.explained(values):
            return values
        self.generator = torch.Generator().manual_seed(self.seed)
        best = values, self.judge.cost(values)
        for pair in self.groups:
            if pair.twins is not None:
                start = {**best[0], self.name: self.within(self.alternatives.exchanged(best[0], *pair.twins))}
                best = self.better(best, [start], pair)
        chances, idle = self.chances(best[0]), 0
        for _ in range(0 if self.judge.explained(best[0]) else tries):
            limb = self.groups[int(torch.multinomial(chances, 1, generator=self.generator))]
            found = self.better(best, self.drawn(best[0], limb), limb)
            idle = 0 if found[1] < (1.0 - FALL) * best[1] else idle + 1
            if found is not best:
                best = found
                if self.judge.explained(best[0]):
                    break
                chances = self.chances(best[0])
            self.tell()
            if idle >= IDLE and self.judge.nearly(best[0]):
                break
        self.judge.renew(best[0])
        return best[0]

    def twisted(self, values: Values) -> Values:
        """Twists that joints of a limb share in another way, from which the limb goes down by itself, as long as the pictures
        are not explained."""
        twists = [twist for twist in self.alternatives.twists(values) if twist.child is not None]
        if not twists or self.judge.explained(values):
            return values
        best, least = values, self.judge.cost(values)
        for _ in range(SWEEPS):
            remaining, before = residuals(self.objective, best, 0)[self.name].mean(1), least
            for twist in sorted(twists, key=lambda twist: -float(remaining[twist.row]))[:WORST]:
                if self.judge.explained(best):
                    return best
                rows = {twist.row, twist.child}
                among = [limb for limb in self.groups if limb.twins is None and rows <= set(limb.rows)]
                if among:
                    turned = [self.within(self.alternatives.twisted(best, twist, angle)) for angle in TWISTS]
                    starts = [{**best, self.name: value} for value in turned]
                    start = min(starts, key=lambda start: loss_of(self.objective, start, SEEDS[:1]))
                    found = self.alone(start, max(among, key=lambda limb: len(limb.rows)))
                    if (now := self.judge.cost(found)) < least:
                        best, least = found, now
            if least == before:
                break
        return best

    def better(self, best: tuple[Values, float], starts: Sequence[Values], limb: Limb) -> tuple[Values, float]:
        """What starts of a limb lead to, where its cost is lower than that of the best so far; else that."""
        values, least = best
        self.judge.renew(values)
        found = min((self.alone(start, limb) for start in starts), key=self.judge.cost, default=None)
        # What lies in the limb's true place must often leave it before the loss is lower.
        if found is not None and self.judge.cost(found) < self.judge.worse * least:
            found = self.steps(self.objective, self.started(found))
            if (now := self.judge.cost(found)) < least - self.judge.gain:
                return found, now
        return best

    def chances(self, values: Values) -> Tensor:
        """Of each limb, by how far pixels are from their pictures where it moves them."""
        by_row = self.judge.off(values)
        by_row = by_row.reshape(len(by_row), -1).mean(1)
        found = torch.stack([by_row[limb.rows].mean() for limb in self.groups]).square()
        return found + LEAST * found.max() + 1e-300

    def drawn(self, values: Values, limb: Limb) -> list[Values]:
        """With a limb turned at random: the best of many turns that are not about where it is."""
        now, low = values[self.name], []
        across = now if limb.twins is None else self.alternatives.exchanged(values, *limb.twins)
        for k in range(DRAWS):
            turned = now.clone()
            if limb.twins is not None and k % 2:
                turned = across.clone()
            # Half of them from rest, half from where it is; some turn the first joint alone.
            chosen = limb.rows[: 1 if k % 4 > 1 else None]
            middle = turned[chosen] if k % 8 < 4 else self.rest[chosen].to(turned)
            turned[chosen] = middle + SPREADS[k % 3 % 2] * torch.randn(
                middle.shape, generator=self.generator, dtype=turned.dtype
            )
            start = {**values, self.name: self.within(turned)}
            if float((start[self.name] - now)[limb.rows].reshape(len(limb.rows), -1).norm(dim=1).max()) > APART:
                low.append((loss_of(self.objective, start, SEEDS[:1]), k, start))
        return [start for _, _, start in sorted(low)[:STARTS]]

    def alone(self, start: Values, limb: Limb) -> Values:
        """A limb's way down from there, by its own numbers."""
        place, parameter = torch.tensor(limb.rows), self.parameters[self.name]

        def whole(own: Mapping[str, Tensor]) -> Values:
            value, part = start[self.name], own[self.name]
            at = part.dim() - value.dim()
            return {
                **start,
                self.name: value.expand(*part.shape[:at], *value.shape).index_copy(at, place, part),
            }

        low, high = (None if b is None else torch.as_tensor(b)[place] for b in (parameter.low, parameter.high))
        own = Parameter(parameter.lr, start[self.name][place], low, high)
        return whole(self.steps(self.objective.reparametrized(whole), {self.name: own}))

    def within(self, value: Tensor) -> Tensor:
        return self.parameters[self.name].within(value)

    def started(self, values: Values) -> dict[str, Parameter]:
        return {n: Parameter(p.lr, p.within(values[n]), p.low, p.high) for n, p in self.parameters.items()}
