"""Renders for display: in photographs, the render in the fitted light, with its outline, over the faded picture."""

from __future__ import annotations

import torch
from torch import Tensor

from ....aovs import render_aovs
from ...contour_colors import draw_contour
from ..pose import Pose
from ..robust_loss import Comparison
from ..task import BACKGROUND_BRIGHTNESS, PoseTask, PyramidLevel
from .light import HARMONICS, FittedLight, harmonics_of
from .picture import Picture
from .surface_interior import AOVS, SurfaceInterior


def overlay(task: PoseTask, level: PyramidLevel, pose: Pose) -> list[Tensor]:
    """Return linear pictures (h, w, C) of the level with the mesh at a pose. A mesh without colours shows its outline
    alone."""
    if not task.clutter:
        with torch.no_grad():
            return Comparison(task, level, task.images(level, pose, level.spp, 0)).renders
    moved = task.scene.transformed(pose.R, pose.t, pose.scale)
    found = []
    for shot in level.shots:
        camera = task.lens(shot.camera, pose)
        with torch.no_grad():
            channels = render_aovs(moved, camera, AOVS, level.spp, 0)
            alpha = channels["alpha"].float()
            image = shot.target * alpha if task.colorless else _lit(task, level, pose, channels, len(found))
        image = image + (1.0 - alpha) * BACKGROUND_BRIGHTNESS * shot.target
        found.append(draw_contour(image, alpha))
    return found


def _lit(task: PoseTask, level: PyramidLevel, pose: Pose, channels: dict[str, Tensor], k: int) -> Tensor:
    """Return the radiance (h, w, C) times alpha."""
    shot, image = level.shots[k], channels["image"].float()
    picture = Picture.from_shot(shot, False, None, shot.camera.size)
    surface = SurfaceInterior.from_channels(
        task.lens(shot.camera, pose), channels, task.motion(level._replace(dofs=task.dofs), shot, pose)
    )
    lit = FittedLight.from_picture(picture, surface, 1 if task.scene.is_shaded else HARMONICS)
    if lit is None:
        return image
    Y = harmonics_of(surface.normals)[..., : lit.coefficients.shape[1]]
    return (image * (Y @ lit.coefficients.T)).clamp(min=0.0)
