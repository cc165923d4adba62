"""The search of fit_pose: Gauss-Newton from coarse to fine, and a second opinion where the picture does not show what it found.

The given start is followed first, and if the pictures show the render's edges where it ends, that is the answer. A way down may
end at a wrong pose that looks alike: then starts aside from the given one are followed on the coarsest level, which costs little,
and after them the best of many poses around. Renders are as soft as the pictures, and what blur and compression leave starts no
such search.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..edge_support import MIN_EDGE_SUPPORT, block_error, edge_amount, edge_support
from .gauss_newton import FIRST_DAMPING, MEMORY, PROBES_MEMORY, GaussNewton
from .journal import Journal, Way
from .observed import Observed
from .pose import Pose, angle
from .result import Step
from .robust import NARROWEST, NOISE, Comparison
from .soft import softness
from .task import GROW, PARTS, SHIFT, TURN, Level, PoseTask, blurred
from .uncertainty import TOGETHER

ASIDE, ASIDE_STEPS = 0.2, 20  # radians between the starts on the coarsest level, and steps from each
FINAL_SPP = 64  # samples a pixel when ends are compared
ROUNDS = 2  # of second opinions at most
# Where the means of blocks differ by more of the pictures' range, something covers the object, or a place nearby looks alike; but
# not where so much of the render's edges is in the pictures.
APART, CLEAR = 0.03, 0.9
ALMOST = 0.95  # as much of the edges, but for noise
HOPE = 0.4  # share of the edges on the second level, below which another way does not go on
# Of a second opinion: poses that are compared, how many of them take a few steps, and how many are followed further.
COMPARED, KEPT, FOLLOWED = 150, 4, 3
COMMON = 0.2  # c of losses that are compared, as a part of the pictures' range
FARTHEST, FARTHEST_SHIFT = 0.7, 0.15  # radians and object sizes of these from the start or the best pose
SOFTER = 0.25  # pixels: with a blur that is so far from the true one, the last level is followed again


class _Judged(NamedTuple):
    """A pose, by renders with many samples that are as soft as the pictures."""

    loss: float
    explained: float  # the share of the render's edges that the pictures show
    apart: float  # the means of blocks, as block_error() has them
    edges: float  # of the render, all together

    def beats(self, best: _Judged) -> bool:
        """Whether this is the better answer: its loss is lower, and it shows as much of the pictures' edges. What covers the
        object, or lights it, has a part in the loss that another place may lower, and most of all one out of view."""
        return self.loss < best.loss and self.explained * self.edges > ALMOST * best.explained * best.edges


class _End(NamedTuple):
    """Where a way down ended."""

    judged: _Judged  # on the finest level
    pose: Pose
    short: bool  # the last step


class Search:
    """The state of a search. `best`, `loss` and `history` may be read after each step, and `journal` at any time: a
    search that is given it goes on from there."""

    enough = MIN_EDGE_SUPPORT
    alike = ()  # what looks alike is not known

    def __init__(
        self, task: PoseTask, levels: list[Level], start: Pose, steps: int, tolerance: float, seed: int,
        journal: Journal | None = None, further: bool = True,
    ) -> None:  # fmt: skip
        """`further`: whether other starts follow where the way down from the given one does not end well."""
        self.task, self.levels, self.start = task, levels, start
        self.steps, self.tolerance, self.seed, self.further = steps, tolerance, seed, further
        self.generator = torch.Generator().manual_seed(seed)
        self.best, self.loss, self.converged, self.explained = start, math.nan, False, math.nan
        self.curvature: Tensor | None = None  # JᵀJ at the answer, in units that Uncertainty.of() takes
        self.history: list[Step] = []
        self.journal = journal or Journal()
        self.after_step: Callable[[], Any] = lambda: None
        self._answered = False  # later passes do not show until they win

    @property
    def planned(self) -> int:
        """Steps of the first way at most."""
        return self.steps * len(self.levels)

    def run(self) -> None:
        """Raises ValueError when nothing in the pictures depends on the pose."""
        coarse, *finer = self.levels
        near, *_ = self._follow(coarse, self.start, self.steps, math.inf)
        found = self._judge(*self._down(near, finer))
        if not self.history:
            raise ValueError(
                f"{self.task.names.init}: expected a pose at which the picture changes when the object moves, got one at which "
                "it does not; is the object out of view, or of the background's colour?"
            )
        # The same many samples for all: a fit never ends at a worse pose than its start.
        stays = found.short and len(distinct([found.pose, self.start], 2)) == 1  # the start was the answer already
        start = self._judge(self.start, stays)
        best = found if found.judged.beats(start.judged) else start
        self._take(best)
        if self.further and best.judged.explained < MIN_EDGE_SUPPORT:
            best = self._from_afar(best, near)
        deep = self.further and self.steps > ASIDE_STEPS
        if deep and MIN_EDGE_SUPPORT <= best.judged.explained < CLEAR and best.judged.apart > APART:
            begins = len(self.history)
            ends = self._ranked(finer[0], self._tilted(best.pose))
            self._better(best, self._judge(*self._down(ends[0], finer[1:])), begins)
        known = self.journal.numbers(self._information)
        self.curvature = torch.tensor(known, dtype=torch.float64).reshape((len(self.task.free),) * 2)
        self.history.append(Step(self.levels[-1].size, self.loss, self.best, True, {}))

    def _from_afar(self, best: _End, near: Pose) -> _End:
        """Ways from other starts, until one ends where the pictures show the render's edges. `near` is where the way from the
        start led on the coarsest level."""
        coarse, second, *_ = self.levels
        begins = len(self.history)
        ends = self._ranked(coarse, self._tilted(self.start)[1:], near)
        if ends[0] is not near:
            best = self._on(best, self._ranked(second, ends[:1]), begins)
        for _ in range(ROUNDS if self.steps > ASIDE_STEPS else 0):
            if best.judged.explained >= MIN_EDGE_SUPPORT:
                break
            begins = len(self.history)
            ends = distinct(self._ranked(coarse, [*self._others(best.pose), *ends[1:]]), FOLLOWED)
            ends = self._ranked(second, ends)
            best = self._on(best, ends, begins)
        return best

    def _on(self, best: _End, ends: list[Pose], begins: int) -> _End:
        """The answer, after a way further down from the best of the ends on the second level, if there is hope. Finer levels take
        the most time, and turn no wrong place into the right one."""
        _, second, *finest = self.levels
        (share,) = self.journal.numbers(lambda: [self._judged(ends[0], second).explained])
        if share >= HOPE:
            return self._better(best, self._judge(*self._down(ends[0], finest)), begins)
        self._forget(slice(begins, None))
        return best

    def first_end(self) -> float:
        """The share of the render's edges that the pictures show where the way down from the start alone ends."""
        coarse, second, *finest = self.levels
        pose = self.start
        for level in (coarse, second):
            pose, *_ = self._follow(level, pose, self.steps, math.inf)
        share = self._judged(pose, second).explained
        return share if share < HOPE else self._judge(*self._down(pose, finest)).judged.explained

    def _tilted(self, pose: Pose) -> list[Pose]:
        """The pose, and others turned aside from it."""
        tilts = ASIDE * torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], dtype=torch.float64)
        return [pose, *(self.task.moved(pose, [TURN, TURN + 1], tilt) for tilt in tilts)]

    def _better(self, best: _End, found: _End, begins: int) -> _End:
        """Which of both is the answer. `best` marks the way to it in the history, where that to `found` begins at `begins`."""
        won = found.judged.beats(best.judged)
        self._forget(slice(0, begins) if won else slice(begins, None))
        if won:
            self._take(found)
        return found if won else best

    def _forget(self, lost: slice) -> None:
        self.history[lost] = [step._replace(best=False) for step in self.history[lost]]

    def _take(self, end: _End) -> None:
        self.loss, self.explained, self.best, self._answered = end.judged.loss, end.judged.explained, end.pose, True
        self.converged = end.short and end.judged.explained >= MIN_EDGE_SUPPORT

    def _ranked(self, level: Level, starts: list[Pose], *ends: Pose) -> list[Pose]:
        """Where a few steps lead from each start, and ends of such, the best first."""
        found, lowest = list(ends), math.inf
        for origin in starts:
            end, loss, _ = self._follow(level, origin, min(self.steps, ASIDE_STEPS), lowest)
            found.append(end)
            lowest = min(lowest, loss)
        # Each followed a loss of its own width: here all have one.
        return self._sorted(level, found, level.spp)

    def _down(self, pose: Pose, levels: list[Level]) -> tuple[Pose, bool]:
        """Through the levels; the pose, and whether the last step was short."""
        *coarser, last = levels
        for level in coarser:
            pose, *_ = self._follow(level, pose, self.steps, math.inf)
        (soft,) = self.journal.numbers(lambda: [self._softness(pose)])
        pose, _, short = self._follow(last._replace(soft=soft), pose, self.steps, math.inf)
        (softer,) = self.journal.numbers(lambda: [self._softness(pose)])
        if abs(softer - soft) > SOFTER:  # it was looked for at another place
            pose, _, short = self._follow(last._replace(soft=softer), pose, self.steps, math.inf)
        return pose, short

    def _follow(self, level: Level, origin: Pose, most: int, lowest: float) -> tuple[Pose, float, bool]:
        """Steps on one level; the pose, its loss, and whether the last step was short."""
        task = self.task
        search = GaussNewton(PROBES_MEMORY if task.reverse_alone else MEMORY)
        last = level.shots is self.levels[-1].shots
        if (way := self.journal.entered()) is None:
            way = Way(origin, origin, lowest)
        else:
            search.load(way.search)
            self.generator.set_state(way.random)
            for step in way.steps:
                self._note(step)
        while not way.done:
            seed = (self.seed + len(self.history)) % 2**32
            seen = Observed(task, level, way.pose, level.spp, seed, self.generator)
            c = seen.compared.scale() if way.c == math.inf else way.c
            loss, slack = seen.compared.loss(c)
            if way.still:  # what rises there is noise
                slack = math.inf
            norms = {}
            if taken := search.observe(loss, partial(seen.equations, c, first=not search.accepted), slack):
                way = way._replace(here=way.pose)
                norms = norms_of(level.free, 2.0 / seen.compared.count * search.gradient)
                c = min(c, seen.compared.scale())
                search.loss = loss = seen.compared.loss(c)[0]
            way = way._replace(c=c, search=search.state(), random=self.generator.get_state())
            if search.flat:
                self.journal.keep(way := way._replace(done=True))
                break
            move = search.step()
            still = float(move.abs().max()) < self.tolerance * level.coarseness
            short = still and search.damping <= FIRST_DAMPING  # not for points that were turned down alone
            settled = search.settled and not last
            good = taken and loss <= way.lowest + NOISE * abs(way.lowest)
            step = Step(level.size, loss, way.pose, good, norms)
            way = way._replace(
                pose=task.moved(way.here, level.free, move), lowest=loss if good else way.lowest, short=short, still=still,
                done=short or settled or search.seen >= most, steps=(*way.steps, step),
            )  # fmt: skip
            self.journal.keep(way)
            self._note(step)
            self.after_step()
        return way.here, search.loss, way.short

    def _note(self, step: Step) -> None:
        if step.best and not self._answered:
            self.best, self.loss = step.pose, step.loss
        self.history.append(step)

    def _sharp(self, pose: Pose, level: Level) -> list[list[Tensor]]:
        """Layers of renders of two seeds with many samples."""
        seeds = self.seed, (self.seed + 1) % 2**32
        return [Observed(self.task, level, pose, FINAL_SPP, seed).compared.layers for seed in seeds]

    def _softness(self, pose: Pose) -> float:
        return softness(self.task, self.levels[-1], *self._sharp(pose, self.levels[-1]))

    def _information(self) -> list[float]:
        """JᵀJ at the best pose, by rows, by the variance of the residuals there, whose samples are as many as those of the steps.
        The search ends within its tolerance of where the loss is least, and knows the pose no better than that."""
        level = self.levels[-1]._replace(soft=self._softness(self.best))
        seen = Observed(self.task, level, self.best, level.spp, self.seed, self.generator)
        c = seen.compared.scale()
        curvature = seen.equations(c, first=True).curvature / max(seen.compared.variance(c), 1e-30)
        values, ways = torch.linalg.eigh(0.5 * (curvature + curvature.T))
        known = (values.clamp(min=1e-30).reciprocal() + self.tolerance**2).reciprocal()
        return (TOGETHER**2 * (ways * known) @ ways.T).flatten().tolist()

    def _judge(self, pose: Pose, short: bool) -> _End:
        """With many samples on the finest level."""
        numbers = self.journal.numbers(lambda: list(self._judged(pose, self.levels[-1])))
        return _End(_Judged(*numbers), pose, short)

    def _judged(self, pose: Pose, level: Level) -> _Judged:
        task, sharp = self.task, self._sharp(pose, level)
        soft = softness(task, level, *sharp)
        first, second = (Comparison(task, level, [blurred(layer, soft) for layer in layers]) for layers in sharp)
        pairs = []
        for shot, a, b in zip(level.shots, first.renders, second.renders, strict=True):
            weight = shot.weight
            if self.task.clutter:
                outside = (a[..., -1] < 0.999).to(a)  # and what lies beside it, whose gradient reaches there
                inside = 1.0 - F.max_pool2d(outside[None, None], 3, stride=1, padding=1)[0, 0][..., None]
                weight = inside if weight is None else weight * inside
                a, b = a[..., :-1], b[..., :-1]
            pairs.append((a, b, shot.target, weight))
        loss = first.loss(NARROWEST * task.extent)[0]
        return _Judged(loss, edge_support(pairs), block_error(pairs), edge_amount(pairs))

    def _others(self, best: Pose) -> list[Pose]:
        """The few best of many poses around the start and the best one, by their loss on the coarsest level."""
        level, drawn = self.levels[0], []
        entries = [entry for entry in range(TURN, GROW) if entry in self.task.free]
        for k in range(COMPARED):
            p = torch.zeros(GROW, dtype=torch.float64)
            p[TURN:SHIFT] = FARTHEST * self._ball()
            p[SHIFT:GROW] = FARTHEST_SHIFT * self._ball()
            drawn.append(self.task.moved(self.start if k % 2 else best, entries, p[entries]))
        return distinct(self._sorted(level, drawn, max(4, level.spp // 16)), KEPT)

    def _sorted(self, level: Level, poses: list[Pose], spp: int) -> list[Pose]:
        """By their loss, the least first."""
        c = COMMON * self.task.extent
        losses = self.journal.numbers(
            lambda: [Observed(self.task, level, pose, spp, self.seed).compared.loss(c)[0] for pose in poses]
        )
        return [poses[k] for k in sorted(range(len(poses)), key=losses.__getitem__)]

    def _ball(self) -> Tensor:
        """(3,) even in a ball of radius 1."""
        direction = torch.randn(3, generator=self.generator, dtype=torch.float64)
        radius = torch.rand((), generator=self.generator, dtype=torch.float64) ** (1 / 3)
        return radius * direction / direction.norm()


def norms_of(free: list[int], gradient: Tensor) -> dict[str, float]:
    """Of each part of a step whose entries are `free`."""
    squares = dict(zip(free, gradient.square().tolist(), strict=True))
    sums = {name: [squares[entry] for entry in entries if entry in squares] for name, entries in PARTS.items()}
    return {name: math.sqrt(sum(part)) for name, part in sums.items() if part}


def distinct(poses: list[Pose], most: int, apart: float = 0.5 * ASIDE) -> list[Pose]:
    """The first ones that are turned apart from one another, by so many radians."""
    kept: list[Pose] = []
    for pose in poses:
        if len(kept) < most and all(angle(pose.R, other.R) > apart for other in kept):
            kept.append(pose)
    return kept
