"""A pose search from many starts: a few steps from each at low resolution, and the best are refined to the end.

Starts are rotations about the object's centre around a pose, or all over SO(3), or matches of views with the whole picture. A
result is sure where the pictures show nearly all of the render's edges; otherwise the one that shows most is the answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from torch import Tensor

from ...options import Settings
from ..color_search import ColorSearch, distinct
from ..pose import Pose
from ..replay_log import ReplayLog
from ..result import Step
from ..task import PoseTask
from .level import photo_levels
from .photo_descent import SURE_SUPPORT
from .photo_search import PhotoSearch
from .template_views import ball, spread

Report = Callable[[str], Any]

START_RADIUS = 0.8  # largest rotation of starts around a pose, radians
RANKING_STEPS = 4  # from each start
REFINED_RANKED = 6
START_SPACING = 0.15  # radians between refined starts
RANKING_SPP = 8


class MultiStartSearch:
    """The state of a search, with the attributes of ColorSearch."""

    def __init__(
        self, task: PoseTask, start: Pose, starts: Callable[[Report], list[Pose]], depths: Sequence[Tensor | None],
        settings: Settings, log: ReplayLog, search: Callable[[Pose, ReplayLog], ColorSearch | PhotoSearch],
    ) -> None:  # fmt: skip
        """`starts` makes the starts, and `search` refines one of them."""
        self.task, self.start, self.starts, self.depths = task, start, starts, depths
        self.settings, self.seed = replace(settings, spp=RANKING_SPP), settings.seed
        self.log, self._search = log, search
        one = search(start, log)
        self.enough, self.planned = one.enough, one.planned
        self.colors_first = isinstance(one, PhotoSearch) and one.colors_first
        self.best, self.loss, self.converged, self.edge_support = start, math.nan, False, math.nan
        self.information: Tensor | None = None
        self.ambiguous: list[Pose] = []
        self.history: list[Step] = []
        self.after_step: Callable[[], Any] = lambda: None
        self.report: Report = lambda _: None

    def run(self) -> None:
        """Search; raise ValueError when nothing in the pictures depends on the pose, wherever it starts."""
        failed: ValueError | None = None
        for pose in self._ranked():
            try:
                found = self._followed(pose)
            except ValueError as error:  # This start is out of view, or leaves no trace.
                failed = error
                continue
            if found.converged and found.edge_support >= SURE_SUPPORT:
                break
        if not self.history and failed is not None:
            raise failed
        if self.colors_first and self.converged:
            # From so near, unlit colours may be compared, which is more precise where they fit.
            self._followed(self.best, True)

    def _followed(self, pose: Pose, colors_first: bool = False) -> ColorSearch | PhotoSearch:
        """Refine a start; it is the answer if it is better than those before."""
        found = self._search(pose, self.log)
        if isinstance(found, PhotoSearch):
            found.colors_first = colors_first
        before = list(self.history)
        first = not before

        def after_step() -> None:
            self.history = [*before, *found.history]
            if first:
                self.best, self.loss, self.edge_support = found.best, found.loss, found.edge_support
            self.after_step()

        found.after_step = after_step
        found.run()
        if first or (found.converged, found.edge_support) > (self.converged, self.edge_support):
            before = [step._replace(best=False) for step in before]
            self.history = [*before, *found.history]
            self.best, self.loss, self.edge_support = found.best, found.loss, found.edge_support
            self.converged, self.information = found.converged, found.information
        else:
            self.history = [*before, *(step._replace(best=False) for step in found.history)]
        return found

    def _ranked(self) -> list[Pose]:
        """Return the starts after a few steps, those that the pictures show most of first, as logged."""
        flat = self.log.replay(self._compared)
        size = len(self.start.numbers)
        return [Pose.from_numbers(flat[k : k + size]) for k in range(0, len(flat), size)]

    def _compared(self) -> list[float]:
        found = []
        starts = self.starts(self.report)
        for k, pose in enumerate(starts):
            self.report(f"start {k + 1} of {len(starts)}")
            try:
                found.append(self._near(pose))
            except ValueError:  # It is behind the camera, or out of view.
                continue
        found.sort(key=lambda one: -one[0])
        poses = distinct([pose for _, pose in found], REFINED_RANKED, START_SPACING) or [self.start]
        return [number for pose in poses for number in pose.numbers]

    def _near(self, pose: Pose) -> tuple[float, Pose]:
        """Take a few steps on the coarsest level; return the share of the render's edges that the pictures show, and the
        pose."""
        level = photo_levels(self.task, pose, self.depths, self.settings)[0]
        for _ in range(RANKING_STEPS):
            normal, _ = level.equations(pose, self.seed)
            move = level.step(normal)
            if move is None:
                break
            pose = self.task.moved(pose, level.pyramid_level.dofs, move)
        return level.edge_support(pose, self.seed), pose


def around(task: PoseTask, pose: Pose, count: int) -> list[Pose]:
    """Return the pose, and others rotated from it about the object's centre."""
    return [_turned(task, pose, R @ pose.R) for R in ball(count, START_RADIUS)]


def everywhere(task: PoseTask, pose: Pose, count: int) -> list[Pose]:
    """Return poses at the same place with rotations all over SO(3)."""
    return [_turned(task, pose, R) for R in spread(count)]


def _turned(task: PoseTask, pose: Pose, R: Tensor) -> Pose:
    return pose._replace(R=R, t=task.center_at(pose) - pose.scale * (R @ task.center))
