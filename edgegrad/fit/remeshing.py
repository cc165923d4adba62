"""Remeshing to even triangles."""

from __future__ import annotations

import math
from types import ModuleType

import numpy as np
import torch

from ..optional import require
from ..scene.mesh import Mesh
from ..scene.rows import areas

REMESHING_ROUNDS = 5


def remeshed(mesh: Mesh, faces: int) -> Mesh:
    """Return a mesh of about so many even triangles on the same surface (Botsch and Kobbelt 2004), by gpytoolbox. Raises
    ImportError."""
    area = 0.5 * float(areas(mesh.verts.double()[mesh.faces.long()]).norm(dim=1).sum())
    edge = math.sqrt(4.0 * area / (math.sqrt(3.0) * faces))  # of equilateral triangles with that area
    verts, triangles = gpytoolbox("remeshing").remesh_botsch(
        mesh.verts.double().numpy(), mesh.faces.numpy().astype(np.int32), REMESHING_ROUNDS, edge, True
    )
    return Mesh(torch.from_numpy(verts).to(mesh.verts.dtype), torch.from_numpy(triangles.astype(np.int64)))


def count_nonmanifold_edges(mesh: Mesh) -> int:
    """Count edges with more than two triangles, with which remeshed() does not work. Raises ImportError."""
    return len(gpytoolbox("remeshing").non_manifold_edges(mesh.faces.cpu().numpy().astype(np.int32)))


def gpytoolbox(purpose: str) -> ModuleType:
    return require("gpytoolbox", "edgegrad[fit]", purpose)
