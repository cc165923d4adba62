"""Depth images of a mesh in a pose, with one ray through the centre of each pixel."""

from __future__ import annotations

import torch
from torch import Tensor

from ..camera.camera import Camera
from ..points.rays import trace
from ..scene.mesh import Mesh

MARGIN = 2  # pixels around the box of the projected vertices


def depth_image(mesh: Mesh, pose: Tensor, camera: Camera) -> Tensor:
    """Return the depth (H, W) float64 along the optical axis at the pixels' centres, 0 where the mesh is not seen.

    Parameters
    ----------
    mesh, pose : Mesh, (4, 4)
        The pose is rigid, from the mesh to the camera. Depth is in units of the mesh.
    camera : Camera
        Pinhole camera at the origin, as Frame.camera.
    """
    H, W = camera.size
    depth = torch.zeros(H, W, dtype=torch.float64)
    verts = mesh.verts.detach().cpu().double() @ pose[:3, :3].T + pose[:3, 3]
    left, top, right, bottom = 0, 0, W, H
    if float(verts[:, 2].min()) > 0.0:
        xy = camera.project(verts)
        low, high = xy.amin(0).floor() - MARGIN, xy.amax(0).ceil() + MARGIN
        left, top = (max(0, int(value)) for value in low.clamp(max=2**30))
        right, bottom = (min(size, int(value)) for value, size in zip(high.clamp(min=0), (W, H), strict=True))
    if left >= right or top >= bottom:
        return depth
    directions = pixel_rays(camera)[top:bottom, left:right].reshape(-1, 3)
    moved = mesh.detach().to("cpu").replace(verts=verts)
    hits = trace(moved, directions.new_zeros(3), directions)
    part = torch.zeros(len(directions), dtype=torch.float64)
    part[hits.ray] = hits.depth.double()  # in multiples of the direction, whose Z is 1
    depth[top:bottom, left:right] = part.reshape(bottom - top, right - left)
    return depth


def pixel_rays(camera: Camera) -> Tensor:
    """Return directions (H, W, 3) float64 through the pixels' centres in camera coordinates, with Z = 1, of a pinhole camera."""
    H, W = camera.size
    y, x = torch.meshgrid(torch.arange(H) + 0.5, torch.arange(W) + 0.5, indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], -1).double()
    return pixels @ torch.linalg.inv(camera.K.double()).T
