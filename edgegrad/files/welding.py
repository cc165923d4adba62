"""Parts of mesh files as meshes: joined where their appearance is the same, and welded."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..scene.mesh import LARGEST_UV, Mesh
from .formats.geometry import compact
from .formats.part import FormatError, Part


def _appearance_of(part: Part) -> tuple[object, ...]:
    """Return a key that is equal for parts that may become one mesh."""
    missing = part.colors is None, part.face_colors is None, part.normals is None
    images = id(part.texture), id(part.alpha), id(part.material), tuple(sorted(part.material_uvs))
    return *missing, *images, part.cutoff if part.alpha is not None else None, part.wrap, part.filter


def merge(parts: list[Part]) -> Part:
    """Return one part from parts of the same appearance. Raises FormatError where it differs."""
    if len(parts) == 1:
        return parts[0]
    if len({_appearance_of(part) for part in parts}) > 1:
        names = ", ".join(repr(part.name) for part in parts[:5]) + (", …" if len(parts) > 5 else "")
        what = "textures or kinds of colour" if all(part.material is None for part in parts) else "materials or normals"
        raise FormatError(
            f"expected one mesh, got {len(parts)} parts ({names}) with different {what}; "
            "use load_scene, which keeps them apart, or materials=False"
        )

    def joined(name: str, join: Callable[[list], Any] = np.concatenate) -> Any:
        found = [getattr(part, name) for part in parts]
        return None if any(value is None for value in found) else join(found)

    def indices(rows: str, name: str) -> np.ndarray | None:
        """Return indices into joined rows, or None where they are the vertices' or missing."""
        given = [getattr(part, rows) for part in parts]
        if any(value is None for value in given) or (name != "faces" and all(getattr(p, name) is None for p in parts)):
            return None
        starts = np.cumsum([0] + [len(value) for value in given])
        own = [part.faces if getattr(part, name) is None else getattr(part, name) for part in parts]
        return np.concatenate([index + n for index, n in zip(own, starts, strict=False)])

    faces = indices("verts", "faces")
    assert faces is not None
    return parts[0]._replace(
        name="",
        verts=joined("verts"),
        faces=faces,
        uvs=joined("uvs"),
        uv_faces=indices("uvs", "uv_faces"),
        colors=joined("colors", torch.cat),
        face_colors=joined("face_colors", torch.cat),
        normals=joined("normals"),
        normal_faces=indices("normals", "normal_faces"),
        material_uvs={k: np.concatenate([part.material_uvs[k] for part in parts]) for k in parts[0].material_uvs},
    )


class Welded(NamedTuple):
    """Rows of which equal ones are kept once."""

    kept: np.ndarray  # (n,) which rows, in the order of the file
    faces: np.ndarray  # (F, 3), indices into these


def to_mesh(part: Part, dtype: torch.dtype = torch.float32, by: Welded | None = None) -> Mesh:
    """Return the mesh of a part in a type; vertices are welded in the type of the part before. Raises FormatError. `by` says
    which vertices are one where their positions alone do not decide."""
    by = welded(part.verts, part.faces) if by is None else by
    verts, faces = torch.from_numpy(part.verts[by.kept]).to(dtype), torch.from_numpy(by.faces)
    images: dict[str, Any] = {**_material(part), "name": part.name or None}
    shared = part.material is not None and set(part.material.textures) - set(part.material_uvs)
    textured = part.texture is not None or part.alpha is not None or bool(shared)
    if textured and part.uvs is None:
        raise FormatError(
            f"part {part.name!r}: expected texture coordinates for its texture, got none; unwrap the mesh"
        )
    # Coordinates that no texture of the file needs serve later textures, and shaders.
    if part.uvs is not None and (textured or bool((np.abs(part.uvs) <= LARGEST_UV).all())):
        images["uvs"], images["uv_faces"] = _weld(part.uvs, part.faces if part.uv_faces is None else part.uv_faces)
    if textured:
        wrap = part.wrap[0] if part.wrap[0] == part.wrap[1] else part.wrap
        images |= {"texture": part.texture, "wrap": wrap, "filter": part.filter}
    if part.alpha is not None:
        images |= {"alpha": part.alpha, "alpha_cutoff": part.cutoff}
    if part.normals is not None:
        index = part.faces if part.normal_faces is None else part.normal_faces
        corners = torch.from_numpy(part.normals)[torch.from_numpy(index)]
        normals = _of_vertices(corners, faces, len(verts))
        if normals is None:
            normals, images["normal_faces"] = _weld(part.normals, index)
        images["normals"] = normals
    if part.colors is None or part.texture is not None:
        return Mesh(verts, faces, face_colors=part.face_colors if part.texture is None else None, **images)
    corners = part.colors[torch.from_numpy(part.faces)]
    colors = _of_vertices(corners, faces, len(verts))
    return Mesh(verts, faces, corner_colors=corners if colors is None else None, colors=colors, **images)


def _material(part: Part) -> dict[str, Any]:
    """Return the material, with texture coordinates for textures that do not use the mesh's."""
    if part.material is None:
        return {}
    own = {}
    for name, rows in part.material_uvs.items():
        uvs, uv_faces = _weld(rows, part.faces)
        own[name] = part.material.textures[name].replace(uvs=uvs, uv_faces=uv_faces)
    return {"material": part.material.replace(**own) if own else part.material}


def _of_vertices(corners: Tensor, faces: Tensor, count: int) -> Tensor | None:
    """Return values (V, K) of vertices from values at corners (F, 3, K), or None where those at one vertex differ."""
    values = corners.new_zeros(count, corners.shape[-1])
    values[faces] = corners
    return values if torch.equal(values[faces], corners) else None


def _weld(rows: np.ndarray, index: np.ndarray) -> tuple[Tensor, Tensor]:
    """Return the rows that `index` (F, 3) uses, equal ones once, in the order of the file; and the index into them."""
    found = welded(rows, index)
    return torch.from_numpy(rows[found.kept]), torch.from_numpy(found.faces)


def welded(rows: np.ndarray, index: np.ndarray) -> Welded:
    """Weld the rows (N, K) that `index` (F, 3) uses."""
    used, flat = compact(index)
    rows = rows[used]
    order = np.lexsort(rows.T)
    starts = np.concatenate([[True], (rows[order[1:]] != rows[order[:-1]]).any(1)])
    first = np.empty(len(rows), np.int64)
    first[order] = order[starts][np.cumsum(starts) - 1]  # the sort is stable: a group starts with its first row
    kept, renumbered = np.unique(first, return_inverse=True)
    return Welded(used[kept], renumbered.reshape(-1)[flat.reshape(-1)].reshape(-1, 3).astype(np.int64))
