"""The depth term: inside the silhouette a sensor measures the distance of the surface along the camera's axis.

What covers the object is nearer and what is seen beside it farther, so large differences hardly count. As the pose moves, the
depth of a pixel changes by that of the surface's point, less what the point takes along: ∂z/∂p = z' − ∇z · u.
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
from ..gauss_newton import Normal
from ..given import bare
from .surface import Surface, slope

FEWEST = 30  # pixels
LEAST = 0.002  # standard deviation of a measurement, in sizes of the object
WIDEST = 0.05  # the same, at most: what is farther off is not the object
UNITS = 4.0  # what is measured where the object is, farther or nearer than it by this factor: other units
SAMPLES = 4  # a pixel, of a render that only tells them
TOGETHER = 4.0  # so many pixels count as one, for errors of a sensor are alike nearby


def depth_term(surface: Surface, measured: Tensor, weight: Tensor, size: float) -> Normal | None:
    """The equations, from depth `measured` (h, w), NaN where it was not, of an object of that `size`; None where hardly any of
    it was measured."""
    z = surface.channels["depth"][..., 0].float() / surface.channels["alpha"][..., 0].clamp(min=1e-6)
    inside = surface.inside & measured.isfinite() & (weight > 0.0)
    if int(inside.sum()) < FEWEST:
        return None
    residual = (z - measured)[inside]
    deviation = min(max(1.4826 * float(residual.abs().median()), LEAST * size), WIDEST * size)
    robust = weight[inside] * (1.0 + (residual / (3.0 * deviation)).square()).pow(-2)
    axis = surface.camera.world_to_camera[2, :3].double()
    among = inside[surface.inside]
    along = (surface.motion.of_points(surface.points[among]) @ axis).float()
    J = along - (surface.flow()[:, among] * slope(z[None])[:, 0, inside].T).sum(-1)
    information = 1.0 / (TOGETHER * deviation**2)
    weighted = (J * robust).double()
    return Normal(information * weighted @ J.T.double(), information * weighted @ residual.double())


def warn_of_units(scene: Scene, cameras: Sequence[Camera], depths: Sequence[Tensor | None], where: str) -> None:
    """Where depth images (H, W), NaN where nothing was measured, tell distances in other units than the scene, whose meshes are
    where they are looked for: the depth term would leave them all out."""
    measured, expected = [], []
    for camera, depth in zip(cameras, depths, strict=True):
        if depth is None:
            continue
        with torch.no_grad():
            seen = render_aovs(bare(scene), camera, ["depth", "alpha"], SAMPLES)
        alpha = seen["alpha"][..., 0]
        inside = (alpha > 0.5) & depth.isfinite()
        measured.append(depth[inside].double())
        expected.append((seen["depth"][..., 0] / alpha.clamp(min=0.5))[inside].double())
    if sum(map(len, measured)) < FEWEST:
        return
    there, here = (float(torch.cat(values).median()) for values in (measured, expected))
    ratio = here / there
    if not 1.0 / UNITS < ratio < UNITS:
        power = round(math.log10(ratio))
        scale = 10.0**power if abs(math.log10(ratio) - power) < 0.15 else ratio
        warn(
            f"units of depth {scale:.2g}",
            f"depth: expected distances in world units, those of the mesh and the camera, got {there:.3g} in the middle where "
            f"the object is {where}, {here:.3g} away; so depth counts for nothing. If its units are others, multiply it by "
            f"{scale:.2g}",
        )
