"""OBJ and OFF files in text, whose numbers keep all digits of the mesh's type.

trimesh writes a fixed number of decimals, by which a mesh that is a millionth large loses its vertices.
"""

from __future__ import annotations

from typing import Any

import numpy as np

DIGITS = {"float32": 9, "float64": 17}  # significant ones that give the number back


def to_off(made: Any, dtype: np.dtype) -> str:
    """Return the file of a trimesh.Trimesh that was made of a mesh of some type."""
    verts, faces = made.vertices, made.faces
    return f"OFF\n{len(verts)} {len(faces)} 0\n{_rows('', verts, dtype)}{_rows('3 ', faces, faces.dtype)}"


def to_obj(made: Any, dtype: np.dtype, stem: str, clamp: bool = False) -> tuple[str, dict[str, bytes]]:
    """Return the file, and the material library of this stem and the image by name, so that two files in one folder have their
    own. With `clamp`, the texture does not repeat."""
    faces, rows, visual = made.faces + 1, made.vertices, made.visual
    if visual.kind != "texture":
        if visual.kind is not None:
            rows = np.column_stack([rows, visual.vertex_colors[:, :3] / 255.0])
        return _rows("v ", rows, dtype) + _rows("f ", faces, faces.dtype), {}
    # Names of materials and images end at a space for many readers.
    extra_files, material = visual.material.to_simple().to_obj(name="_".join(stem.split()))
    name = f"{stem}.mtl"
    library = extra_files.pop(f"{material}.mtl")
    extra_files[name] = library.replace(b"map_Kd ", b"map_Kd -clamp on ") if clamp else library
    corners = np.repeat(faces, 2, axis=1)  # a vertex has one texture coordinate
    text = (
        f"mtllib {name}\nusemtl {material}\n{_rows('v ', rows, dtype)}{_rows('vt ', visual.uv, dtype)}"
        f"{('f' + ' %d/%d' * 3 + chr(10)) * len(faces) % tuple(corners.reshape(-1).tolist())}"
    )
    return text, extra_files


def _rows(before: str, values: np.ndarray, dtype: np.dtype) -> str:
    form = f"%.{DIGITS[dtype.name]}g" if dtype.kind == "f" else "%d"
    line = before + " ".join([form] * values.shape[1]) + "\n"
    return line * len(values) % tuple(np.asarray(values).reshape(-1).tolist())
