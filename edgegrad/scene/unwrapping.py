"""Texture coordinates for meshes that have none."""

from __future__ import annotations

import math

import numpy as np
import torch

from ..check import check_int
from ..optional import require
from .mesh import Mesh


def unwrap(mesh: Mesh, size: int = 512, gap: int = 4) -> Mesh:
    """Return the mesh with texture coordinates: charts of little stretch, side by side in a square, by xatlas.

    Vertices and faces stay as they are; colours and textures are left away. fit_texture() and bake() need such coordinates.
    TypeError and ValueError name a wrong argument; ImportError says that xatlas is missing (`pip install 'edgegrad[fit]'`).

    Parameters
    ----------
    mesh : Mesh
    size : int, default 512
        Texels on a side of the texture that it is for.
    gap : int, default 4
        Texels between charts, so that a texel belongs to one of them.

    Examples
    --------
    >>> import edgegrad as eg
    >>> mesh = eg.textures.unwrap(eg.shapes.sphere(subdivisions=1), size=32)
    >>> texture = eg.textures.bake(mesh, lambda points: points.position.abs(), 32, progress=False)
    >>> mesh.replace(texture=texture)
    Mesh(42 vertices, 80 faces, texture (32, 32, 3), torch.float32)
    """
    if not isinstance(mesh, Mesh):
        raise TypeError(f"mesh: expected a Mesh, got {type(mesh).__name__}")
    check_int("size", size, 16, 1 << 14)
    check_int("gap", gap, 0, 64)
    xatlas = require("xatlas", "edgegrad[fit]", "unwrapping")
    verts, faces = mesh.verts.detach().cpu(), mesh.faces.cpu()
    # xatlas has tolerances for sizes about 1, and does not end at sizes far from it.
    low, high = verts.double().aminmax(dim=0)
    extent = float((high - low).max())
    if not extent > 0:
        raise ValueError("mesh: expected faces with an area, got all vertices in one place; give a surface")
    unit = ((verts.double() - (low + high) / 2) / 2.0 ** math.frexp(extent)[1]).float()
    pack = xatlas.PackOptions()
    pack.resolution, pack.padding, pack.bilinear = size, gap, True
    atlas = xatlas.Atlas()
    atlas.add_mesh(unit.numpy(), faces.numpy().astype(np.uint32))
    atlas.generate(xatlas.ChartOptions(), pack, False)
    _, corners, uvs = atlas[0]
    if not np.isfinite(uvs).all():
        raise ValueError("mesh: expected faces with an area, got none that xatlas can lay flat; give a surface")
    # At this resolution charts may not fill the square, or need a second one.
    if atlas.atlas_count > 1:
        pack.resolution = 0  # of its own choice
        atlas.generate(xatlas.ChartOptions(), pack, False)
        _, corners, uvs = atlas[0]
    return Mesh(
        verts.float(), faces, normals=mesh.normals, normal_faces=mesh.normal_faces,
        uvs=torch.from_numpy(np.ascontiguousarray(uvs)).float(),
        uv_faces=torch.from_numpy(corners.astype(np.int64)),
    )  # fmt: skip
