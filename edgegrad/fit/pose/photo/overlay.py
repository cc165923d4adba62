"""Renders for display: the mesh in the fitted light before what stands behind it, or outlined over the faded photograph."""

from __future__ import annotations

import torch
from torch import Tensor

from ....files.image import srgb_to_linear
from ...contour_colors import draw_contour
from ...placement import Pose
from ..likelihood.objective import Comparison, whole_level
from ..likelihood.picture import Box
from ..task import BACKGROUND_BRIGHTNESS, PoseTask, scaled


def overlay(task: PoseTask, longest: int, spp: int, pose: Pose) -> list[tuple[Tensor, Tensor]]:
    """Return each picture (h, w, C), of at most so many pixels on its longest side, and the same with the mesh at a pose. A mesh
    without colours shows its outline alone."""
    factor = min(1.0, longest / max(task.shots[0].camera.size))
    level, found = whole_level(task, [scaled(shot.camera.size, factor) for shot in task.shots], spp), []
    for picture, one in zip(level.pictures, level.comparisons([pose]), strict=True):
        target = picture.outlined if picture.mask is not None and not len(picture.radiance) else picture.radiance
        h, w = picture.size
        whole = Box(slice(0, h), slice(0, w))
        alpha = one.seen.box.pasted(one.seen.alpha, whole)
        shown = one.seen.box.pasted(_shown(one), whole)
        if picture.background is not None:
            behind = srgb_to_linear(picture.background)
        else:
            behind = torch.zeros_like(target) if picture.mask is not None else BACKGROUND_BRIGHTNESS * target
        image, alpha = (shown + (1.0 - alpha) * behind).movedim(0, -1), alpha.movedim(0, -1)
        found.append((target.movedim(0, -1), draw_contour(image, alpha) if task.clutter else image))
    return found


def _shown(one: Comparison) -> Tensor:
    """Return the radiance (C, h, w) times alpha: in the fitted light where there is one."""
    if one.light is not None:
        return one.light.lit(one.seen)[0]
    if one.seen.color is not None:
        return one.seen.color[0]
    return one.part.radiance * one.seen.alpha if len(one.part.radiance) else one.seen.alpha
