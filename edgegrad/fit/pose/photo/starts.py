"""A pose search from many starts: a few steps from each at low resolution, and the best are followed to the end.

Starts are rotations about the object's centre around a pose, or all over SO(3), or matches of views with the whole picture. An
end is sure where the pictures show nearly all of the render's edges; of ends that are not, the one is the answer that shows most.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor

from ..journal import Journal
from ..pose import Pose
from ..result import Step
from ..search import Search, distinct
from ..task import PoseTask
from .level import photo_levels
from .search import PhotoSearch
from .views import ball, spread
from .ways import DAMPING, FLOOR, LONGEST

Tell = Callable[[str], Any]

ASIDE = 0.8  # radians that starts around a pose are turned by at most
FIRST_STEPS = 4  # from each start
FOLLOWED = 6  # to the end
APART = 0.15  # radians between poses that are followed both
SPP = 8  # of these steps
SURE = 0.85  # share of the render's edges: no other end is looked for


class Starts:
    """The state of a search, as Search has it."""

    def __init__(
        self, task: PoseTask, start: Pose, starts: Callable[[Tell], list[Pose]], depths: Sequence[Tensor | None],
        max_size: int, seed: int, journal: Journal, search: Callable[[Pose, Journal], Search | PhotoSearch],
    ) -> None:  # fmt: skip
        """`starts` makes them, and `search` what follows one of them down."""
        self.task, self.start, self.starts, self.depths = task, start, starts, depths
        self.max_size, self.seed = max_size, seed
        self.journal, self._search = journal, search
        one = search(start, journal)
        self.enough, self.steps, self.tolerance, self.planned = one.enough, one.steps, one.tolerance, one.planned
        self.colours_first = isinstance(one, PhotoSearch) and one.colours_first
        self.best, self.loss, self.converged, self.explained = start, math.nan, False, math.nan
        self.curvature: Tensor | None = None
        self.alike: list[Pose] = []
        self.history: list[Step] = []
        self.after_step: Callable[[], Any] = lambda: None
        self.tell: Tell = lambda _: None  # called with what is done between steps

    def run(self) -> None:
        """Raises ValueError when nothing in the pictures depends on the pose, wherever it starts."""
        failed: ValueError | None = None
        for pose in self._ranked():
            try:
                way = self._followed(pose)
            except ValueError as error:  # of this start: out of view, or without a trace
                failed = error
                continue
            if way.converged and way.explained >= SURE:
                break
        if not self.history and failed is not None:
            raise failed
        if self.colours_first and self.converged:
            # From so near, colours may be compared as they are, which is more precise where they fit.
            self._followed(self.best, True)

    def _followed(self, pose: Pose, colours_first: bool = False) -> Search | PhotoSearch:
        """The way down from a start; it is the answer if it is better than those before."""
        way = self._search(pose, self.journal)
        if isinstance(way, PhotoSearch):
            way.colours_first = colours_first
        before = list(self.history)
        first = not before

        def after_step() -> None:
            self.history = [*before, *way.history]
            if first:
                self.best, self.loss, self.explained = way.best, way.loss, way.explained
            self.after_step()

        way.after_step = after_step
        way.run()
        if first or (way.converged, way.explained) > (self.converged, self.explained):
            before = [step._replace(best=False) for step in before]
            self.history = [*before, *way.history]
            self.best, self.loss, self.explained, self.converged = way.best, way.loss, way.explained, way.converged
            self.curvature = way.curvature
        else:
            self.history = [*before, *(step._replace(best=False) for step in way.history)]
        return way

    def _ranked(self) -> list[Pose]:
        """Starts after a few steps, those that the pictures show most of first. They are what a journal has of this."""
        flat = self.journal.numbers(self._compared)
        size = len(self.start.numbers)
        return [Pose.from_numbers(flat[k : k + size]) for k in range(0, len(flat), size)]

    def _compared(self) -> list[float]:
        found = []
        starts = self.starts(self.tell)
        for k, pose in enumerate(starts):
            self.tell(f"start {k + 1} of {len(starts)}")
            try:
                found.append(self._near(pose))
            except ValueError:  # behind the camera, or out of view
                continue
        found.sort(key=lambda one: -one[0])
        poses = distinct([pose for _, pose in found], FOLLOWED, APART) or [self.start]
        return [number for pose in poses for number in pose.numbers]

    def _near(self, pose: Pose) -> tuple[float, Pose]:
        """A few steps on the coarsest level, and the share of the render's edges that the pictures show there."""
        level = photo_levels(self.task, pose, self.depths, self.max_size, SPP, self.seed)[0]
        for _ in range(FIRST_STEPS):
            normal, _ = level.equations(pose, self.seed)
            move = normal.damped(DAMPING, FLOOR, LONGEST)
            if move is None:
                break
            pose = self.task.moved(pose, level.plain.free, move)
        return level.explained(pose, self.seed), pose


def around(task: PoseTask, pose: Pose, count: int) -> list[Pose]:
    """The pose, and others turned aside from it about the object's centre."""
    return [_turned(task, pose, R @ pose.R) for R in ball(count, ASIDE)]


def everywhere(task: PoseTask, pose: Pose, count: int) -> list[Pose]:
    """At the place of a pose, turned in all ways."""
    return [_turned(task, pose, R) for R in spread(count)]


def _turned(task: PoseTask, pose: Pose, R: Tensor) -> Pose:
    center = pose.scale * (pose.R @ task.center) + pose.t
    return pose._replace(R=R, t=center - pose.scale * (R @ task.center))
