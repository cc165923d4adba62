"""STL files, in text and binary. trimesh refuses binary ones whose length is odd, and takes words of names for keywords."""

from __future__ import annotations

import re

import numpy as np

from ...scene.material import Material
from .context import LoadContext
from .part import FormatError, Part
from .polygons import triangulate
from .text import MARKS, as_utf8, table

HEADER = 84  # bytes of a binary file before its faces
FACE = np.dtype([("normal", "<f4", 3), ("verts", "<f4", (3, 3)), ("attribute", "<u2")])
SILENT = {b"facet", b"outer", b"endfacet"}  # with the normals of faces, which their corners say too
WORDS = SILENT | {b"vertex", b"endloop"}
TEXT = re.compile(rb"\s*((#|//)[^\r\n]*[\r\n]\s*)*(solid|facet)", re.IGNORECASE)


def read(data: bytes, context: LoadContext) -> list[Part]:
    """Return a part for each solid of a text, one for a binary file. Raises FormatError."""
    material = Material() if context.options.lit else None
    if data.startswith(MARKS):
        data = as_utf8(data)
    count = int.from_bytes(data[80:HEADER], "little")
    exact = len(data) == HEADER + count * FACE.itemsize
    text = TEXT.match(data[:1000]) and b"\0" not in data  # a binary one has zeros somewhere
    parts = _read_text(as_utf8(data), context) if text and not exact else _read_binary(data, count, context)
    return [part._replace(material=material) for part in parts]


def _read_binary(data: bytes, count: int, context: LoadContext) -> list[Part]:
    if b"\0" not in data and data[:HEADER].isascii():
        raise FormatError("expected an STL file, got text without solid or facet at its start; export it again")
    if len(data) < HEADER:
        raise FormatError(f"expected an STL file, got {len(data)} bytes that cannot be read as one; export it again")
    there, odd = divmod(len(data) - HEADER, FACE.itemsize)
    if not count and there and not odd:
        context.unread.note("0 as the number of faces", f"{there}, by the length of the file")
        count = there
    if there < count:
        raise FormatError(
            f"expected the {count} faces that the file announces, got {max(there, 0)}; it is truncated or damaged"
        )
    rest = len(data) - HEADER - count * FACE.itemsize
    if rest:
        context.unread.note(f"{rest} bytes after the last of {count} faces", "not read")
    faces = np.frombuffer(data, FACE, count, HEADER)
    if faces["attribute"].any():
        context.unread.note("the attributes of faces, where some writers keep colours", "not read")
    if b"COLOR=" in data[:80]:
        context.unread.note("COLOR= of the header", "a colour by Materialise is not read")
    if not count:
        return []
    return [Part("", faces["verts"].reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))]


def _read_text(text: bytes, context: LoadContext) -> list[Part]:
    solids: list[tuple[str, list[bytes], list[int]]] = []  # name, positions, and how many of them a face has
    corners, start = list[bytes](), 0
    ended = True
    if b"\n" not in text.strip():
        text = re.sub(rb"\s(facet|outer|vertex|endloop|endfacet|endsolid)\b", rb"\n\1", text)
    for line in text.split(b"\n"):
        words = line.split(None, 1)
        if not words:
            continue
        word = words[0] if words[0] in WORDS else words[0].lower()
        if word.startswith((b"#", b"//")):
            continue
        if word in WORDS and not solids:  # without solid before it
            solids.append(("", corners, []))
        if word == b"vertex":
            corners.append(words[-1])
        elif word in SILENT:
            continue
        elif word == b"endloop":
            solids[-1][2].append(len(corners) - start)
            start = len(corners)
        elif word == b"solid":
            corners, start, ended = [], 0, False
            solids.append((words[1].strip().decode() if len(words) > 1 else "", corners, []))
        elif word == b"endsolid":
            ended = True
        else:
            context.unread.note(word.decode(errors="replace")[:40], "not read")
    if not ended or start < len(corners):
        raise FormatError(
            "expected endsolid at the end of the file, got none: it is truncated or damaged; export it again"
        )
    parts = []
    for name, rows, counts in solids:
        if counts:
            verts = table(rows, "the vertices", 3, 3)[0]
            index = np.arange(len(verts))
            triangles, _ = triangulate(verts, index, np.array(counts), context)
            parts.append(Part(name, verts, triangles))
    return parts
