"""The search of fit_poses: each object in turn, where the others leave it to be seen.

What covers an object at the present poses counts for nothing while its own pose is sought. Poses of all objects are sought anew
until they stay, since each pose decides what the others show.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F

from ...render import render
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from .hypotheses import HypothesisSearch, turned
from .likelihood.objective import pose_levels
from .likelihood.support import evidence_of
from .pose import Pose, angle
from .pose_search import PoseSearch
from .result import Step
from .settings import CAMERA, POSE
from .task import PoseTask


class ObjectSearch(PoseSearch):
    """The search for one object among others."""

    visible = math.nan  # share of it that the others do not hide

    @property
    def converged(self) -> bool:
        return super().converged and self.visible >= CAMERA.least_visible

    def seek(self, task: PoseTask, first: bool) -> None:
        """Find the pose while the others stay. After the `first` time it is refined on the last level alone."""
        poses = turned(task, self.best) if first and self.further else [self.best]
        groups, further = [(self.best, poses)], first and self.further
        search = HypothesisSearch(task, groups, self.depths, self.settings, self.symmetries, further, coarse=first)
        earlier = [step._replace(best=False) for step in self.history]

        def after_step() -> None:
            self.history, self.best, self.loss = [*earlier, *search.history], search.likeliest, search.cost
            self.after_step()

        search.after_step = after_step
        self.modes = search.run() or self.modes
        if self.modes:
            self.best, self.loss = self.modes[0].pose, self.modes[0].cost

    def judge(self, task: PoseTask, visible: float) -> None:
        """Say what speaks for the answer, with the others at theirs. The visible part of a covered object is more ambiguous."""
        level = pose_levels(task, self.best, self.depths, self.settings)[-1].informed([self.best])
        found = evidence_of(level.focused(self.best), self.best)
        self.visible, self.edge_support, self.evidence = visible, found.edges, found if self.modes else None
        if visible < POSE.unoccluded:
            self.enough = max(self.enough, POSE.covered_support)
        self.history.append(Step(level.size, self.loss, self.best, True, {}))


def search_objects(objects: Sequence[ObjectSearch]) -> None:
    """Search for all; raise ValueError when nothing in the pictures depends on the poses."""
    for count in range(POSE.rounds_of_objects):
        before = [one.best for one in objects]
        for k, one in enumerate(objects):
            task, visible = _uncovered(objects, k)
            if visible >= CAMERA.least_visible:
                one.seek(task, first=count == 0)
        if all(_near(one, pose) for one, pose in zip(objects, before, strict=True)):
            break
    if not any(one.modes for one in objects):
        raise ValueError("init: expected poses at which the picture changes when the objects move, got none")
    for one, seen in zip(objects, [_uncovered(objects, k) for k in range(len(objects))], strict=True):
        one.judge(*seen)


def _uncovered(objects: Sequence[ObjectSearch], k: int) -> tuple[PoseTask, float]:
    """Return the task of one object, with a weight of 0 where others that cover a part of it are seen, with a margin; and
    the share of its pixels that they leave."""
    moved = [one.task.scene.transformed(*one.best[:3]) for one in objects]
    task, settings = objects[k].task, objects[k].settings
    spp, seed = settings.spp, settings.seed
    shots, own, whole = [], 0.0, 0.0
    for shot in task.shots:
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
    return replace(task, shots=shots), min(1.0, own / whole) if whole > 0.0 else 0.0


def _near(search: ObjectSearch, pose: Pose) -> bool:
    return max(angle(search.best.R, pose.R), search.task.between(search.best, pose)) < POSE.distinct


def _labelled(scenes: Sequence[Scene]) -> Scene:
    """Return all objects in one scene, each with a channel of its own, which is 1 on it."""
    labels = torch.eye(len(scenes), dtype=torch.float64)
    return Scene([
        Mesh(mesh.verts, mesh.faces, colors=label.expand(len(mesh.verts), -1))
        for scene, label in zip(scenes, labels, strict=True) for mesh in scene.meshes
    ])  # fmt: skip
