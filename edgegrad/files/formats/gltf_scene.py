"""Meshes that the nodes of a glTF file place."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from .context import LoadContext
from .gltf import File, entry
from .gltf_arrays import FAN, STRIP, TRIANGLES, Arrays, Geometry
from .gltf_material import Primitive
from .gltf_nodes import Placed, placed
from .gltf_texture import Images
from .part import FormatError


def instances(file: File, context: LoadContext) -> list[tuple[str, dict[str, Any], np.ndarray]]:
    """Return (name, arrays, matrix to world) of each primitive of triangles wherever a node shows it, in the order of meshes.
    The arrays are `vertices`, `faces` and `primitive`, which holds the others. Raises FormatError or FileNotFoundError."""
    arrays = Arrays(file, context.folder)
    images = Images(arrays)
    places: dict[int, list[Placed]] = {}
    for at in placed(file.tree):
        if at.visible and "mesh" in at.node:
            places.setdefault(at.node["mesh"], []).append(at)
    found = []
    for number in sorted(places):
        for name, primitive in primitives(file, number, images, context):
            raw = {"vertices": primitive.positions, "faces": primitive.triangles, "primitive": primitive}
            found += [(name, raw, at.of_primitive(primitive.given)) for at in places[number]]
    return found


def primitives(file: File, number: int, images: Images, context: LoadContext) -> Iterator[tuple[str, Primitive]]:
    """Yield the triangles of a mesh, with their names. Raises FormatError or FileNotFoundError."""
    mesh = entry(file.tree, "meshes", number)
    given = [primitive for primitive in mesh["primitives"] if primitive.get("mode", 4) in (TRIANGLES, STRIP, FAN)]
    for k, one in enumerate(given):
        name = f"{mesh.get('name', f'mesh {number}')}{f', primitive {k}' if len(given) > 1 else ''}"
        try:
            yield name, Primitive.from_geometry(Geometry(images.arrays, one), images, context)
        except FormatError as error:
            raise FormatError(f"part {name[:60]!r}: {error}") from error.__cause__
