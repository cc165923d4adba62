"""Detect pictures whose rows come from the bottom up, as OpenGL's glReadPixels gives them."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ..aovs import render_aovs
from ..camera.camera import Camera
from ..scene.scene import Scene
from ..warnings import warn
from .views import PICTURES, Observation


def warn_of_flipped_rows(name: str, evidence: str) -> None:
    warn(
        "upside down",
        f"{name}: expected the upper row first, got what looks like images from the bottom up (OpenGL): turned over, "
        f"{evidence}; pass each as image.flip(0)",
    )


def check_mask_rows(views: Sequence[Observation], scene: Scene, cameras: Sequence[Camera]) -> None:
    """Warn if masks agree with the start only when they are flipped."""
    overlap = torch.zeros(2, 2, dtype=torch.float64)  # intersection and union, of masks as given and flipped
    given = [(view.mask, camera) for view, camera in zip(views, cameras, strict=True) if view.mask is not None]
    for mask, camera in given[: PICTURES.compared_views]:
        with torch.no_grad():
            alpha = render_aovs(scene, camera, ["alpha"], spp=4, seed=0)["alpha"]
        for row, image in zip(overlap, (mask, mask.flip(0)), strict=True):
            row += torch.stack([f(alpha, image).sum() for f in (torch.minimum, torch.maximum)]).double()
    as_given, turned = (overlap[:, 0] / overlap[:, 1].clamp(min=1e-30)).tolist()
    if turned > max(PICTURES.flipped_iou, as_given + PICTURES.iou_gain):
        warn_of_flipped_rows(
            "masks", f"they agree with the start at an IoU of {turned:.0%}, as given at {as_given:.0%}"
        )
