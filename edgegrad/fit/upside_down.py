"""Pictures whose rows come from the bottom up, as OpenGL's glReadPixels gives them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..aovs import render_aovs
from ..camera.camera import Camera
from ..scene.scene import Scene
from ..warnings import warn
from .views import View

MOST = 4  # views to look at
ALIKE, BETTER = 0.75, 0.15  # IoU with masks that are turned over, and by how much it is more than with those given


def say_upside_down(name: str, evidence: str) -> None:
    warn(
        "upside down",
        f"{name}: expected the upper row first, got what looks like images from the bottom up (OpenGL): turned over, "
        f"{evidence}; pass each as image.flip(0)",
    )


def warn_of_masks(views: Sequence[View], scene: Scene, cameras: Sequence[Camera], name: str = "masks") -> None:
    """Where masks agree with what the scene shows at the start only if they are turned over."""
    overlap, given = (
        torch.zeros(2, 2, dtype=torch.float64),
        [i for i, view in enumerate(views) if view.mask is not None],
    )
    for i in given[:MOST]:
        mask = views[i].mask
        assert mask is not None
        with torch.no_grad():
            alpha = render_aovs(scene, cameras[i], ["alpha"], spp=4)["alpha"]
        overlap += torch.stack([_intersection_and_union(alpha, image) for image in (mask, mask.flip(0))])
    as_given, turned = (overlap[:, 0] / overlap[:, 1].clamp(min=1e-30)).tolist()
    if turned > max(ALIKE, as_given + BETTER):
        say_upside_down(name, f"they agree with the start at an IoU of {turned:.0%}, as given at {as_given:.0%}")


def _intersection_and_union(a: Tensor, b: Tensor) -> Tensor:
    return torch.stack([torch.minimum(a, b).sum(), torch.maximum(a, b).sum()]).double()
