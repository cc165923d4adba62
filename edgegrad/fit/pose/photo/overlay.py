"""Renders for display: in photographs, the render in the fitted light, with its outline, over the faded picture."""

from __future__ import annotations

import torch
from torch import Tensor

from ...contour_colors import draw_contour
from ..likelihood.light import harmonics_of
from ..likelihood.objective import Comparison, whole_level
from ..pose import Pose
from ..robust_loss import Comparison as ColorComparison
from ..task import BACKGROUND_BRIGHTNESS, PoseTask, PyramidLevel


def overlay(task: PoseTask, level: PyramidLevel, pose: Pose) -> list[Tensor]:
    """Return linear pictures (h, w, C) of the level with the mesh at a pose. A mesh without colours shows its outline
    alone."""
    if not task.clutter:
        with torch.no_grad():
            return ColorComparison(task, level, task.images(level, pose, level.spp, 0)).renders
    found = []
    objective = whole_level(task, [shot.camera.size for shot in level.shots], level.spp)
    for shot, one in zip(level.shots, objective.comparisons([pose]), strict=True):
        alpha = torch.zeros(*shot.camera.size, 1, dtype=torch.float32)
        image = torch.zeros_like(shot.target)
        one.seen.box.cut(alpha.movedim(-1, 0)).copy_(one.seen.alpha)
        one.seen.box.cut(image.movedim(-1, 0)).copy_(_shown(one))
        image = image + (1.0 - alpha) * BACKGROUND_BRIGHTNESS * shot.target
        found.append(draw_contour(image, alpha))
    return found


def _shown(one: Comparison) -> Tensor:
    """Return the radiance (C, h, w) times alpha: in the fitted light where there is one."""
    seen, light = one.seen, one.light
    if seen.color is None or seen.normal is None:
        return one.part.radiance * seen.alpha
    if light is None:
        return seen.color[0]
    L = light.coefficients[0]
    return (seen.color[0] * torch.einsum("cn,nhw->chw", L, harmonics_of(seen.normal, L.shape[1])[0])).clamp(min=0.0)
