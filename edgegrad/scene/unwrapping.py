"""Texture coordinates for meshes that have none."""

from __future__ import annotations

import numpy as np
import torch

from ..check import check_int
from ..optional import require
from .mesh import Mesh


def unwrap(mesh: Mesh, size: int = 512, gap: int = 4) -> Mesh:
    """The mesh with texture coordinates for fit_texture(): charts of little stretch, side by side in a square, by xatlas.
    Vertices and faces stay as they are; colours and textures are left away.

    size  texels on a side of the texture that it is for
    gap   texels between charts, so that a texel belongs to one of them

    Needs xatlas (`pip install 'edgegrad[fit]'`). Raises TypeError or ValueError that names the argument, ImportError.
    """
    if not isinstance(mesh, Mesh):
        raise TypeError(f"mesh: expected a Mesh, got {type(mesh).__name__}")
    check_int("size", size, 16, 1 << 14)
    check_int("gap", gap, 0, 64)
    xatlas = require("xatlas", "edgegrad[fit]", "unwrapping")
    verts, faces = mesh.verts.detach().cpu().float(), mesh.faces.cpu()
    pack = xatlas.PackOptions()
    pack.resolution, pack.padding, pack.bilinear = size, gap, True
    atlas = xatlas.Atlas()
    atlas.add_mesh(verts.numpy(), faces.numpy().astype(np.uint32))
    atlas.generate(xatlas.ChartOptions(), pack, False)
    _, corners, uvs = atlas[0]
    # At this resolution charts may not fill the square, or need a second one.
    if atlas.atlas_count > 1:
        pack.resolution = 0  # of its own choice
        atlas.generate(xatlas.ChartOptions(), pack, False)
        _, corners, uvs = atlas[0]
    return Mesh(
        verts, faces, normals=mesh.normals, normal_faces=mesh.normal_faces,
        uvs=torch.from_numpy(np.ascontiguousarray(uvs)).float(),
        uv_faces=torch.from_numpy(corners.astype(np.int64)),
    )  # fmt: skip
