"""The search of fit_poses: Gauss-Newton over the poses of several objects at once, from coarse to fine.

Where an object ends beside edges of the picture, it begins again from poses that are turned aside, while the others stay where
they were found; then all take the last steps together, without what covers them and is none of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ..pose import Pose
from ..result import HIDDEN, Step
from ..search import distinct, norms_of
from ..task import PoseTask
from ..uncertainty import Uncertainty
from .nearby import turns
from .search import APART, FOLLOWED, ROUNDS, SHARP, SURE, UNCOVERED, PhotoSearch
from .together import Together, together_levels, without_fronts
from .ways import (
    ALONE_ENOUGH,
    DAMPING,
    ENOUGH,
    FLOOR,
    FULL_STEPS,
    GAIN,
    LAST_DAMPING,
    LONGEST,
    most_steps,
)


class PosesSearch:
    """The state of a search; lists have an entry for each object. After each step `best` are the poses that all will have."""

    def __init__(
        self, tasks: Sequence[PoseTask], starts: Sequence[Pose], depths: Sequence[Tensor | None], max_size: int, spp: int,
        steps: int, tolerance: float, seed: int, further: bool,
    ) -> None:  # fmt: skip
        self.tasks, self.depths = tasks, depths
        self.max_size, self.spp, self.steps, self.tolerance, self.seed = max_size, spp, steps, tolerance, seed
        self.further = further
        self.levels = together_levels(tasks, starts, depths, max_size, spp, seed)
        self.enough = [ALONE_ENOUGH if task.colourless else ENOUGH for task in tasks]
        self.starts = list(starts)
        self.best, self.loss = list(starts), math.nan
        self.short = [False] * len(tasks)
        self.explained = [math.nan] * len(tasks)
        self.visible = [math.nan] * len(tasks)
        self.alike: list[list[Pose]] = [[] for _ in tasks]  # others, which the pictures hardly tell from the answer
        self.history: list[list[Step]] = [[] for _ in tasks]
        self.curvature: Tensor | None = None  # JᵀJ of the terms at the answer, of the entries of all
        self.after_step: Callable[[], Any] = lambda: None

    @property
    def needed(self) -> list[float]:
        """The share of its edges that each object must show. What is left of a covered one looks alike from more sides."""
        found = zip(self.enough, self.visible, strict=True)
        return [max(enough, SURE) if seen < UNCOVERED else enough for enough, seen in found]

    @property
    def converged(self) -> list[bool]:
        found = zip(self.short, self.explained, self.needed, self.visible, strict=True)
        return [short and share >= needed and seen >= HIDDEN for short, share, needed, seen in found]

    @property
    def planned(self) -> int:
        """Steps of the first way at most."""
        return sum(map(self._most, self.levels))

    def known(self, k: int) -> Tensor | None:
        """JᵀJ (n, n) of the entries of one object, with those of the others as unknown as they are: the Schur complement."""
        if self.curvature is None:
            return None
        own = self.levels[-1].parts()[k]
        others = torch.ones(len(self.curvature), dtype=torch.bool)
        others[own] = False
        between, rest = self.curvature[own][:, others], self.curvature[others][:, others]
        return self.curvature[own, own] - between @ torch.linalg.pinv(rest, rtol=1e-9, hermitian=True) @ between.T

    def run(self) -> None:
        """Raises ValueError when nothing in the pictures depends on the poses."""
        everything = list(range(len(self.tasks)))
        for level in self.levels:
            self._follow(level, everything)
        if not self.history[0]:
            raise ValueError("init: expected poses at which the picture changes when the objects move, got none")
        self._judge(self.levels[-1])
        if self.further:
            for k in everything:
                if self.explained[k] < self.enough[k] and self.visible[k] >= HIDDEN:
                    self._from_aside(k)
        self._surrounded()
        self.curvature = self.levels[-1].equations(self.best, self.seed)[0].curvature
        alone = self.further and all(depth is None for depth in self.depths)
        doubtful = [k for k in everything if alone and self.converged[k] and self._vague(k)]
        if any([self._of_alike(k) for k in doubtful]):  # all of them
            self._surrounded()
            self.curvature = self.levels[-1].equations(self.best, self.seed)[0].curvature
        for steps, pose in zip(self.history, self.best, strict=True):
            steps.append(Step(self.levels[-1].size, self.loss, pose, True, {}))

    def _vague(self, k: int) -> bool:
        """Whether the pictures show an object's rotation so little that others may look alike."""
        task, curvature = self.tasks[k], self.known(k)
        if task.colourless or curvature is None:
            return True
        return Uncertainty.of(task, self.best[k], curvature, task.free, None).degrees > SHARP

    def _of_alike(self, k: int) -> bool:
        """Whether another pose of one object makes the pictures likelier, which it takes then: compared where no other object is
        before it, while all others stay where they are."""
        task = without_fronts(self.tasks, self.best, k, self.spp, self.seed)
        search = PhotoSearch(
            task, self.starts[k], self.depths, self.max_size, self.spp, self.steps, self.tolerance, self.seed
        )
        search.after_step = self.after_step
        found, self.alike[k] = search.likeliest(self.best[k], self.short[k])
        if found is None:
            return False
        self.best[k], self.short[k] = found.pose, found.short
        self.history[k] = [*(step._replace(best=False) for step in self.history[k]), *search.history]
        return True

    def _surrounded(self) -> None:
        """The last steps, with what surrounds the objects where they are now, and without what covers them: the end depends
        neither on the start nor on the cover any more. Where an object is lost by that, all stay where they were."""
        before = list(self.best), list(self.short), list(self.explained), list(self.visible)
        last = together_levels(self.tasks, self.best, self.depths, self.max_size, self.spp, self.seed)[-1]
        level = last = last.focused(self.best, self.seed)
        for _ in range(ROUNDS):
            level = last.uncovered(self.best, self.seed)
            self._follow(level, list(range(len(self.tasks))))
        self._judge(level)
        ended = [a >= min(b, e) for a, b, e in zip(self.explained, before[2], self.enough, strict=True)]
        if not all(ended):
            self.best, self.short, self.explained, self.visible = before
        else:
            self.levels = [*self.levels[:-1], level]

    def _from_aside(self, k: int) -> None:
        """Other starts of one object, until one ends where the pictures show its edges."""
        coarse, *finer = self.levels
        kept, share = list(self.best), self.explained[k]
        short, steps = list(self.short), [list(steps) for steps in self.history]
        ends: list[tuple[float, Pose]] = []
        for turn in turns():
            self.best = [*kept[:k], self.tasks[k].moved(self.starts[k], *turn), *kept[k + 1 :]]
            self._follow(coarse, [k])
            ends.append((coarse.explained(self.best, self.seed)[k], self.best[k]))
        best, found = kept, (short, steps)
        ends.sort(key=lambda end: -end[0])
        for pose in distinct([pose for _, pose in ends], FOLLOWED, APART):
            self.best = [*kept[:k], pose, *kept[k + 1 :]]
            for level in finer:
                self._follow(level, [k])
            if (again := finer[-1].explained(self.best, self.seed)[k]) > share:
                best, share, found = list(self.best), again, (list(self.short), [list(one) for one in self.history])
            if share >= self.enough[k]:
                break
        self.best, (self.short, self.history) = best, found
        self._judge(finer[-1])

    def _follow(self, level: Together, moving: list[int]) -> None:
        """Steps of some objects on one level."""
        parts = level.parts()
        entries = torch.cat([torch.arange(parts[k].start, parts[k].stop) for k in moving])
        count, short = 0, {k: False for k in moving}
        while count < self._most(level) and not all(short.values()):
            # The same samples at each step, so that steps come to rest.
            normal, loss = level.equations(self.best, self.seed)
            normal = type(normal)(normal.curvature[entries][:, entries], normal.gradient[entries])
            move = normal.damped(LAST_DAMPING if level.last else DAMPING, FLOOR, math.inf)
            if move is None:
                break
            if level.last and count >= FULL_STEPS:
                move = 0.5 * move  # weights that are solved anew at each step make full ones go to and fro
            first = 0
            for k in moving:
                free = level.objects[k].plain.free
                own = slice(first, first := first + len(free))
                step = move[own] * min(1.0, LONGEST / float(move[own].abs().max().clamp(min=1e-30)))
                far = float(step.abs().max()) >= self.tolerance * level.objects[k].plain.coarseness
                short[k] = not far or float(step @ normal.curvature[own, own] @ step) < GAIN
                norms = norms_of(free, normal.gradient[own])
                self.history[k].append(Step(level.size, loss, self.best[k], True, norms))
                self.best[k], self.short[k] = self.tasks[k].moved(self.best[k], free, step), short[k]
            self.loss, count = loss, count + 1
            self.after_step()

    def _most(self, level: Together) -> int:
        coarsest = level.objects[0].plain.coarseness == self.levels[0].objects[0].plain.coarseness
        return most_steps(self.steps, level.last, coarsest)

    def _judge(self, level: Together) -> None:
        self.explained = level.explained(self.best, self.seed)
        self.visible = level.visible(self.best, self.seed)
