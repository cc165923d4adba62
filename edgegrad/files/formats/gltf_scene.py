"""What the nodes of a glTF file show."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from .gltf import File, entry
from .gltf_arrays import FAN, STRIP, TRIANGLES, Arrays, Geometry
from .gltf_material import Primitive
from .gltf_nodes import Placed, placed
from .gltf_texture import Images
from .part import Fault
from .source import Source


def instances(file: File, source: Source) -> list[tuple[str, dict[str, Any], np.ndarray]]:
    """(name, arrays, matrix to world) of each primitive of triangles wherever a node shows it, in the order of meshes. The
    arrays are `vertices`, `faces` and `primitive`, which knows the others. Raises Fault or FileNotFoundError."""
    arrays = Arrays(file, source.folder)
    images = Images(arrays)
    places: dict[int, list[Placed]] = {}
    for at in placed(file.tree):
        if at.visible and "mesh" in at.node:
            places.setdefault(at.node["mesh"], []).append(at)
    found = []
    for number in sorted(places):
        for name, primitive in primitives(file, number, images, source):
            raw = {"vertices": primitive.positions, "faces": primitive.triangles, "primitive": primitive}
            found += [(name, raw, at.of_primitive(primitive.given)) for at in places[number]]
    return found


def primitives(file: File, number: int, images: Images, source: Source) -> Iterator[tuple[str, Primitive]]:
    """The triangles of a mesh, with their names. Raises Fault or FileNotFoundError."""
    mesh = entry(file.tree, "meshes", number)
    given = [primitive for primitive in mesh["primitives"] if primitive.get("mode", 4) in (TRIANGLES, STRIP, FAN)]
    for k, one in enumerate(given):
        name = f"{mesh.get('name', f'mesh {number}')}{f', primitive {k}' if len(given) > 1 else ''}"
        try:
            yield name, Primitive.of(Geometry(images.arrays, one), images, source)
        except Fault as fault:
            raise Fault(f"part {name[:60]!r}: {fault}") from fault.__cause__
