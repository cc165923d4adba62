"""The order of the corners of faces, which determines their front."""

from __future__ import annotations

import dataclasses

from .mesh import Mesh


def flipped(mesh: Mesh) -> Mesh:
    """Return the mesh inside out: the corners of all faces in reverse order, with all that is indexed by corners, and normals
    negated. A mesh that was mirrored by `transformed` has its front outside again."""

    def reversed_rows(value: object, name: str) -> dict[str, object]:
        rows = getattr(value, name)
        return {} if rows is None else {name: rows.flip(1)}

    fields: dict[str, object] = {}
    for name in ("faces", "uv_faces", "normal_faces", "corner_colors"):
        fields |= reversed_rows(mesh, name)
    if mesh.normals is not None:
        fields["normals"] = -mesh.normals
    if mesh.material is not None:
        textures = {name: t.replace(**reversed_rows(t, "uv_faces")) for name, t in mesh.material.textures.items()}
        fields["material"] = mesh.material.replace(**textures)
    # dataclasses.replace, for mesh.replace() takes a kind of colour as one that is new.
    return dataclasses.replace(mesh, **fields)  # type: ignore[arg-type]
