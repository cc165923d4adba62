"""Regularizers of shapes and textures: terms to add to a loss for what the pictures leave open.

All are numbers without units, so one weight serves meshes of any scale. verts are (V, 3), faces (F, 3).
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..scene.rows import areas, unit

__all__ = ["area", "edge_length", "laplacian", "normal_consistency", "total_variation"]


def edges(faces: Tensor) -> Tensor:
    """Return every edge (E, 2) int64 once, its smaller vertex first."""
    return torch.unique(_sides(faces), dim=0)


def edge_pairs(faces: Tensor) -> Tensor:
    """Return the two faces (P, 2) int64 of every edge that has two."""
    owner = torch.arange(len(faces)).repeat(3)
    _, inverse, counts = torch.unique(_sides(faces), dim=0, return_inverse=True, return_counts=True)
    inner = (counts == 2)[inverse]
    order = torch.argsort(inverse[inner], stable=True)
    return owner[inner][order].reshape(-1, 2)


def _sides(faces: Tensor) -> Tensor:
    f = faces.long()
    return torch.cat([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]).sort(dim=1).values


def laplacian(verts: Tensor, faces: Tensor) -> Tensor:
    """Return the mean |v − mean of its neighbours|², in squared mean edge lengths: zero where the surface is flat and even.

    Parameters
    ----------
    verts, faces : (V, 3) float, (F, 3) int

    Examples
    --------
    >>> import edgegrad as eg
    >>> ball, box = eg.shapes.sphere(), eg.shapes.box()
    >>> bool(eg.fit.regularizers.laplacian(ball.verts, ball.faces) < eg.fit.regularizers.laplacian(box.verts, box.faces))
    True
    """
    pairs = edges(faces)
    both = torch.cat([pairs, pairs.flip(1)])
    count = torch.zeros(len(verts), dtype=verts.dtype).index_add(0, both[:, 0], verts.new_ones(len(both)))
    sums = torch.zeros_like(verts).index_add(0, both[:, 0], verts[both[:, 1]])
    used = count > 0
    apart = verts[used] - sums[used] / count[used, None]
    size = (verts[pairs[:, 0]] - verts[pairs[:, 1]]).square().sum(1).mean().detach()
    return apart.square().sum(1).mean() / size.clamp(min=1e-30)


def edge_length(verts: Tensor, faces: Tensor) -> Tensor:
    """Return the variance of the edges' lengths over their mean square: zero when all are equal.

    Parameters
    ----------
    verts, faces : (V, 3) float, (F, 3) int
    """
    pairs = edges(faces)
    length = (verts[pairs[:, 0]] - verts[pairs[:, 1]]).norm(dim=1)
    return length.var(correction=0) / length.square().mean().detach()


def normal_consistency(verts: Tensor, faces: Tensor) -> Tensor:
    """Return the mean 1 − n₁·n₂ of faces that share an edge: zero where the surface is flat.

    Parameters
    ----------
    verts, faces : (V, 3) float, (F, 3) int
    """
    normals = unit(areas(verts[faces.long()])).to(verts.dtype)
    first, second = normals[edge_pairs(faces)].unbind(1)
    return (1.0 - (first * second).sum(1)).mean()


def area(verts: Tensor, faces: Tensor) -> Tensor:
    """Return the area of the surface, in squared diagonals of its bounding box.

    It prefers the smallest surface that the pictures allow. In a fit to silhouettes nothing else removes what no view shows to
    be empty or full.

    Parameters
    ----------
    verts, faces : (V, 3) float, (F, 3) int
    """
    a, b, c = verts[faces.long()].unbind(1)
    low, high = verts.detach().aminmax(dim=0)
    return 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=1).sum() / (high - low).square().sum().clamp(min=1e-30)


def total_variation(texture: Tensor) -> Tensor:
    """Return the mean |difference of neighbouring texels| of (h, w, C): it keeps edges and removes speckles.

    Parameters
    ----------
    texture : (h, w, C) float
    """
    return (texture[1:] - texture[:-1]).abs().mean() + (texture[:, 1:] - texture[:, :-1]).abs().mean()
