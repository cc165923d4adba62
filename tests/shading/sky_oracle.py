"""Exact images of flat polygons under an even sky, without the kernel.

Light from one direction falls on a convex part of each polygon, and the camera sees all but convex parts of it. So the
image of what is lit is a sum of convex polygons by inclusion and exclusion, and PyTorch differentiates their areas. The
sky is the mean over many directions. No step, no edge sample and no ray takes part.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

F64 = torch.float64


class Pinhole(NamedTuple):
    """A perspective camera, and the rectangle of its image that is integrated."""

    K: Tensor  # (3, 3)
    world_to_camera: Tensor  # (4, 4)
    window: tuple[float, float, float, float]  # left, top, right, bottom, px

    @property
    def eye(self) -> Tensor:
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    def project(self, points: Tensor) -> Tensor:
        """Map world points (..., 3), all in front of the camera, to pixels (..., 2)."""
        q = points @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        return (q @ self.K.T)[..., :2] / q[..., 2:]


class Flat(NamedTuple):
    """A convex flat polygon that scatters light evenly."""

    corners: Tensor  # (M, 3)
    albedo: float
    normal: Tensor | None = None  # (3,) that shades it; None: its own


def radiant_flux(polygons: list[Flat], camera: Pinhole, radiance: float, directions: Tensor) -> Tensor:
    """Integrate the image of the polygons over the camera's window, px² · radiance, as a differentiable function of corners.

    polygons    all lie in front of the camera; they may pass through one another
    radiance    of the sky, which is not seen itself
    directions  (N, 3) unit vectors of equal weights that stand for all of the sphere
    """
    total = directions.new_zeros(())
    for index, receiver in enumerate(polygons):
        others = [other.corners for k, other in enumerate(polygons) if k != index]
        total = total + _scattered(receiver, others, camera, directions)
    return total * radiance * 4 * math.pi / len(directions)


def _scattered(receiver: Flat, others: list[Tensor], camera: Pinhole, directions: Tensor) -> Tensor:
    """Sum over directions the light that one polygon sends to the window, for a unit of irradiance of each."""
    corners = receiver.corners
    winding = torch.linalg.cross(corners[1] - corners[0], corners[2] - corners[0])
    g = normalize(winding, dim=0)
    n = g if receiver.normal is None else normalize(receiver.normal, dim=0)
    n = -n if n @ g < 0 else n
    if g @ (camera.eye - corners[0]) < 0:
        g, n = -g, -n
    lit = (directions @ g > 0) & (directions @ n > 0)
    l = directions[lit]
    # The shadow terminator of Chiang, Li and Burley 2019.
    G = ((l @ g) / ((g @ n) * (l @ n))).clamp(max=1.0)
    weight = (l @ n) * (G + G**2 - G**3) * receiver.albedo / math.pi

    left, top, right, bottom = camera.window
    window = torch.tensor([[left, top], [right, top], [right, bottom], [left, bottom]], dtype=F64)
    # What lies above the plane may hide the polygon, and may shade it.
    above = [_clip(other[None], (other - corners[0]) @ g) for other in others]
    above = [part for part in above if bool((part != part[:, :1]).any())]
    hiding = [camera.project(part) for part in above]
    shadows = []
    for part in above:
        height = (part - corners[0]) @ g
        shadow = part - (height / (l @ g)[:, None])[:, :, None] * l[:, None]
        for a, b in zip(corners, corners.roll(-1, 0), strict=True):
            inward = torch.linalg.cross(winding, b - a)
            shadow = _clip(shadow, (shadow - a) @ inward)
        shadows.append(camera.project(shadow))
    seen = _intersect(camera.project(corners)[None], window[None])
    rows = torch.arange(len(l))
    return _area_outside(seen, None, hiding, shadows, rows, weight)


def _area_outside(
    base: Tensor, at: Tensor | None, hiding: list[Tensor], shadows: list[Tensor], rows: Tensor, weight: Tensor
) -> Tensor:
    """Sum weight · area of what of convex polygons lies outside all others, by inclusion and exclusion.

    base  (1, M, 2) for all directions, where `at` is None, else (R, M, 2) for the directions `at` (R,)
    """
    of_each = _area(base).abs()
    total = of_each[0] * weight.sum() if at is None else of_each @ weight[at]
    for k, other in enumerate(hiding):
        part = _intersect(base, other)
        if bool((_area(part) != 0).any()):
            total = total - _area_outside(part, at, hiding[k + 1 :], shadows, rows, weight)
    for k, shadow in enumerate(shadows):
        part = _intersect(base, shadow if at is None else shadow[at])
        some = (_area(part) != 0).nonzero()[:, 0]
        if len(some):
            total = total - _area_outside(
                part[some], rows[some] if at is None else at[some], [], shadows[k + 1 :], rows, weight
            )
    return total


def _area(polygons: Tensor) -> Tensor:
    """Compute the signed areas (N,) of polygons (N, M, 2)."""
    p = polygons - polygons[:, :1]
    q = p.roll(-1, 1)
    return (p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]).sum(1) / 2


def _intersect(polygons: Tensor, others: Tensor) -> Tensor:
    """Intersect convex polygons (N or 1, M, 2) with convex ones (N or 1, K, 2); empty ones have the area 0."""
    area = _area(others.detach())
    count = max(len(polygons), len(others))
    out = polygons.expand(count, -1, -1)
    sign = torch.sign(area)[:, None]
    for a, b in zip(others.unbind(1), others.roll(-1, 1).unbind(1), strict=True):
        side = (b - a)[:, None]
        to = out - a[:, None]
        out = _clip(out, sign * (side[..., 0] * to[..., 1] - side[..., 1] * to[..., 0]))
    return torch.where((area != 0)[:, None, None], out, 0.0)


def _clip(polygons: Tensor, height: Tensor) -> Tensor:
    """Keep the parts of convex polygons (N, M, D) where an affine height, (N, M) at corners, is positive (Sutherland and
    Hodgman 1974). Corners may be repeated; of what is empty all are zero."""
    count, corners, size = polygons.shape
    height = height.expand(count, corners)
    after, next_height = polygons.roll(-1, 1), height.roll(-1, 1)
    crosses = height * next_height < 0
    part = height / torch.where(crosses, height - next_height, 1.0)
    crossing = polygons + torch.where(crosses, part, 0.0)[..., None] * (after - polygons)
    found = torch.stack([polygons, crossing], 2).reshape(count, 2 * corners, size)
    kept = torch.stack([height >= 0, crosses], 2).reshape(count, 2 * corners)
    order = (~kept).to(torch.int8).argsort(stable=True, dim=1)[:, : corners + 1]
    kept = kept.gather(1, order)
    found = found.gather(1, order[..., None].expand(-1, -1, size))
    found = torch.where(kept[..., None], found, found[:, :1])
    return torch.where(kept[:, :1, None], found, 0.0)


def even_directions(count: int, seed: int) -> Tensor:
    """Fill the unit sphere with unit vectors (N, 3), evenly (Roberts 2018), with a random shift."""
    shift = torch.rand(2, dtype=F64, generator=torch.Generator().manual_seed(seed))
    rows = torch.arange(count, dtype=F64)[:, None]
    u = (shift + rows * torch.tensor([0.7548776662466927, 0.5698402909980532], dtype=F64)) % 1
    z, turn = 2 * u[:, 0] - 1, 2 * math.pi * u[:, 1]
    across = (1 - z**2).sqrt()
    return torch.stack([across * turn.cos(), across * turn.sin(), z], 1)
