"""The search of fit_pose: Gauss-Newton from coarse to fine, and a second opinion where the picture does not show what it found.

A way down from a start may end at a wrong pose that looks alike. The coarsest level costs little, so there the search begins from
several starts; and where the pictures do not show the render's edges at the end, it begins again from the best of many poses
around the start.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..verdict import ENOUGH, explained, noise_of
from .gauss_newton import GaussNewton
from .journal import Journal, Way
from .pose import Pose, angle
from .result import Step
from .robust import NARROWEST, NOISE, Comparison
from .task import GROW, PARTS, SHIFT, TURN, Level, PoseTask

ASIDE, ASIDE_STEPS = 0.2, 20  # radians between the starts on the coarsest level, and steps from each
FINAL_SPP = 64  # samples a pixel when ends are compared
ROUNDS = 2  # of second opinions at most
FAR_ABOVE = 4.0  # the noise: a loss that this does not explain, beside what is covered, may be that of a place nearby
LOOKS, KEPT, FOLLOWED = (
    150,
    4,
    3,
)  # poses that a second opinion looks at, how many it follows a few steps, and how many more
COMMON = 0.2  # c of losses that are compared, as a part of the pictures' range
FARTHEST, FARTHEST_SHIFT = 0.7, 0.15  # radians and object sizes of these from the start or the best pose


class _End(NamedTuple):
    """Where a way down ended."""

    loss: float  # on the finest level, with many samples
    explained: float  # the share of the render's edges that the pictures show
    noise: float  # the loss that the noise of pictures and samples explains
    pose: Pose
    short: bool  # the last step


class Search:
    """The state of a search. `best`, `loss` and `history` may be read after each step, and `journal` at any time: a
    search that is given it goes on from there."""

    def __init__(
        self, task: PoseTask, levels: list[Level], start: Pose, steps: int, tolerance: float, seed: int,
        journal: Journal | None = None,
    ) -> None:  # fmt: skip
        self.task, self.levels, self.start = task, levels, start
        self.steps, self.tolerance, self.seed = steps, tolerance, seed
        self.generator = torch.Generator().manual_seed(seed)
        self.best, self.loss, self.converged, self.explained = start, math.nan, False, math.nan
        self.history: list[Step] = []
        self.journal = journal or Journal()
        self.after_step: Callable[[], Any] = lambda: None
        self._answered = False  # later passes do not show until they win

    @property
    def planned(self) -> int:
        """Steps of the first pass at most."""
        return 5 * min(self.steps, ASIDE_STEPS) + self.steps * (len(self.levels) - 1)

    def run(self) -> None:
        """Raises ValueError when nothing in the pictures depends on the pose."""
        coarse, *finer = self.levels
        ends = self._ranked(coarse, self._tilted(self.start))
        if not self.history:
            raise ValueError(
                f"{self.task.names.init}: expected a pose at which the picture changes when the object moves, got one at which "
                "it does not; is the object out of view, or of the background's colour?"
            )
        # The same many samples for all: a fit never ends at a worse pose than its start.
        found = self._judge(*self._down(ends[0], finer))
        stays = found.short and len(_distinct([found.pose, self.start], 2)) == 1  # the start was the answer already
        best = min(found, self._judge(self.start, stays), key=lambda end: end.loss)
        self._take(best)
        for _ in range(ROUNDS if self.steps > ASIDE_STEPS else 0):
            if best.explained >= ENOUGH:
                break
            begins = len(self.history)
            ends = _distinct(self._ranked(coarse, [*self._others(best.pose), *ends[1:]]), FOLLOWED)
            ends = self._ranked(finer[0], ends)
            found = self._judge(*self._down(ends[0], finer))
            best = self._better(best, found, found.loss < best.loss, begins)
        if self.steps > ASIDE_STEPS and best.explained >= ENOUGH and best.loss > FAR_ABOVE * best.noise:
            # Something covers the object, or a place nearby looks alike. Where much is covered, a wrong place may have a lower
            # loss: a better one has more of its edges in the pictures as well.
            begins = len(self.history)
            near = self._ranked(finer[0], self._tilted(best.pose))
            found = self._judge(*self._down(near[0], finer[1:]))
            won = found.loss < best.loss and found.explained > best.explained
            best = self._better(best, found, won, begins)
        self.history.append(Step(self.levels[-1].size, self.loss, self.best, True, {}))

    def first_end(self) -> float:
        """The share of the render's edges that the pictures show where the way down from the start alone ends."""
        return self._judge(*self._down(self.start, self.levels)).explained

    def _tilted(self, pose: Pose) -> list[Pose]:
        """The pose, and others turned aside from it."""
        tilts = ASIDE * torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], dtype=torch.float64)
        return [pose, *(self.task.moved(pose, [TURN, TURN + 1], tilt) for tilt in tilts)]

    def _better(self, best: _End, found: _End, won: bool, begins: int) -> _End:
        """Which of both is the answer. `best` marks the way to it in the history, where that to `found` begins at `begins`."""
        lost = slice(0, begins) if won else slice(begins, None)
        self.history[lost] = [step._replace(best=False) for step in self.history[lost]]
        if won:
            self._take(found)
        return found if won else best

    def _take(self, end: _End) -> None:
        self.loss, self.explained, self.best, self._answered = end.loss, end.explained, end.pose, True
        self.converged = end.short and end.explained >= ENOUGH

    def _ranked(self, level: Level, starts: list[Pose]) -> list[Pose]:
        """Where a few steps lead from each start, the best first."""
        ends, lowest = [], math.inf
        for origin in starts:
            end, loss, _ = self._follow(level, origin, min(self.steps, ASIDE_STEPS), lowest)
            ends.append(end)
            lowest = min(lowest, loss)
        # Each followed a loss of its own width: here all have one.
        return self._sorted(level, ends, level.spp)

    def _down(self, pose: Pose, levels: list[Level]) -> tuple[Pose, bool]:
        """Through the levels; the pose, and whether the last step was short."""
        short = False
        for level in levels:
            pose, _, short = self._follow(level, pose, self.steps, math.inf)
        return pose, short

    def _follow(self, level: Level, origin: Pose, most: int, lowest: float) -> tuple[Pose, float, bool]:
        """Steps on one level; the pose, its loss, and whether the last step was short."""
        task, search = self.task, GaussNewton(self.generator)
        if (way := self.journal.entered()) is None:
            way = Way(origin, origin, lowest)
        else:
            search.load(way.search)
            self.generator.set_state(way.random)
            for step in way.steps:
                self._note(step)
        while not way.done:
            p = torch.zeros(len(level.free), dtype=torch.float64, requires_grad=True)
            seed = (self.seed + len(self.history)) % 2**32
            compared = Comparison(task, level, task.images(level, task.moved(way.pose, level.free, p), level.spp, seed))
            c = compared.scale() if way.c == math.inf else way.c
            loss, slack = compared.loss(c)
            norms = {}
            if taken := search.observe(p, compared.residuals(c), loss, slack):
                way = way._replace(here=way.pose)
                norms = _norms(level.free, 2.0 / compared.count * search.gradient)
                c = min(c, compared.scale())
                search.loss = loss = compared.loss(c)[0]
            way = way._replace(c=c, search=search.state(), random=self.generator.get_state())
            if search.blind:
                self.journal.keep(way := way._replace(done=True))
                break
            move = search.step()
            short = float(move.abs().max()) < self.tolerance * level.coarseness
            settled = search.settled and level is not self.levels[-1]
            good = taken and loss <= way.lowest + NOISE * abs(way.lowest)
            step = Step(level.size, loss, way.pose, good, norms)
            way = way._replace(
                pose=task.moved(way.here, level.free, move), lowest=loss if good else way.lowest, short=short,
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

    def _compare(self, level: Level, pose: Pose, spp: int, seed: int) -> Comparison:
        with torch.no_grad():
            return Comparison(self.task, level, self.task.images(level, pose, spp, seed))

    def _judge(self, pose: Pose, short: bool) -> _End:
        """With many samples on the finest level."""
        loss, share, noise = self.journal.numbers(lambda: self._judged(pose))
        return _End(loss, share, noise, pose, short)

    def _judged(self, pose: Pose) -> list[float]:
        """The loss, the share of the render's edges, and the loss that noise explains."""
        final = self.levels[-1]
        first, second = (self._compare(final, pose, FINAL_SPP, (self.seed + k) % 2**32) for k in (0, 1))
        pairs = []
        for shot, a, b in zip(final.shots, first.renders, second.renders, strict=True):
            weight = shot.weight
            if self.task.clutter:
                outside = (a[..., -1] < 0.999).to(a)  # and what lies beside it, whose gradient reaches there
                inside = 1.0 - F.max_pool2d(outside[None, None], 3, stride=1, padding=1)[0, 0][..., None]
                weight = inside if weight is None else weight * inside
                a, b = a[..., :-1], b[..., :-1]
            pairs.append((a, b, shot.target, weight))
        return [first.loss(NARROWEST * self.task.extent)[0], explained(pairs), noise_of(pairs)]

    def _others(self, best: Pose) -> list[Pose]:
        """The few best of many poses around the start and the best one, by their loss on the coarsest level."""
        level, drawn = self.levels[0], []
        entries = [entry for entry in range(TURN, GROW) if entry in self.task.free]
        for k in range(LOOKS):
            p = torch.zeros(GROW, dtype=torch.float64)
            p[TURN:SHIFT] = FARTHEST * self._ball()
            p[SHIFT:GROW] = FARTHEST_SHIFT * self._ball()
            drawn.append(self.task.moved(self.start if k % 2 else best, entries, p[entries]))
        return _distinct(self._sorted(level, drawn, max(4, level.spp // 16)), KEPT)

    def _sorted(self, level: Level, poses: list[Pose], spp: int) -> list[Pose]:
        """By their loss, the least first."""
        c = COMMON * self.task.extent
        losses = self.journal.numbers(lambda: [self._compare(level, pose, spp, self.seed).loss(c)[0] for pose in poses])
        return [poses[k] for k in sorted(range(len(poses)), key=losses.__getitem__)]

    def _ball(self) -> Tensor:
        """(3,) even in a ball of radius 1."""
        direction = torch.randn(3, generator=self.generator, dtype=torch.float64)
        radius = torch.rand((), generator=self.generator, dtype=torch.float64) ** (1 / 3)
        return radius * direction / direction.norm()


def _norms(free: list[int], gradient: Tensor) -> dict[str, float]:
    """Of each part of a step whose entries are `free`."""
    squares = dict(zip(free, gradient.square().tolist(), strict=True))
    sums = {name: [squares[entry] for entry in entries if entry in squares] for name, entries in PARTS.items()}
    return {name: math.sqrt(sum(part)) for name, part in sums.items() if part}


def _distinct(poses: list[Pose], most: int) -> list[Pose]:
    """The first ones that are turned apart from one another."""
    kept: list[Pose] = []
    for pose in poses:
        if all(angle(pose.R, other.R) > 0.5 * ASIDE for other in kept):
            kept.append(pose)
    return kept[:most]
