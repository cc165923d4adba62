"""OFF files of Geomview: vertices as text, with colours, normals and texture coordinates where the first word says so.

trimesh keeps the positions and faces alone.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import torch

from ...scene.material import Material
from .context import LoadContext, linear_colors
from .part import FormatError, Part
from .polygons import triangulate
from .text import as_utf8, numbers, ragged, table


def read(data: bytes, context: LoadContext) -> list[Part]:
    """Return one part, or none. Raises FormatError."""
    text = re.sub(rb"#.*", b"", as_utf8(data))
    # Some files have their numbers right after the word.
    head = re.match(rb"\s*(ST)?(C)?(N)?(4)?(n)?OFF(?![A-Za-z_])[ \t]*(BINARY)?", text)
    if head is None:
        raise FormatError(
            "expected an OFF file, got one that cannot be read, without OFF at its start; export it again"
        )
    has_uvs, has_colors, has_normals, four, any_size, binary = head.groups()
    if binary or any_size:
        raise FormatError(
            f"expected an OFF file in text, in three dimensions, got {head[0].decode().strip()!r}; export it again"
        )
    lines = [line for line in text[head.end() :].split(b"\n") if not line.isspace() and line]
    sizes = numbers(lines[0], "the numbers of vertices and faces", np.int64) if lines else ()
    if len(sizes) < 2 or min(sizes) < 0:
        raise FormatError(
            "expected the numbers of vertices and faces, got none; the file cannot be read, and may be truncated"
        )
    n, f = int(sizes[0]), int(sizes[1])
    if len(lines) - 1 < n:
        raise FormatError(
            f"expected the {n} vertices that the file announces, got {len(lines) - 1}; it cannot be read as a whole"
        )
    if len(lines) - 1 - n < f:
        raise FormatError(
            f"expected the {f} faces that the file announces, got {len(lines) - 1 - n}; it is truncated or damaged"
        )
    if len(lines) - 1 - n > f:
        context.unread.note(f"{len(lines) - 1 - n - f} lines after the last face", "not read")
    if not n or not f:
        return []
    size = 4 if four else 3
    rows, counts = table(lines[1 : n + 1], "the vertices", size + (3 if has_normals else 0), 16)
    if four and (rows[:, 3] != 1.0).any():
        rows[:, :3] /= rows[:, 3:4]
    appearance, at = dict[str, Any](), size
    if has_normals:
        appearance["normals"] = rows[:, at : at + 3] if context.options.lit else None
        at += 3
    last = min(int(counts.min()), rows.shape[1]) - (2 if has_uvs else 0)
    if has_uvs and last >= at:
        appearance["uvs"] = rows[:, last : last + 2].astype(np.float32)
    if has_colors and last - at >= 3:
        appearance["colors"] = linear_colors("vertex", rows[:, at : at + 3], srgb=True)
    elif last > at or counts.min() < counts.max():
        context.unread.note(f"{counts.max() - at} more numbers of each vertex", "not read")
    values, many = ragged(lines[n + 1 : n + 1 + f], "the faces")
    starts = np.cumsum(many) - many
    corners = values[starts].astype(np.int64)
    if (corners != values[starts]).any() or (corners > many - 1).any():
        raise FormatError(
            "expected the number of its corners before each face, got another; the file cannot be read as a whole"
        )
    place = np.arange(len(values)) - starts.repeat(many)  # in the line
    index = values[(place >= 1) & (place <= corners.repeat(many))]
    if (index != np.floor(index)).any():
        raise FormatError("expected whole numbers in the faces, got others; the file cannot be read as a whole")
    index = index.astype(np.int64)
    triangles, origin = triangulate(rows[:, :3], index, corners, context)
    more = many - 1 - corners
    if more.min() >= 3 and more.max() <= 4 and "colors" not in appearance:
        colors = values[(starts + 1 + corners)[:, None] + np.arange(3)]
        appearance["face_colors"] = linear_colors("face", colors, srgb=True)[torch.from_numpy(origin)]
    elif more.any():
        context.unread.note("colours of faces", "not read")
    return [Part("", rows[:, :3], index[triangles], material=Material() if context.options.lit else None, **appearance)]
