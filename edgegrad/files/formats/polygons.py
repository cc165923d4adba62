"""Faces with any number of corners as triangles."""

from __future__ import annotations

import numpy as np

from ...optional import require
from .context import LoadContext
from .part import FormatError

# Rounded coordinates may turn a triangle over by this share of its face's area, at a corner of 180 degrees.
SLACK = 1e-6


def triangulate(
    verts: np.ndarray, index: np.ndarray, counts: np.ndarray, context: LoadContext
) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles (T, 3) as positions in `index`, and the face (T,) that each is from. `index` names the vertices of the
    corners of all faces one after the other. `counts` (F,) says how many corners a face has; faces of fewer than three are left
    out. A face is a fan around its first corner where this covers it once, as it does every convex one. Else a quad is split
    along its other diagonal, and what remains goes to earcut, all in Newell's plane. Faces that cross themselves are noted.
    Raises FormatError, or ImportError without mapbox_earcut, which only concave faces with more than four corners need."""
    if not (whole := counts >= 3).all():
        context.unread.note(f"{np.count_nonzero(~whole)} faces of fewer than three corners")
        if not whole.any():
            return np.empty((0, 3), np.int64), np.empty(0, np.int64)
        rows = np.flatnonzero(whole.repeat(counts))
        triangles, origin = triangulate(verts, index[rows], counts[whole], context)
        return rows[triangles], np.flatnonzero(whole)[origin]
    low, high = int(index.min()), int(index.max())
    if low < 0 or high >= len(verts):
        raise FormatError(
            f"expected vertex indices from 0 to {len(verts) - 1}, got {low if low < 0 else high}; repair the mesh"
        )
    if (counts == 3).all():
        return np.arange(len(index)).reshape(-1, 3), np.arange(len(counts))
    starts, many = np.cumsum(counts) - counts, counts - 2
    first = np.cumsum(many) - many
    triangles = np.empty((int(many.sum()), 3), np.int64)
    crossing: list[int] = []
    for k in np.unique(counts):
        faces = np.flatnonzero(counts == k)
        corners = starts[faces, None] + np.arange(k)
        local, crossed = _split(verts[index[corners]].astype(np.float64, copy=False))
        rows = np.take_along_axis(corners, np.maximum(local, 0).reshape(len(faces), -1), 1).reshape(-1, k - 2, 3)
        triangles[first[faces, None] + np.arange(k - 2)] = np.where(local < 0, -1, rows)
        crossing += faces[crossed].tolist()
    if crossing:
        context.unread.note(
            f"{len(crossing)} faces that cross themselves, the first of them face {min(crossing)}, counted from 0",
            "triangles that may overlap",
        )
    origin = np.arange(len(counts)).repeat(many)
    kept = triangles[:, 0] >= 0
    return (triangles, origin) if kept.all() else (triangles[kept], origin[kept])


def _split(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles (m, k - 2, 3) of polygons (m, k, 3) by number of the corner, −1 where there are fewer; and which
    polygons (c,) cross themselves."""
    m, k, _ = points.shape
    fan = np.stack([np.zeros(k - 2, np.int64), np.arange(1, k - 1), np.arange(2, k)], -1)
    triangles = np.broadcast_to(fan, (m, k - 2, 3)).copy()
    if k == 3:
        return triangles, np.empty(0, np.int64)
    normal, area, whole = _fan(points)
    left = np.flatnonzero(~whole)
    if k == 4 and len(left):
        other = _fan(np.roll(points[left], -1, axis=1))[2]
        triangles[left[other]] = (fan + 1) % 4
        left = left[~other]
    crossing = []
    for i in left:
        found, simple = _earcut(points[i], normal[i]) if area[i] > 0.0 else (None, False)
        if found is not None:
            triangles[i] = -1
            triangles[i, : len(found)] = found[: k - 2]
        if not simple:
            crossing.append(i)
    return triangles, np.array(crossing, np.int64)


def _fan(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Newell's unit normals (m, 3), twice the areas (m,) and whether a fan around the first corner covers each polygon
    once (m,). The polygons are (m, k, 3). Areas are zero where they are no more than rounding."""
    spokes = points[:, 1:] - points[:, :1]
    a, b = spokes[:, :-1], spokes[:, 1:]
    cross = np.stack([a[..., i] * b[..., j] - a[..., j] * b[..., i] for i, j in ((1, 2), (2, 0), (0, 1))], -1)
    total = cross.sum(1)
    area = np.sqrt((total**2).sum(-1))
    normal = total / np.where(area > 0.0, area, 1.0)[:, None]
    signed = (cross * normal[:, None]).sum(-1)
    flat = area <= 1e-9 * np.sqrt((cross**2).sum(-1)).sum(-1)  # nothing at all, or halves that cancel
    whole = (signed >= -SLACK * area[:, None]).all(1)
    if points.shape[1] > 4:  # a spiral turns by more than once around
        whole &= np.arctan2(signed, (a * b).sum(-1)).sum(-1) < 2.0 * np.pi - SLACK
    nothing = (cross == 0.0).all((1, 2))
    return normal, np.where(flat, 0.0, area), (whole & ~flat) | nothing


def _earcut(points: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray | None, bool]:
    """Return triangles (t, 3) of one polygon (k, 3), up to k - 2, and whether it is simple; None where there are none."""
    earcut = require("mapbox_earcut", "edgegrad[files]", "splitting concave faces into triangles")
    axis = int(np.abs(normal).argmax())
    flat = (points - points[0])[:, [(axis + 1) % 3, (axis + 2) % 3]]
    if normal[axis] < 0.0:
        flat = flat[:, ::-1]
    flat = np.ascontiguousarray(flat)
    found = earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32)).reshape(-1, 3).astype(np.int64)
    if not len(found):
        return None, False
    a, b = flat[found[:, 1]] - flat[found[:, 0]], flat[found[:, 2]] - flat[found[:, 0]]
    areas = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    x, y = flat.T
    whole = float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
    simple = abs(float(np.abs(areas).sum()) - whole) <= SLACK * whole and len(found) <= len(flat) - 2
    # Their side is not promised.
    return np.where((areas < 0.0)[:, None], found[:, ::-1], found), simple
