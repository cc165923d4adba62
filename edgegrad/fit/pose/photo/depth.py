"""The depth term: inside the silhouette a sensor measures the distance of the surface along the camera's axis.

What covers the object is nearer and what is seen beside it farther, so large differences hardly count. As the pose moves, the
depth of a pixel changes by that of the surface's point, less what the point takes along: ∂z/∂p = z' − ∇z · u.
"""

from __future__ import annotations

from torch import Tensor

from ..gauss_newton import Normal
from .surface import Surface, slope

FEWEST = 30  # pixels
LEAST = 0.002  # standard deviation of a measurement, in sizes of the object
WIDEST = 0.05  # the same, at most: what is farther off is not the object
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
