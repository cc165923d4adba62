"""Detect pictures whose rows come from the bottom up, as OpenGL's glReadPixels gives them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..aovs import render_aovs
from ..camera.camera import Camera
from ..scene.scene import Scene
from ..warnings import warn
from .views import Observation

MAX_VIEWS = 4  # that are compared
MIN_FLIPPED_IOU, MIN_IOU_GAIN = 0.75, 0.15  # IoU with flipped masks, and its gain over the given ones


def warn_of_flipped_rows(name: str, evidence: str) -> None:
    warn(
        "upside down",
        f"{name}: expected the upper row first, got what looks like images from the bottom up (OpenGL): turned over, "
        f"{evidence}; pass each as image.flip(0)",
    )


def check_mask_rows(views: Sequence[Observation], scene: Scene, cameras: Sequence[Camera]) -> None:
    """Warn if masks agree with the start only when they are flipped."""
    overlap = torch.zeros(2, 2, dtype=torch.float64)
    given = [(view.mask, camera) for view, camera in zip(views, cameras, strict=True) if view.mask is not None]
    for mask, camera in given[:MAX_VIEWS]:
        with torch.no_grad():
            alpha = render_aovs(scene, camera, ["alpha"], spp=4, seed=0)["alpha"]
        overlap += torch.stack([_intersection_and_union(alpha, image) for image in (mask, mask.flip(0))])
    as_given, turned = (overlap[:, 0] / overlap[:, 1].clamp(min=1e-30)).tolist()
    if turned > max(MIN_FLIPPED_IOU, as_given + MIN_IOU_GAIN):
        warn_of_flipped_rows(
            "masks", f"they agree with the start at an IoU of {turned:.0%}, as given at {as_given:.0%}"
        )


def _intersection_and_union(a: Tensor, b: Tensor) -> Tensor:
    return torch.stack([torch.minimum(a, b).sum(), torch.maximum(a, b).sum()]).double()
