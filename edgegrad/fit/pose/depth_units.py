"""A warning where depth images have other units than the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ...aovs import render_aovs
from ...camera.camera import Camera
from ...scene.scene import Scene
from ...warnings import warn
from .inputs import without_colors

MIN_DEPTH_PIXELS = 30
UNIT_FACTOR = 4.0  # Measurements off by a larger factor have other units.
UNIT_SPP = 4  # samples a pixel


def warn_of_units(scene: Scene, cameras: Sequence[Camera], depths: Sequence[Tensor | None], where: str) -> None:
    """Warn where depth images (H, W), NaN without a measurement, have units other than the scene's, with its meshes where they
    are expected. The depth term would reject all such measurements."""
    measured, expected = [], []
    for camera, depth in zip(cameras, depths, strict=True):
        if depth is None:
            continue
        with torch.no_grad():
            seen = render_aovs(without_colors(scene), camera, ["depth", "alpha"], UNIT_SPP, 0)
        alpha = seen["alpha"][..., 0]
        inside = (alpha > 0.5) & depth.isfinite()
        measured.append(depth[inside].double())
        expected.append((seen["depth"][..., 0] / alpha.clamp(min=0.5))[inside].double())
    if sum(map(len, measured)) < MIN_DEPTH_PIXELS:
        return
    there, here = (float(torch.cat(values).median()) for values in (measured, expected))
    ratio = here / there
    if not 1.0 / UNIT_FACTOR < ratio < UNIT_FACTOR:
        power = round(math.log10(ratio))
        scale = 10.0**power if abs(math.log10(ratio) - power) < 0.15 else ratio
        warn(
            f"units of depth {scale:.2g}",
            f"depths: expected distances in world units, those of the mesh and the camera, got {there:.3g} in the middle where "
            f"the object is {where}, {here:.3g} away; so depth counts for nothing. If its units are others, multiply it by "
            f"{scale:.2g}",
        )
