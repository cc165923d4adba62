"""Distortion by lenses of normalised image coordinates n = (X/Z, Y/Z) to m, which K takes to pixels; and where a panorama sees
a point.

The kernel has the same maps (csrc/camera/brown_conrady.h, fisheye.h, wide_fisheye.h, equirectangular.h).
"""

from __future__ import annotations

import torch
from torch import Tensor

# These numbers of coefficients a projection may have.
COEFFICIENT_COUNTS = {"perspective": (4, 5, 8), "fisheye": (4,), "panorama": (), "orthographic": ()}
MOST_COEFFICIENTS = 8  # what the kernel takes
MOST_TURNS = 4  # how often a panorama may reach around, either way


def distort(projection: str, q: Tensor, distortion: Tensor) -> Tensor:
    """Return m (…, 2) of q (…, 3), in camera coordinates, with the coefficients (4,), (5,) or (8,) in OpenCV's order."""
    return _fisheye(q, distortion) if projection == "fisheye" else _brown_conrady(q[..., :2] / q[..., 2:], distortion)


def longitude_latitude(q: Tensor) -> Tensor:
    """Return radians (…, 2) of q (…, 3) in camera coordinates: to the right in (−π, π], and downwards. Neither has a derivative
    on the vertical axis."""
    x, y, z = q.unbind(-1)
    return torch.stack([torch.atan2(x, z), torch.atan2(y, torch.hypot(x, z))], -1)


def _brown_conrady(n: Tensor, distortion: Tensor) -> Tensor:
    """Distort by Brown 1966 and Conrady 1919, with OpenCV's rational radial part: coefficients k1, k2, p1, p2, k3, k4, k5,
    k6."""
    k1, k2, p1, p2, k3, k4, k5, k6 = torch.nn.functional.pad(
        distortion, (0, MOST_COEFFICIENTS - len(distortion))
    ).unbind()
    x, y = n.unbind(-1)
    s = x * x + y * y
    g = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
    return torch.stack(
        [g * x + 2 * p1 * x * y + p2 * (s + 2 * x * x), g * y + p1 * (s + 2 * y * y) + 2 * p2 * x * y], -1
    )


def _fisheye(q: Tensor, distortion: Tensor) -> Tensor:
    """Distort by OpenCV's fisheye (Kannala and Brandt 2006): coefficients k1, k2, k3, k4 of the angle to the axis. It also
    serves behind the camera, where OpenCV mirrors points in the eye; on the axis there it is not a number."""
    across, z = q[..., :2], q[..., 2:]
    s = (across * across).sum(-1, keepdim=True)
    on_axis = s == 0
    r = torch.where(on_axis, torch.ones_like(s), s).sqrt()  # its square root has no derivative at zero
    a = torch.atan2(r, z)
    k1, k2, k3, k4 = distortion.unbind()
    t = a * a
    angle = a * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4))))
    ahead = torch.where(z > 0, 1 / z, torch.full_like(z, torch.nan))
    return torch.where(on_axis, ahead, angle / r) * across
