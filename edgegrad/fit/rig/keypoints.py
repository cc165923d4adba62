"""Joints that pictures show at known pixels, as a term of a fit."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from ...camera.camera import Camera
from ...check import as_tensor
from ...rig.rig import Rig
from ..measured import Measured
from .settings import RIG

NONZERO_ANGLE = 1e-9  # radians


def keypoint_term(
    rig: Rig, cameras: Sequence[Camera], given: Mapping[str, Tensor] | Measured
) -> Callable[[Mapping[str, Tensor]], Tensor]:
    """Return weight · mean of ρ(d² / σ²) over all visible keypoints, as a function of all values, with distances d and the width
    σ in pixels. ρ(x) = 2 √(1 + x) − 2 (Charbonnier et al. 1997) pulls from afar and gives no wrong point more weight than others.
    Raises TypeError or ValueError."""
    keypoints = given.values if isinstance(given, Measured) else given
    weight = RIG.keypoint_weight * (given.factor if isinstance(given, Measured) else 1.0)
    names = rig.deformer.names
    if not names:
        raise ValueError("keypoints: expected a rig with joints, got one without; give from_function(…, joints=…)")
    if not isinstance(keypoints, Mapping) or not keypoints:
        got = type(keypoints).__name__ if not isinstance(keypoints, Mapping) else "none"
        raise TypeError(f"keypoints: expected pixels (B, 2) by the names of joints, got {got}; None is without them")
    rows, where = [], []
    for name, one in keypoints.items():
        if name not in names:
            raise ValueError(f"keypoints: expected joints among {', '.join(names)}, got {name!r}")
        pixels = as_tensor(f"keypoints[{name!r}]", one, floating=True).detach().double()
        pixels = pixels[None] if pixels.dim() == 1 else pixels
        if pixels.shape != (len(cameras), 2):
            raise ValueError(
                f"keypoints[{name!r}]: expected shape ({len(cameras)}, 2), a pixel for each camera, got {tuple(pixels.shape)}"
            )
        rows.append(names.index(name))
        where.append(pixels)
    at = torch.stack(where, 1)  # (B, K, 2)
    seen = torch.isfinite(at).all(-1)
    if not bool(seen.any()):
        raise ValueError("keypoints: expected numbers for one at least, got none; leave them out")

    rotating = {name for name, control in rig.controls.items() if control.rotates} | {"orientation"}

    def term(values: Mapping[str, Tensor]) -> Tensor:
        # Gauss-Newton needs the second derivative of a rotation vector's length, which does not exist at 0.
        values = {name: value + NONZERO_ANGLE if name in rotating else value for name, value in values.items()}
        own = {name: value for name, value in values.items() if name in rig.controls}
        place = {name: value for name, value in values.items() if name not in rig.controls}
        joints = rig.shape(own, **place).joints
        assert joints is not None
        total = torch.zeros((), dtype=torch.float64)
        for camera, pixels, there in zip(cameras, at, seen, strict=True):
            if not bool(there.any()):
                continue
            shown = camera.project(joints[rows].to(camera.K.dtype)).double()[there]
            sigma = RIG.keypoint_width * float(torch.tensor(camera.size, dtype=torch.float64).norm())
            x = (shown - pixels[there]).square().sum(-1) / sigma**2
            total = total + 2.0 * ((1.0 + x).sqrt() - 1.0).sum()
        return weight * total / int(seen.sum())

    return term
