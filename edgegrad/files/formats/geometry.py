"""Positions, triangles and normals of parts of a file, in their places."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ...scene.lights import PointLight, SpotLight
from ...scene.tree import moved
from .context import LoadContext
from .part import FormatError, MeshFile, Part


def shape(name: str, raw: dict[str, Any], matrix: np.ndarray) -> Part:
    """Return a part with vertices in their place, and triangles."""
    v, faces = np.asarray(raw["vertices"], np.float64), np.asarray(raw["faces"], np.int64)
    if v.ndim != 2 or v.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        got = f"{v.shape} and {faces.shape}"
        raise FormatError(f"expected positions (N, 3) and triangles (F, 3), got {got}; it may be truncated")
    with np.errstate(over="ignore", invalid="ignore"):
        # Elementwise: a matrix product may round equal rows differently, and they would not be welded.
        v = v[:, 0:1] * matrix[:3, 0] + v[:, 1:2] * matrix[:3, 1] + v[:, 2:3] * matrix[:3, 2] + matrix[:3, 3]
    part = Part(name, np.ascontiguousarray(v), np.ascontiguousarray(faces))
    # The front of a face stays its front in a mirror.
    return part.reversed() if np.linalg.det(matrix[:3, :3]) < 0.0 else part


def turned(part: Part, matrix: np.ndarray) -> np.ndarray | None:
    """Return normals (N, 3) float32 in the world. Raises FormatError for invalid ones."""
    if part.normals is None:
        return None
    n = np.asarray(part.normals, np.float64)
    fits = n.shape == part.verts.shape or part.normal_faces is not None
    if not fits or not np.isfinite(n).all():
        got = "some that are not finite" if fits else f"shape {n.shape}"
        raise FormatError(
            f"expected a finite normal for each of {len(part.verts)} vertices, got {got}; export it again"
        )
    a, b, c = matrix[:3, :3]
    # The inverse transpose times the determinant's size: it is there for any matrix.
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])
    n = n[:, 0:1] * cofactors[:, 0] + n[:, 1:2] * cofactors[:, 1] + n[:, 2:3] * cofactors[:, 2]
    length = np.linalg.norm(n, axis=1, keepdims=True)
    side = -1.0 if np.linalg.det(matrix[:3, :3]) < 0.0 else 1.0
    return (side * n / np.where(length > 0.0, length, 1.0)).astype(np.float32)


def checked(part: Part) -> Part:
    """Return the part itself when positions are finite, indices in range and colours as many as they should be."""
    N, F = len(part.verts), len(part.faces)
    with np.errstate(over="ignore"):
        finite = np.isfinite(part.verts.astype(np.float32))
    if not finite.all():
        bad = int(np.argwhere(~finite)[0, 0])
        raise FormatError(
            f"expected finite positions, as far as float32 reaches, got {part.verts[bad].tolist()} at vertex {bad}; repair it"
        )
    low, high = int(part.faces.min()), int(part.faces.max())
    if low < 0 or high >= N:
        raise FormatError(f"expected vertex indices from 0 to {N - 1}, got {low if low < 0 else high}; repair the mesh")
    for what, colors, count in (("vertices", part.colors, N), ("triangles", part.face_colors, F)):
        if colors is not None and len(colors) != count:
            raise FormatError(f"expected {count} colours for {count} {what}, got {len(colors)}; export triangles only")
    return part


def compact(index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows that an index of any shape uses, ascending, and the index into these."""
    low, high = int(index.min()), int(index.max())
    if high - low > 16 * index.size:  # few of many
        used, inverse = np.unique(index, return_inverse=True)
        return used, inverse.reshape(index.shape)
    there = np.zeros(high - low + 1, bool)
    there[index - low] = True
    return np.flatnonzero(there) + low, (np.cumsum(there) - 1)[index - low]


def rounding(*positions: np.ndarray) -> tuple[float, bool]:
    """Return how far float32 moves positions (N, 3) at most, and whether this is more than a millionth of their extent."""
    cost = max(float(np.abs(verts - verts.astype(np.float32)).max()) for verts in positions)
    low, high = np.min([verts.min(0) for verts in positions], 0), np.max([verts.max(0) for verts in positions], 0)
    return cost, cost > 1e-6 * float((high.astype(np.float64) - low).max())


def typed(model: MeshFile, dtype: torch.dtype | None, context: LoadContext) -> MeshFile:
    """Return the file's content in `dtype`; None is float64 where float32 would cost more than a millionth of the extent, else
    float32. Parts keep positions in the type that they are welded in; lights get the type of the meshes."""
    verts = [part.verts for part in model.parts]
    cost, precise = rounding(*verts)
    places = [light.position.numpy()[None] for light in model.lights if isinstance(light, (PointLight, SpotLight))]
    if places and not precise:  # the extent of the whole scene, for what is far from all may be rounded
        cost, precise = rounding(*verts, *places)
    if precise and dtype is torch.float32:
        context.unread.note(
            "positions in float64", f"rounded by up to {cost:.2g}, more than a millionth of the extent, as dtype says"
        )
    dtype = dtype or (torch.float64 if precise else torch.float32)
    model = model._replace(dtype=dtype, lights=[moved(light, dtype) for light in model.lights])
    if not precise and dtype is torch.float32:
        return model._replace(parts=[p._replace(verts=p.verts.astype(np.float32, copy=False)) for p in model.parts])
    parts = [part._replace(verts=part.verts.astype(np.float64)) for part in model.parts]
    return model._replace(parts=parts if dtype is torch.float32 else in_double(parts))


def in_double(parts: list[Part]) -> list[Part]:
    """Return parts with all that goes with positions in float64; what parts share is converted once."""
    known: dict[int, Any] = {}

    def double(value: Any) -> Any:
        if value is None or isinstance(value, np.ndarray):
            return None if value is None else value.astype(np.float64)
        if id(value) not in known:
            known[id(value)] = moved(value, torch.float64)
        return known[id(value)]

    names = ("uvs", "texture", "colors", "face_colors", "alpha", "normals", "material")
    return [
        part._replace(
            material_uvs={name: double(uvs) for name, uvs in part.material_uvs.items()},
            **{name: double(getattr(part, name)) for name in names},
        )
        for part in parts
    ]
