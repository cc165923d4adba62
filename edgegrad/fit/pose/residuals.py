"""Differences between renders and pictures at one pose, and the normal equations of a step from there."""

from __future__ import annotations

import torch

from .gauss_newton import FIRST_PROBES, PROBES, NormalEquations
from .jacobian import Rendered
from .pose import Pose
from .robust_loss import Comparison
from .task import PoseTask, PyramidLevel


class PoseResiduals:
    """Renders of a level at one pose, compared with the pictures."""

    def __init__(
        self, task: PoseTask, level: PyramidLevel, pose: Pose, spp: int, seed: int, generator: torch.Generator | None = None
    ) -> None:  # fmt: skip
        """`generator` draws the probes of renders without forward mode; None where no step follows."""
        self.task, self.level, self.pose, self.generator = task, level, pose, generator
        self.rendered: list[Rendered] = []
        if generator is not None and task.reverse_alone:
            self.p = torch.zeros(len(level.dofs), dtype=torch.float64, requires_grad=True)
            images = task.images(level, task.moved(pose, level.dofs, self.p), spp, seed)
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

    def equations(self, c: float, first: bool) -> NormalEquations:
        """Return the equations of the robust loss of width c. The `first` point of a descent takes more probes, where
        any are needed."""
        residuals = self.compared.residuals(c)
        if not self.rendered:
            assert self.generator is not None
            return NormalEquations.from_probes(self.p, residuals, FIRST_PROBES if first else PROBES, self.generator)
        dots = [
            self.task.layers(
                self.level, shot, one.derivatives(self.task.motion(self.level, shot, self.pose)), slopes=True
            )
            for one, shot in zip(self.rendered, self.level.shots, strict=True)
        ]
        return NormalEquations.from_tangents(residuals, self.compared.tangents(c, dots))
