"""What a search sees at one pose: renders beside the pictures, and the normal equations of a step from there."""

from __future__ import annotations

import torch
from torch import Tensor

from .gauss_newton import FIRST_PROBES, PROBES, Normal
from .jacobian import Motion, Rendered, crossed
from .pose import Pose
from .robust import Comparison
from .task import BEND, ENTRIES, GROW, PRINCIPAL, SHIFT, TURN, ZOOM, Level, PoseTask, Shot, focal_of


class Observed:
    """Renders of a level at one pose, compared."""

    def __init__(
        self, task: PoseTask, level: Level, pose: Pose, spp: int, seed: int, generator: torch.Generator | None = None
    ) -> None:
        """`generator`: of the probes of renders that have reverse mode alone; None where no step is taken from here."""
        self.task, self.level, self.pose, self.generator = task, level, pose, generator
        self.rendered: list[Rendered] = []
        if generator is not None and task.reverse_alone:
            self.p = torch.zeros(len(level.free), dtype=torch.float64, requires_grad=True)
            images = task.images(level, task.moved(pose, level.free, self.p), spp, seed)
        elif generator is not None:
            self.rendered = [
                Rendered(scene, camera, task.channels, spp, at) for scene, camera, at in task.views(level, pose, seed)
            ]
            images = [
                task.layers(level, shot, one.images) for shot, one in zip(level.shots, self.rendered, strict=True)
            ]
        else:
            with torch.no_grad():
                images = task.images(level, pose, spp, seed)
        self.compared = Comparison(task, level, images)

    def equations(self, c: float, first: bool) -> Normal:
        """Of the robust loss of width c; by more probes, where there are any, at the `first` point of a way."""
        residuals = self.compared.residuals(c)
        if not self.rendered:
            assert self.generator is not None
            return Normal.probed(self.p, residuals, FIRST_PROBES if first else PROBES, self.generator)
        dots = [
            self.task.layers(
                self.level, shot, one.derivatives(motion(self.task, self.level, shot, self.pose)), slopes=True
            )
            for one, shot in zip(self.rendered, self.level.shots, strict=True)
        ]
        return Normal.of(residuals, self.compared.tangents(c, dots))


def motion(task: PoseTask, level: Level, shot: Shot, pose: Pose) -> Motion:
    """That of the entries of a step which the level seeks: the derivatives of PoseTask.moved() and lens() where the step is
    zero, of what the shot sees. The object's centre goes a way in the first camera's axes, and the object turns and grows about
    it."""
    camera = task.shots[0].camera
    view = camera.world_to_camera.double()
    center = pose.matrix[:3, :3] @ task.center + pose.t
    depth = (view[:3, :3] @ center + view[:3, 3])[2]
    perspective = camera.projection != "orthographic"
    linear, way = torch.zeros(ENTRIES, 3, 3, dtype=torch.float64), torch.zeros(ENTRIES, 3, dtype=torch.float64)
    K, bend = torch.zeros_like(linear), torch.zeros(ENTRIES, ENTRIES - BEND, dtype=torch.float64)
    one = torch.eye(3, dtype=torch.float64)
    linear[TURN:SHIFT] = crossed(view[:3, :3])
    way[SHIFT:GROW] = task.size * one
    linear[GROW] = one
    K[ZOOM, :2, :2] = pose.focal * shot.camera.K[:2, :2]
    if perspective and GROW in level.free:
        linear[ZOOM] = -one
    elif perspective:
        way[ZOOM, 2] = depth
    for axis in (0, 1):
        K[PRINCIPAL + axis, axis, 2] = shot.camera.size[1]
        if perspective:
            way[PRINCIPAL + axis, axis] = -camera.size[1] / focal_of(camera) / pose.focal * depth
    bend[BEND:] = torch.eye(ENTRIES - BEND)
    free = torch.tensor(level.free)
    shift: Tensor = way @ view[:3, :3] - linear @ center
    lens = {"K": K[free]} if bool(K[free].any()) else {}
    if (free >= BEND).any():
        lens["distortion"] = bend[free]
    return Motion(linear[free], shift[free], **lens)
