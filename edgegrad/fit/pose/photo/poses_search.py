"""The search of fit_poses: Gauss-Newton over the poses of several objects at once, from coarse to fine.

An object that ends off the picture's edges starts again from poses rotated aside, while the others stay. Then all take the
last steps together, without what covers them and is none of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ...options import Settings
from ..color_search import distinct, norms_of
from ..pose import Pose
from ..result import MIN_VISIBLE_SHARE, Step
from ..task import PoseTask
from ..uncertainty import Uncertainty, information_of
from .joint_level import JointLevel, joint_levels, without_fronts
from .level import MAX_PHOTO_STEP
from .nearby import turns
from .photo_descent import (  # fmt: skip
    FULL_LENGTH_STEPS,
    SHORT_STEP_NATS,
    SURE_SUPPORT,
    UNOCCLUDED,
    enough_support,
    most_steps,
)
from .photo_search import DISTINCT_ANGLE, LAST_LEVEL_ROUNDS, REFINED_STARTS, SHARP_DEGREES, PhotoSearch


class PosesSearch:
    """The state of a search; lists have an entry for each object. `best` poses are valid after each step."""

    def __init__(
        self, tasks: Sequence[PoseTask], starts: Sequence[Pose], depths: Sequence[Tensor | None], settings: Settings,
        further: bool,
    ) -> None:  # fmt: skip
        self.tasks, self.depths = tasks, depths
        self.settings, self.seed, self.further = settings, settings.seed, further
        self.levels = joint_levels(tasks, starts, depths, settings)
        self.enough = [enough_support(task) for task in tasks]
        self.starts = list(starts)
        self.best, self.loss = list(starts), math.nan
        self.short = [False] * len(tasks)
        self.edge_support = [math.nan] * len(tasks)
        self.visible = [math.nan] * len(tasks)
        self.ambiguous: list[list[Pose]] = [[] for _ in tasks]  # poses that may be the answer, too
        self.history: list[list[Step]] = [[] for _ in tasks]
        self.curvature: Tensor | None = None  # JᵀJ at the answer, of the entries of all objects
        self.after_step: Callable[[], Any] = lambda: None

    @property
    def needed(self) -> list[float]:
        """The share of its edges that each object must show. The visible part of a covered one is more ambiguous."""
        found = zip(self.enough, self.visible, strict=True)
        return [max(enough, SURE_SUPPORT) if seen < UNOCCLUDED else enough for enough, seen in found]

    @property
    def converged(self) -> list[bool]:
        found = zip(self.short, self.edge_support, self.needed, self.visible, strict=True)
        return [short and share >= needed and seen >= MIN_VISIBLE_SHARE for short, share, needed, seen in found]

    def information(self, k: int) -> Tensor | None:
        """Return the inverse covariance (n, n) of one object's entries, with the others' unknown as they are: by the Schur
        complement of JᵀJ."""
        if self.curvature is None:
            return None
        own = self.levels[-1].parts()[k]
        others = torch.ones(len(self.curvature), dtype=torch.bool)
        others[own] = False
        between, rest = self.curvature[own][:, others], self.curvature[others][:, others]
        by_others = between @ torch.linalg.pinv(rest, rtol=1e-9, hermitian=True) @ between.T
        return information_of(self.curvature[own, own] - by_others)

    def run(self) -> None:
        """Search; raise ValueError when nothing in the pictures depends on the poses."""
        everything = list(range(len(self.tasks)))
        for level in self.levels:
            self._follow(level, everything)
        if not self.history[0]:
            raise ValueError("init: expected poses at which the picture changes when the objects move, got none")
        self._judge(self.levels[-1])
        if self.further:
            for k in everything:
                if self.edge_support[k] < self.enough[k] and self.visible[k] >= MIN_VISIBLE_SHARE:
                    self._from_aside(k)
        self._refine_surrounded()
        self.curvature = self.levels[-1].equations(self.best, self.seed)[0].curvature
        alone = self.further and all(depth is None for depth in self.depths)
        doubtful = [k for k in everything if alone and self.converged[k] and self._vague(k)]
        if any([self._resolve_ambiguity(k) for k in doubtful]):  # The list makes all take part.
            self._refine_surrounded()
            self.curvature = self.levels[-1].equations(self.best, self.seed)[0].curvature
        for steps, pose in zip(self.history, self.best, strict=True):
            steps.append(Step(self.levels[-1].size, self.loss, pose, True, {}))

    def _vague(self, k: int) -> bool:
        """Return whether the pictures show an object's rotation so little that it may be ambiguous."""
        task, information = self.tasks[k], self.information(k)
        if task.colorless or information is None:
            return True
        return Uncertainty.from_information(task, self.best[k], information, task.dofs, None).degrees > SHARP_DEGREES

    def _resolve_ambiguity(self, k: int) -> bool:
        """Return whether another pose of one object makes the pictures likelier, and take it then. It is compared where no
        other object is before it, while all others stay where they are."""
        task = without_fronts(self.tasks, self.best, k, self.settings.spp, self.seed)
        search = PhotoSearch(task, self.starts[k], self.depths, self.settings)
        search.after_step = self.after_step
        found, self.ambiguous[k] = search.likeliest(self.best[k], self.short[k])
        if found is None:
            return False
        self.best[k], self.short[k] = found.pose, found.short
        self.history[k] = [*(step._replace(best=False) for step in self.history[k]), *search.history]
        return True

    def _refine_surrounded(self) -> None:
        """Take the last steps by the surroundings of the current poses, and without occluders, so that the end does not depend
        on the start. Where this loses an object, all stay where they were."""
        before = list(self.best), list(self.short), list(self.edge_support), list(self.visible)
        last = joint_levels(self.tasks, self.best, self.depths, self.settings)[-1]
        level = last = last.focused(self.best, self.seed)
        for _ in range(LAST_LEVEL_ROUNDS):
            level = last.unoccluded(self.best, self.seed)
            self._follow(level, list(range(len(self.tasks))))
        self._judge(level)
        ended = [a >= min(b, e) for a, b, e in zip(self.edge_support, before[2], self.enough, strict=True)]
        if not all(ended):
            self.best, self.short, self.edge_support, self.visible = before
        else:
            self.levels = [*self.levels[:-1], level]

    def _from_aside(self, k: int) -> None:
        """Refine other starts of one object, until the pictures show an end's edges."""
        coarse, *finer = self.levels
        kept, share = list(self.best), self.edge_support[k]
        short, steps = list(self.short), [list(steps) for steps in self.history]
        ends: list[tuple[float, Pose]] = []
        for turn in turns():
            self.best = [*kept[:k], self.tasks[k].moved(self.starts[k], *turn), *kept[k + 1 :]]
            self._follow(coarse, [k])
            ends.append((coarse.edge_support(self.best, self.seed)[k], self.best[k]))
        best, found = kept, (short, steps)
        ends.sort(key=lambda end: -end[0])
        for pose in distinct([pose for _, pose in ends], REFINED_STARTS, DISTINCT_ANGLE):
            self.best = [*kept[:k], pose, *kept[k + 1 :]]
            for level in finer:
                self._follow(level, [k])
            if (again := finer[-1].edge_support(self.best, self.seed)[k]) > share:
                best, share, found = list(self.best), again, (list(self.short), [list(one) for one in self.history])
            if share >= self.enough[k]:
                break
        self.best, (self.short, self.history) = best, found
        self._judge(finer[-1])

    def _follow(self, level: JointLevel, moving: list[int]) -> None:
        """Move some objects by steps on one level."""
        parts = level.parts()
        entries = torch.cat([torch.arange(parts[k].start, parts[k].stop) for k in moving])
        count, short = 0, {k: False for k in moving}
        while count < self._most(level) and not all(short.values()):
            # Each step has the same samples, so that steps come to rest.
            normal, loss = level.equations(self.best, self.seed)
            normal = type(normal)(normal.curvature[entries][:, entries], normal.gradient[entries])
            move = level.objects[0].step(normal, math.inf)
            if move is None:
                break
            if level.last and count >= FULL_LENGTH_STEPS:
                move = 0.5 * move  # Full steps would oscillate, as weights are solved anew at each.
            first = 0
            for k in moving:
                dofs = level.objects[k].pyramid_level.dofs
                own = slice(first, first := first + len(dofs))
                step = move[own] * min(1.0, MAX_PHOTO_STEP / float(move[own].abs().max().clamp(min=1e-30)))
                far = (
                    float(step.abs().max()) >= self.settings.step_tolerance * level.objects[k].pyramid_level.coarseness
                )
                short[k] = not far or float(step @ normal.curvature[own, own] @ step) < SHORT_STEP_NATS
                norms = norms_of(dofs, normal.gradient[own])
                self.history[k].append(Step(level.size, loss, self.best[k], True, norms))
                self.best[k], self.short[k] = self.tasks[k].moved(self.best[k], dofs, step), short[k]
            self.loss, count = loss, count + 1
            self.after_step()

    def _most(self, level: JointLevel) -> int:
        coarsest = level.objects[0].pyramid_level.coarseness == self.levels[0].objects[0].pyramid_level.coarseness
        return most_steps(self.settings.steps, level.last, coarsest)

    def _judge(self, level: JointLevel) -> None:
        self.edge_support = level.edge_support(self.best, self.seed)
        self.visible = level.visible(self.best, self.seed)
