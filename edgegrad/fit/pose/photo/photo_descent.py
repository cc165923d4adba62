"""Descents of fit_pose in photographs: Gauss-Newton steps on each level, and candidates rated by the edges that pictures show.

Colours are counted anew after each step, inside and around the current silhouette.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...options import Settings
from ..color_search import norms_of
from ..pose import Pose
from ..replay_log import DescentState, ReplayLog
from ..result import Step
from ..task import PoseTask
from ..uncertainty import information_of
from .level import PhotoLevel, photo_levels
from .occluders import FULLY_VISIBLE, occluder_weights, visible_share, weighted

PHOTO_SUPPORT = 0.65  # Wrong poses show up to 0.57 of the render's edges, right ones 0.83 and more.
CONTOUR_SUPPORT = 0.85  # By the contour alone, wrong places in clutter show up to 0.81, right ones 0.87 and more.
# Steps on a level when the user's `steps` are USUAL_STEPS or fewer; more of these make it more.
COARSE_STEPS, FINE_STEPS, LAST_STEPS, USUAL_STEPS = 12, 8, 20, 40
FULL_LENGTH_STEPS = 8  # on the last level
# A step that makes the pictures more likely by a smaller factor than exp(this / 2) is short: noise moves poses as far.
SHORT_STEP_NATS = 0.1
SURE_SUPPORT = 0.85  # share of edges at which no other candidate is sought
UNOCCLUDED = 0.85  # With a smaller visible share, something covers the object.


class PhotoCandidate(NamedTuple):
    """A refined pose."""

    edge_support: float
    pose: Pose
    short: bool  # The last step was short.
    visible_share: float = 1.0  # of the object


class PhotoDescent:
    """The state of a descent, which notes its steps, and refines and rates poses."""

    def __init__(
        self, task: PoseTask, start: Pose, depths: Sequence[Tensor | None], settings: Settings, log: ReplayLog | None = None
    ) -> None:  # fmt: skip
        self.task, self.start, self.depths = task, start, depths
        self.enough = enough_support(task)
        self.levels = photo_levels(task, start, depths, settings)
        self.settings, self.seed = settings, settings.seed
        self.best, self.loss, self.converged, self.edge_support = start, math.nan, False, math.nan
        self.information: Tensor | None = None  # inverse covariance of the answer
        self.history: list[Step] = []
        self.log = log or ReplayLog()
        self.after_step: Callable[[], Any] = lambda: None
        self._answered = False  # Later candidates do not show until they win.

    @property
    def planned(self) -> int:
        """The largest number of steps of the first descent."""
        return sum(self._most(level) for level in self.levels)

    def _unoccluded(self, pose: Pose, weights: list[Tensor], levels: list[PhotoLevel]) -> PhotoCandidate:
        """Refine a pose, with `weights` (h, w) of each picture until the light shows what covers the object."""
        short, last = False, levels[-1]
        for level in levels:
            if level.last:
                weights = occluder_weights(weighted(level, weights).comparisons(pose, self.seed)) or weights
            pose, short = self._follow(last := weighted(level, weights), pose)
        weights = occluder_weights(last.comparisons(pose, self.seed)) or weights
        share, kept = self.log.replay(
            lambda: [
                weighted(levels[-1], weights).edge_support(pose, self.seed),
                visible_share(levels[-1].comparisons(pose, self.seed), weights),
            ]
        )
        return PhotoCandidate(share * min(1.0, kept / FULLY_VISIBLE), pose, short, kept)

    def _down(self, pose: Pose, levels: list[PhotoLevel]) -> tuple[Pose, bool]:
        """Refine through the levels; return the pose, and whether the last step was short."""
        short = False
        for level in levels:
            pose, short = self._follow(level, pose)
        return pose, short

    def _follow(
        self, level: PhotoLevel, origin: Pose, until: Callable[[Pose], bool] = lambda _: False
    ) -> tuple[Pose, bool]:
        """Take steps on one level, `until` a pose where no more are needed; return the pose, and whether the last step was
        short."""
        state = self.log.next_descent() or DescentState(origin, origin, math.inf, search={})
        for step in state.steps:
            self._note(step)
        while not state.done:
            # Each step has the same samples, so that steps come to rest.
            normal, loss = level.equations(state.pose, self.seed)
            move = level.step(normal)
            if move is None:
                self.log.record(state := state._replace(done=True))
                break
            if level.last and len(state.steps) > FULL_LENGTH_STEPS:
                move = 0.5 * move  # Full steps would oscillate, as weights are solved anew at each.
            far = float(move.abs().max()) >= self.settings.step_tolerance * level.pyramid_level.coarseness
            short = not far or float(move @ normal.curvature @ move) < SHORT_STEP_NATS
            step = Step(level.size, loss, state.pose, True, norms_of(level.pyramid_level.dofs, normal.gradient))
            steps = (*state.steps, step)
            state = state._replace(
                pose=self.task.moved(state.pose, level.pyramid_level.dofs, move), here=state.pose, lowest=loss, short=short,
                done=short or len(steps) >= self._most(level), steps=steps,
            )  # fmt: skip
            state = state._replace(done=state.done or until(state.pose))
            self.log.record(state)
            self._note(step)
            self.after_step()
        return state.pose, state.short

    def _most(self, level: PhotoLevel) -> int:
        return most_steps(
            self.settings.steps, level.last, level.pyramid_level.coarseness == self.levels[0].pyramid_level.coarseness
        )

    def _note(self, step: Step) -> None:
        if not self._answered:
            self.best, self.loss = step.pose, step.loss
        self.history.append(step)

    def _forget(self, lost: slice) -> None:
        self.history[lost] = [step._replace(best=False) for step in self.history[lost]]

    def _judge(self, pose: Pose, short: bool, level: PhotoLevel | None = None) -> PhotoCandidate:
        """Rate a pose by the last level, or another one like it."""
        (share,) = self.log.replay(lambda: [(level or self.levels[-1]).edge_support(pose, self.seed)])
        return PhotoCandidate(share, pose, short)

    def _take(self, end: PhotoCandidate) -> None:
        self.loss, *rows = self.log.replay(lambda: self._at(end.pose))
        curvature = torch.tensor(rows, dtype=torch.float64)
        self.information = information_of(curvature.reshape((len(self.task.dofs),) * 2))
        self.edge_support, self.best, self._answered = end.edge_support, end.pose, True
        self.converged = end.short and end.edge_support >= self.enough

    def _at(self, pose: Pose) -> list[float]:
        """Return the loss, and the curvature by rows."""
        normal, loss = self.levels[-1].equations(pose, self.seed)
        return [loss, *normal.curvature.flatten().tolist()]

    def _unoccluded_level(self, end: PhotoCandidate) -> PhotoLevel:
        """Return the last level, without what covers the object at an end, if something does."""
        last = self.levels[-1]
        weights = occluder_weights(last.comparisons(end.pose, self.seed)) if end.visible_share < UNOCCLUDED else None
        return last if weights is None else weighted(last, weights)

    def _better(self, best: PhotoCandidate, found: PhotoCandidate, earlier: slice, answered: bool) -> PhotoCandidate:
        """Return the candidate with more edge support. The history keeps its steps alone as best; `earlier` ones led to
        `best`."""
        if found.edge_support <= best.edge_support:
            self._forget(slice(earlier.stop, None))
            return best
        self._forget(earlier)
        if answered:
            self._take(found)
        return found


def enough_support(task: PoseTask) -> float:
    """Return the least edge support of a right pose."""
    return CONTOUR_SUPPORT if task.colorless else PHOTO_SUPPORT


def most_steps(steps: int, last: bool, coarsest: bool) -> int:
    """Return the number of steps on a level, of what the user allows. Few lead from one level to the next, and where they do
    not come to rest, more do not help either, unless somebody asks for them."""
    usual = LAST_STEPS if last else COARSE_STEPS if coarsest else FINE_STEPS
    return min(steps, round(usual * max(1.0, steps / USUAL_STEPS)))
