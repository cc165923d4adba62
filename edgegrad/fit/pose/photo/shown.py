"""A pose as people look at it: in photographs, the render in the light found, with its outline, over the faded picture."""

from __future__ import annotations

import torch
from torch import Tensor

from ....aovs import render_aovs
from ...contour_colors import draw_contour
from ..observed import motion
from ..pose import Pose
from ..robust import Comparison
from ..task import FADED, Level, PoseTask
from .light import HARMONICS, Lit, spherical
from .picture import Picture
from .surface import AOVS, Surface


def shown(task: PoseTask, level: Level, pose: Pose) -> list[Tensor]:
    """Linear pictures (h, w, C) of the level. Of a mesh without colours the outline is all that is drawn."""
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
            image = shot.target * alpha if task.colourless else _lit(task, level, pose, channels, len(found))
        image = image + (1.0 - alpha) * FADED * shot.target
        found.append(draw_contour(image, alpha))
    return found


def _lit(task: PoseTask, level: Level, pose: Pose, channels: dict[str, Tensor], k: int) -> Tensor:
    """(h, w, C) radiance times alpha."""
    shot, image = level.shots[k], channels["image"].float()
    picture = Picture.of(shot, False, None, shot.camera.size)
    surface = Surface.of(
        task.lens(shot.camera, pose), channels, motion(task, level._replace(free=task.free), shot, pose)
    )
    lit = Lit.of(picture, surface, 1 if task.scene.is_shaded else HARMONICS)
    if lit is None:
        return image
    Y = spherical(surface.normals)[..., : lit.coefficients.shape[1]]
    return (image * (Y @ lit.coefficients.T)).clamp(min=0.0)
