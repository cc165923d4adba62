"""The depth term: inside the silhouette a sensor measures the distance of the surface along the camera's axis.

Occluders are nearer and the background is further, so large differences hardly count. As the pose moves, the depth of a pixel
changes by that of the surface's point, less what the point takes along: ∂z/∂p = z' − ∇z · u.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ....aovs import render_aovs
from ....camera.camera import Camera
from ....scene.scene import Scene
from ....warnings import warn
from ..gauss_newton import NormalEquations
from ..inputs import without_colors
from .surface_interior import SurfaceInterior, slope

MIN_DEPTH_PIXELS = 30
MIN_DEPTH_NOISE = 0.002  # least standard deviation of a measurement, in sizes of the object
MAX_DEPTH_NOISE = 0.05  # The largest one: what is further off is not the object.
UNIT_FACTOR = 4.0  # Measurements off by a larger factor have other units.
UNIT_SPP = 4  # samples a pixel
CORRELATED_DEPTH_PIXELS = 4.0  # Errors of a sensor correlate: so many pixels count as one.


def depth_term(surface: SurfaceInterior, measured: Tensor, weight: Tensor, size: float) -> NormalEquations | None:
    """Return the equations from depth `measured` (h, w), NaN where there is none, of an object of that `size`; None where
    hardly any was measured."""
    z = surface.channels["depth"][..., 0].float() / surface.channels["alpha"][..., 0].clamp(min=1e-6)
    inside = surface.inside & measured.isfinite() & (weight > 0.0)
    if int(inside.sum()) < MIN_DEPTH_PIXELS:
        return None
    residual = (z - measured)[inside]
    deviation = min(max(1.4826 * float(residual.abs().median()), MIN_DEPTH_NOISE * size), MAX_DEPTH_NOISE * size)
    robust = weight[inside] * (1.0 + (residual / (3.0 * deviation)).square()).pow(-2)
    axis = surface.camera.world_to_camera[2, :3].double()
    among = inside[surface.inside]
    along = (surface.motion.of_points(surface.points[among]) @ axis).float()
    J = along - (surface.flow()[:, among] * slope(z[None])[:, 0, inside].T).sum(-1)
    information = 1.0 / (CORRELATED_DEPTH_PIXELS * deviation**2)
    weighted = (J * robust).double()
    return NormalEquations(information * weighted @ J.T.double(), information * weighted @ residual.double())


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
