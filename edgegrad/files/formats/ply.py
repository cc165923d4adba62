"""Parts from the elements of PLY files. Columns that are read are taken out; those left at the end are noted as unread."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...scene.material import Material
from .context import LoadContext, linear_colors
from .part import FormatError, Part
from .ply_elements import Element, Lists, read_elements, read_header
from .polygons import triangulate

CORNERS = ("vertex_indices", "vertex_index")
COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
UVS = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
# These change no picture: alpha, which only glTF and OBJ files use, and what scanners say of a point.
HARMLESS = {"alpha", "diffuse_alpha", "a", "confidence", "quality", "flags"}


def read(data: bytes, context: LoadContext) -> list[Part]:
    """Return one part, or none. Raises FormatError."""
    header = read_header(data)
    rest = read_elements(data, header)
    if rest:
        context.unread.note(f"{rest} {'bytes' if header.order else 'numbers'} after the last element", "not read")
    elements = {element.name: element for element in header.elements}
    vertex, face, strips = (elements.pop(n, Element(n, 0, [], {})) for n in ("vertex", "face", "tristrips"))
    for name, element in elements.items():
        if element.size:
            context.unread.note(f"element {name}", "not read")
    if not vertex.size or not face.size + strips.size:
        return []
    verts = _take(vertex, ("x", "y", "z"))
    if verts is None:
        raise FormatError("expected numbers x, y and z of each vertex, got others; export it again")
    verts = verts.astype(np.float32 if verts.dtype.kind == "f" and verts.dtype.itemsize <= 4 else np.float64)
    corners = _corners(face) if face.size else Lists(np.empty(0, np.int64), np.empty(0, np.int64))
    more = _strips(_corners(strips).values) if strips.size else np.empty(0, np.int64)
    index = np.concatenate([corners.values, more])
    counts = np.concatenate([corners.counts, np.full(len(more) // 3, 3)])
    triangles, origin = triangulate(verts, index, counts, context)
    appearance: dict[str, Any] = {"normals": _take(vertex, ("nx", "ny", "nz"))} | _uvs(vertex, face, corners, triangles)
    appearance |= _texture(header.comments, face, appearance, context)
    if appearance["texture"] is None:
        appearance["colors"] = _colors(vertex, context)
        if appearance["colors"] is None and not strips.size and (colors := _colors(face, context)) is not None:
            appearance["face_colors"] = colors[torch.from_numpy(origin)]
    if not context.options.lit:
        del appearance["normals"]
    for element in (vertex, face, strips):
        left = [name for name in element.columns if name not in HARMLESS]
        if left and element.size:
            context.unread.note(f"{', '.join(left)} of {element.name}", "not read")
    return [Part("", verts, index[triangles], material=Material() if context.options.lit else None, **appearance)]


def _take(element: Element, names: tuple[str, ...]) -> np.ndarray | None:
    """Take columns (n, K) of numbers by name out of an element; None where some are missing, and none is taken."""
    columns = [element.columns.get(name) for name in names]
    found = [column for column in columns if isinstance(column, np.ndarray)]
    if len(found) < len(names):
        return None
    for name in names:
        del element.columns[name]
    return np.stack(found, 1)


def _corners(element: Element) -> Lists:
    """Return the vertices of each face: the list of a known name, or the only list of integers. Raises FormatError."""
    lists = {name: c for name, c in element.columns.items() if isinstance(c, Lists)}
    whole = [name for name, column in lists.items() if column.values.dtype.kind in "iu"]
    name = next((name for name in CORNERS if name in lists), whole[0] if len(whole) == 1 else None)
    if name is None:
        raise FormatError(
            f"expected a list vertex_indices in {element.name}, got {', '.join(element.columns)}; export it again"
        )
    del element.columns[name]
    index = lists[name].values.astype(np.int64)
    if (bad := np.flatnonzero(index != lists[name].values)).size:
        got = lists[name].values[bad[0]]
        raise FormatError(f"expected whole numbers for {name} in {element.name}, got {got:g}; export it again")
    return Lists(lists[name].counts, index)


def _strips(index: np.ndarray) -> np.ndarray:
    """Return corners of the triangles in strips that −1 separates. Every other triangle is flipped, degenerate ones are left
    out."""
    if len(index) < 3:
        return np.empty(0, np.int64)
    at = np.arange(len(index))
    since = at - np.maximum.accumulate(np.where(index < 0, at + 1, 0))  # the start of the strip
    triangles = np.stack([index[:-2], index[1:-1], index[2:]], 1)
    odd = since[:-2] % 2 == 1
    triangles[odd] = triangles[odd][:, [1, 0, 2]]
    a, b, c = triangles.T
    return triangles[(triangles >= 0).all(1) & (a != b) & (b != c) & (c != a)].reshape(-1)


def _uvs(vertex: Element, face: Element, corners: Lists, triangles: np.ndarray) -> dict[str, Any]:
    """Return texture coordinates of the corners of faces, or else of the vertices."""
    own = face.columns.get("texcoord")
    strips = len(triangles) > 0 and int(triangles.max()) >= len(corners.values)
    if isinstance(own, Lists) and not strips and (own.counts == 2 * corners.counts).all():
        del face.columns["texcoord"]
        return {"uvs": own.values.reshape(-1, 2).astype(np.float32), "uv_faces": triangles}
    for names in UVS:
        if (found := _take(vertex, names)) is not None:
            return {"uvs": found.astype(np.float32)}
    return {"uvs": None}


def _texture(comments: list[str], face: Element, appearance: dict[str, Any], context: LoadContext) -> dict[str, Any]:
    found = [re.match(r"comment\s+texturefile\s+(.*)", line, re.IGNORECASE) for line in comments]
    names = [match[1].strip() for match in found if match is not None]
    if not names or not context.options.materials:
        return {"texture": None}
    if len(names) == 1:
        face.columns.pop("texnumber", None)
    for name in names[1:]:
        context.unread.note(f"the texture {name!r}", f"{names[0]!r} in its place")
    image = context.folder.image(names[0])
    if appearance["uvs"] is None:
        raise FormatError(f"expected texture coordinates for its texture {names[0]!r}, got none; unwrap the mesh")
    return {"texture": context.textures.get(names[0], image)}


def _colors(element: Element, context: LoadContext) -> Tensor | None:
    """Return linear colours (n, 3). Integers have 8 bits, or as many as they need. Raises FormatError."""
    for names in COLORS:
        if (values := _take(element, names)) is None:
            continue
        if values.dtype == np.int8:
            values = values.view(np.uint8)
        elif values.dtype.kind in "iu" and values.dtype.itemsize > 1:
            most = values.max(initial=0)
            if values.dtype.name == "uint16" and 0 < most <= 255:
                context.unread.note(f"ushort colours of {element.name} up to {most}", "taken for 0 to 255, not 65535")
            kind = next((k for k in (np.uint8, np.uint16) if most <= np.iinfo(k).max), values.dtype.type)
            values = values / float(np.iinfo(kind).max)
        return linear_colors(element.name, values, srgb=True)
    return None
