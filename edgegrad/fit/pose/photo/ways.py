"""Ways down in photographs: Gauss-Newton over their terms, from coarse to fine, and how well what they end at is in the pictures.

Colours are counted anew after each step, inside and around the silhouette as it is then.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..journal import Journal, Way
from ..pose import Pose
from ..result import Step
from ..search import norms_of
from ..task import PoseTask
from .cover import WHOLE, covers, left, weighted
from .level import PhotoLevel, photo_levels

ENOUGH = 0.65  # share of the render's edges: wrong poses reach 0.57, right ones 0.83 and more
# The same of a contour alone: wrong places in clutter reach 0.81, right ones show 0.87 and more.
ALONE_ENOUGH = 0.85
# Of the curvature's diagonal, where colours are still counted beside the object and where it is found, and of its largest entry.
DAMPING, LAST_DAMPING, FLOOR = 0.1, 0.01, 1e-5
LONGEST = 0.1  # of any entry of a step
COARSE_STEPS, FINE_STEPS, LAST_STEPS, USUAL = (
    12,
    8,
    20,
    40,
)  # on a level, of the USUAL `steps`; more of these make it more
FULL_STEPS = 8  # of full length on the last level
GAIN = 0.1  # a step that makes the pictures more likely by a smaller factor than exp(this / 2) is short: noise moves poses as far


class End(NamedTuple):
    """Where a way down ended."""

    explained: float
    pose: Pose
    short: bool  # the last step
    left: float = 1.0  # of the object, by what covers it


class Ways:
    """The state of a search that follows ways, as Search has it."""

    def __init__(
        self, task: PoseTask, start: Pose, depths: Sequence[Tensor | None], max_size: int, spp: int, steps: int,
        tolerance: float, seed: int, journal: Journal | None = None,
    ) -> None:  # fmt: skip
        self.task, self.start, self.depths = task, start, depths
        self.enough = ALONE_ENOUGH if task.colourless else ENOUGH
        self.levels = photo_levels(task, start, depths, max_size, spp, seed)
        self.max_size, self.spp, self.steps, self.tolerance, self.seed = max_size, spp, steps, tolerance, seed
        self.best, self.loss, self.converged, self.explained = start, math.nan, False, math.nan
        self.curvature: Tensor | None = None  # JᵀJ of the terms of photographs at the answer, where it is theirs
        self.history: list[Step] = []
        self.journal = journal or Journal()
        self.after_step: Callable[[], Any] = lambda: None
        self._answered = False  # later ways do not show until they win

    @property
    def planned(self) -> int:
        """Steps of the first way at most."""
        return sum(self._most(level) for level in self.levels)

    def first_end(self) -> float:
        """The share of the render's edges that the pictures show where the way down from the start alone ends."""
        return self._judge(*self._down(self.start, self.levels)).explained

    def _uncovered(self, pose: Pose, weights: list[Tensor], levels: list[PhotoLevel]) -> End:
        """Down from a pose, with `weights` (h, w) of each picture until the light tells what covers the object."""
        short, last = False, levels[-1]
        for level in levels:
            if level.last:
                weights = covers(weighted(level, weights).see(pose, self.seed)) or weights
            pose, short = self._follow(last := weighted(level, weights), pose)
        weights = covers(last.see(pose, self.seed)) or weights
        share, kept = self.journal.numbers(
            lambda: [
                weighted(levels[-1], weights).explained(pose, self.seed),
                left(levels[-1].see(pose, self.seed), weights),
            ]
        )
        return End(share * min(1.0, kept / WHOLE), pose, short, kept)

    def _down(self, pose: Pose, levels: list[PhotoLevel]) -> tuple[Pose, bool]:
        """Through the levels; the pose, and whether the last step was short."""
        short = False
        for level in levels:
            pose, short = self._follow(level, pose)
        return pose, short

    def _follow(
        self, level: PhotoLevel, origin: Pose, until: Callable[[Pose], bool] = lambda _: False
    ) -> tuple[Pose, bool]:
        """Steps on one level; the pose, and whether the last step was short. They end `until` a pose where no more are needed."""
        way = self.journal.entered() or Way(origin, origin, math.inf, search={})
        for step in way.steps:
            self._note(step)
        while not way.done:
            # The same samples at each step, so that steps come to rest.
            normal, loss = level.equations(way.pose, self.seed)
            move = normal.damped(LAST_DAMPING if level.last else DAMPING, FLOOR, LONGEST)
            if move is None:
                self.journal.keep(way := way._replace(done=True))
                break
            if level.last and len(way.steps) > FULL_STEPS:
                move = 0.5 * move  # weights that are solved anew at each step make full ones go to and fro
            far = float(move.abs().max()) >= self.tolerance * level.plain.coarseness
            short = not far or float(move @ normal.curvature @ move) < GAIN
            step = Step(level.size, loss, way.pose, True, norms_of(level.plain.free, normal.gradient))
            steps = (*way.steps, step)
            way = way._replace(
                pose=self.task.moved(way.pose, level.plain.free, move), here=way.pose, lowest=loss, short=short,
                done=short or len(steps) >= self._most(level), steps=steps,
            )  # fmt: skip
            way = way._replace(done=way.done or until(way.pose))
            self.journal.keep(way)
            self._note(step)
            self.after_step()
        return way.pose, way.short

    def _most(self, level: PhotoLevel) -> int:
        return most_steps(self.steps, level.last, level.plain.coarseness == self.levels[0].plain.coarseness)

    def _note(self, step: Step) -> None:
        if not self._answered:
            self.best, self.loss = step.pose, step.loss
        self.history.append(step)

    def _forget(self, lost: slice) -> None:
        self.history[lost] = [step._replace(best=False) for step in self.history[lost]]

    def _judge(self, pose: Pose, short: bool, level: PhotoLevel | None = None) -> End:
        """By the last level, or another one like it."""
        (share,) = self.journal.numbers(lambda: [(level or self.levels[-1]).explained(pose, self.seed)])
        return End(share, pose, short)

    def _take(self, end: End) -> None:
        self.loss, *curvature = self.journal.numbers(lambda: self._at(end.pose))
        self.curvature = torch.tensor(curvature, dtype=torch.float64).reshape((len(self.task.free),) * 2)
        self.explained, self.best, self._answered = end.explained, end.pose, True
        self.converged = end.short and end.explained >= self.enough

    def _at(self, pose: Pose) -> list[float]:
        """The loss, and the curvature by rows."""
        normal, loss = self.levels[-1].equations(pose, self.seed)
        return [loss, *normal.curvature.flatten().tolist()]


def most_steps(steps: int, last: bool, coarsest: bool) -> int:
    """On a level, of what the user allows. Few lead from one level to the next, and where they do not come to rest, more do not
    help either, unless somebody asks for them."""
    usual = LAST_STEPS if last else COARSE_STEPS if coarsest else FINE_STEPS
    return min(steps, round(usual * max(1.0, steps / USUAL)))
