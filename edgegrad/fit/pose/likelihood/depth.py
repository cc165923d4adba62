"""The depth term: inside the silhouette a sensor measures the distance of the surface along the camera's axis.

Occluders are nearer and the background is further, so a measurement is the surface's with the density N(r; σ) of its difference
r, or else anything within the object's size. As the pose moves, the depth of a pixel changes by that of the surface's point,
less what the point takes along: ∂z/∂p = z' − ∇z · u, with the flow u of the points in the image.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..camera_motion import MovingCameras
from ..settings import POSE
from .light import inner_pixels, slope, weighted_median
from .picture import PictureLevel, RenderedPoses
from .term import Term


def depth_term(
    picture: PictureLevel, seen: RenderedPoses, moving: MovingCameras, flow: Tensor, scale: Tensor, size: float
) -> Term:  # fmt: skip
    """Return the term of N surfaces of the given scales (N,), for the picture of their box with depth (h, w); `flow` (D, N, 2,
    h, w) is of their points, and `size` the object's."""
    assert seen.position is not None and picture.depth is not None
    points = (seen.position / seen.alpha[:, None].clamp(min=1e-6)).double()
    axis = moving.cameras.world_to_camera[:, 2]  # (N, 4)
    s = scale[:, None, None]
    z = (s * (torch.einsum("nk,nkhw->nhw", axis[:, :3], points) + axis[:, 3, None, None])).float()
    inside = inner_pixels(seen.alpha) & picture.depth.isfinite() & (picture.weight > 0.0)
    residual = torch.where(inside, z - picture.depth.nan_to_num(), 0.0)
    weight = (picture.weight * inside).flatten(1)
    known = (inside.sum((1, 2)) >= POSE.min_depth_pixels).float()
    low, high = (size * share for share in POSE.depth_noise)
    deviation = (1.4826 * weighted_median(residual.abs().flatten(1), weight)).clamp(low, high)[:, None]
    r = residual.flatten(1)
    e = POSE.occluded
    likely = -0.5 * (r / deviation).square() - (deviation * math.sqrt(2.0 * math.pi) / size).log()
    share = (1.0 - e) * likely.exp() / ((1.0 - e) * likely.exp() + e)  # probability that it is the surface's
    gains = weight * ((1.0 - e) * likely.exp() + e).log() * known[:, None]
    dW = moving.tangents["world_to_camera"][:, :, 2]  # (D, N, 4)
    along = s * (torch.einsum("dnk,nkhw->dnhw", dW[..., :3], points) + dW[..., 3, None, None])
    rows = along.float() - (flow * slope(z).movedim(0, 1)).sum(2)
    information = share * weight / deviation.square() * known[:, None]
    return Term.from_rows(gains.reshape(residual.shape), rows.flatten(2).movedim(0, 1), information, r)
