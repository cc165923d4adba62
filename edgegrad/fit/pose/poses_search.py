"""The search of fit_poses: each object in turn, where the others leave it to be seen.

What covers an object at the present poses counts for nothing while its own pose is sought. Poses of all objects are sought anew
until they stay, since each pose decides what the others show.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ...render import render
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ...scene.symmetries import Symmetries
from ..options import Settings
from .hypotheses import HypothesisSearch, Mode, turned
from .likelihood.objective import pose_levels
from .likelihood.support import Evidence, enough_support, evidence_of
from .pose import Pose, angle
from .pose_search import ambiguous
from .result import Step
from .settings import CAMERA, POSE
from .task import PoseTask


class PosesSearch:
    """The state of a search; lists have an entry for each object. `best` poses are valid after each step."""

    def __init__(
        self, tasks: Sequence[PoseTask], starts: Sequence[Pose], depths: Sequence[Tensor | None], settings: Settings,
        further: bool, symmetries: Sequence[Symmetries | None],
    ) -> None:  # fmt: skip
        self.tasks, self.starts, self.depths = tasks, list(starts), depths
        self.settings, self.further, self.symmetries = settings, further, symmetries
        n = len(tasks)
        self.best, self.loss, self.seeking = list(starts), math.nan, 0
        self.modes: list[list[Mode]] = [[] for _ in tasks]
        self.evidence: list[Evidence | None] = [None] * n
        self.edge_support, self.visible = [math.nan] * n, [math.nan] * n
        self.history: list[list[Step]] = [[] for _ in tasks]
        self.after_step: Callable[[], Any] = lambda: None

    @property
    def needed(self) -> list[float]:
        """The share of its edges that each object must show. The visible part of a covered one is more ambiguous."""
        found = zip(map(enough_support, self.tasks), self.visible, strict=True)
        return [max(enough, POSE.covered_support) if seen < POSE.unoccluded else enough for enough, seen in found]

    @property
    def converged(self) -> list[bool]:
        found = zip(self.modes, self.edge_support, self.needed, self.visible, strict=True)
        return [
            bool(modes) and modes[0].rests and share >= needed and seen >= CAMERA.least_visible
            for modes, share, needed, seen in found
        ]  # fmt: skip

    @property
    def ambiguous(self) -> list[list[Pose]]:
        """Poses that may be the answer, too."""
        return [ambiguous(modes) if modes else [] for modes in self.modes]

    def information(self, k: int) -> Tensor | None:
        """Return the inverse covariance (n, n) of one object's entries; None before its answer."""
        done = self.modes[k] and not math.isnan(self.edge_support[k])
        return self.modes[k][0].information if done else None

    def run(self) -> None:
        """Search; raise ValueError when nothing in the pictures depends on the poses."""
        everything = range(len(self.tasks))
        for count in range(POSE.rounds_of_objects):
            before = list(self.best)
            for k in everything:
                self._seek(k, first=count == 0)
            if all(self._near(k, before[k]) for k in everything):
                break
        if not any(self.modes):
            raise ValueError("init: expected poses at which the picture changes when the objects move, got none")
        seen = [self._uncovered(k) for k in everything]
        for k, (task, visible) in enumerate(seen):
            level = pose_levels(task, self.best[k], self.depths, self.settings)[-1].informed([self.best[k]])
            self.visible[k] = visible
            evidence = evidence_of(level.focused(self.best[k]), self.best[k])
            self.evidence[k], self.edge_support[k] = evidence, evidence.edges
            self.history[k].append(Step(level.size, self.loss, self.best[k], True, {}))

    def _near(self, k: int, pose: Pose) -> bool:
        apart = max(angle(self.best[k].R, pose.R), self.tasks[k].between(self.best[k], pose))
        return apart < POSE.distinct

    def _seek(self, k: int, first: bool) -> None:
        """Find the pose of one object, while the others stay. After the `first` time it is refined on the last level alone."""
        self.seeking = k
        task, visible = self._uncovered(k)
        if visible < CAMERA.least_visible:
            return
        poses = turned(task, self.best[k]) if first and self.further else [self.best[k]]
        search = HypothesisSearch(
            task, [(self.best[k], poses)], self.depths, self.settings, self.symmetries[k], first and self.further,
            coarse=first,
        )  # fmt: skip
        earlier = [step._replace(best=False) for step in self.history[k]] if self.history[k] else []

        def after_step() -> None:
            self.history[k] = [*earlier, *search.history]
            self.best[k], self.loss = search.likeliest, search.cost
            self.after_step()

        search.after_step = after_step
        self.modes[k] = search.run() or self.modes[k]
        if self.modes[k]:
            self.best[k], self.loss = self.modes[k][0].pose, self.modes[k][0].cost

    def _uncovered(self, k: int) -> tuple[PoseTask, float]:
        """Return the task of one object, with a weight of 0 where others that cover a part of it are seen, with a margin; and
        the share of its pixels that they leave."""
        moved = [
            task.scene.transformed(pose.R, pose.t, pose.scale)
            for task, pose in zip(self.tasks, self.best, strict=True)
        ]  # fmt: skip
        spp, seed = self.settings.spp, self.settings.seed
        shots, own, whole = [], 0.0, 0.0
        for shot in self.tasks[k].shots:
            with torch.no_grad():
                seen = render(_labelled(moved), shot.camera, spp, seed)
                alone = render(_labelled(moved[k : k + 1]), shot.camera, spp, seed)[..., 0]
            own, whole = own + float(seen[..., k].sum()), whole + float(alone.sum())
            hidden = alone - seen[..., k] > 0.5
            fronts = [j for j in range(len(moved)) if j != k and float(seen[hidden][:, j].sum()) > 1.0]
            before = seen[..., fronts].sum(-1)[None, None]
            margin = POSE.cover_margin
            before = F.max_pool2d(before, 2 * margin + 1, 1, margin)[0, 0, ..., None].float()
            weight = 1.0 - before if shot.weight is None else shot.weight * (1.0 - before)
            shots.append(shot._replace(weight=weight.clamp(min=0.0)))
        return replace(self.tasks[k], shots=shots), min(1.0, own / whole) if whole > 0.0 else 0.0


def _labelled(scenes: Sequence[Scene]) -> Scene:
    """Return all objects in one scene, each with a channel of its own, which is 1 on it."""
    labels = torch.eye(len(scenes), dtype=torch.float64)
    return Scene([
        Mesh(mesh.verts, mesh.faces, colors=label.expand(len(mesh.verts), -1))
        for scene, label in zip(scenes, labels, strict=True) for mesh in scene.meshes
    ])  # fmt: skip
