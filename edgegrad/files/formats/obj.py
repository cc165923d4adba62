"""OBJ files, with their materials.

trimesh takes the first face of a material for how all of them are written, so that normals may become texture coordinates. It
does not keep polygons, and drops what it does not know.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch

from .context import LoadContext, linear_colors
from .geometry import compact
from .mtl import Library
from .part import FormatError, Part
from .polygons import triangulate
from .text import as_utf8, numbers, per_line, table, unquoted, word_starts

KINDS = {b"v": "vertices (v)", b"vt": "texture coordinates (vt)", b"vn": "normals (vn)"}
# Keywords without a shape or a colour: groups, and hints on how to show curves.
HARMLESS = {b"g", b"mg", b"bevel", b"c_interp", b"d_interp", b"lod"}


class ObjLines(NamedTuple):
    """The lines of a file by keyword, without it."""

    rows: dict[bytes, list[bytes]]  # of v, vt and vn
    faces: list[bytes]
    counted: list[
        tuple[int, int, int, int]
    ]  # of each face that counts backwards: which, and how many v, vt and vn so far
    runs: list[tuple[int, str | None, str | None]]  # the first face with an object and a material
    libraries: list[str]
    smooth: bool  # in groups of smoothing
    unread: Counter[bytes]


class ObjCorners(NamedTuple):
    """The corners of all faces, one after the other."""

    rows: np.ndarray  # (C, 3) int64, of v, vt and vn, from 0; -1 for none
    counts: np.ndarray  # (F,) how many a face has


def read(data: bytes, context: LoadContext) -> list[Part]:
    """Return a part for each material and, with options.split, for each object. Raises FormatError or FileNotFoundError."""
    text = as_utf8(data)
    lines = _lines(text)
    if painted := len(re.findall(rb"(?m)^#MRGB[ \t]", text)):
        context.unread.note(f"{painted} × #MRGB", "colours of vertices by ZBrush are not read")
    for keyword, count in lines.unread.items():
        context.unread.note(f"{count} × {keyword.decode(errors='replace')[:40]}", "not read")
    library = Library(context)
    if context.options.materials:
        for name in dict.fromkeys(lines.libraries):
            _read_library(name, library, context)
        if not lines.libraries and any(material for _, _, material in lines.runs):
            context.unread.note("usemtl without a mtllib", "no materials")
    if lines.smooth and context.options.lit and not lines.rows[b"vn"]:
        context.unread.note("s", "flat faces, for there are no normals (vn)")
    if not lines.faces or not lines.rows[b"v"]:
        return []
    rows = {name: table(lines.rows[name], what, 1 if name == b"vt" else 3, 8) for name, what in KINDS.items()}
    corners = _corners(lines, {name: len(found) for name, (found, _) in rows.items()}, context)
    triangles, origin = triangulate(rows[b"v"][0][:, :3], corners.rows[:, 0], corners.counts, context)
    index = corners.rows[triangles]  # (T, 3, 3): corner, kind
    verts, normals = rows[b"v"][0][:, :3], rows[b"vn"][0][:, :3]
    uvs = np.pad(rows[b"vt"][0], ((0, 0), (0, 1)))[:, :2].astype(np.float32)  # v is 0 where there is u alone
    colors = _colors(*rows[b"v"], context)

    def has(name: bytes, index: np.ndarray) -> bool:
        there = index >= 0
        if there.any() and not there.all():
            context.unread.note(f"{KINDS[name]} that only some corners of a part have")
        return bool(there.all())

    parts = []
    for name, material, mine in _groups(lines, origin, context):
        own = index[mine]
        used, faces = compact(own[..., 0])
        part = Part(name, verts[used], faces)
        if has(b"vt", own[..., 1]):
            rows_used, uv_faces = compact(own[..., 1])
            part = part._replace(uvs=uvs[rows_used], uv_faces=uv_faces)
        if context.options.lit and has(b"vn", own[..., 2]):
            rows_used, normal_faces = compact(own[..., 2])
            part = part._replace(normals=normals[rows_used], normal_faces=normal_faces)
        if material and lines.libraries and context.options.materials and material not in library.materials:
            context.unread.note(f"usemtl {material}", "not in the material library")
        appearance = library.appearance(material, part.uvs, len(faces))
        if colors is not None and appearance.get("texture") is None:
            if (own_color := appearance.get("face_colors")) is not None and bool((own_color != 1.0).any()):
                context.unread.note("Kd beside colours of vertices")
            appearance |= {"colors": colors[torch.from_numpy(used)], "face_colors": None}
        elif colors is not None:
            context.unread.note("colours of vertices beside a texture")
        parts.append(part._replace(**appearance))
    return parts


def _lines(text: bytes) -> ObjLines:
    if b"#" in text:  # names may hold one
        text = re.sub(rb"(?m)^([ \t]*|[ \t]*(?:v|vt|vn|f)[ \t][^#\n]*(?:(?<=\\)\n[^#\n]*)*)#.*$", rb"\1", text)
    v, vt, vn, faces = list[bytes](), list[bytes](), list[bytes](), list[bytes]()
    counted, libraries, unread = [], [], Counter[bytes]()
    thing = material = None
    smooth = False
    runs: list[tuple[int, str | None, str | None]] = [(0, None, None)]
    for line in text.replace(b"\\\n", b" ").split(b"\n"):
        words = line.split(None, 1)
        if not words:
            continue
        keyword, rest = words[0], words[1] if len(words) > 1 else b""
        if keyword == b"v":
            v.append(rest)
        elif keyword == b"f":
            if b"-" in rest:
                counted.append((len(faces), len(v), len(vt), len(vn)))
            faces.append(rest)
        elif keyword == b"vt":
            vt.append(rest)
        elif keyword == b"vn":
            vn.append(rest)
        elif keyword in (b"usemtl", b"o"):
            if keyword == b"o":
                thing = rest.decode().strip()
            else:
                material = rest.decode().strip()
            runs.append((len(faces), thing, material))
        elif keyword == b"mtllib":
            libraries.append(rest.decode().strip())
        elif keyword == b"s":
            smooth = smooth or rest.strip().lower() not in (b"", b"0", b"off")
        elif keyword not in HARMLESS:
            unread[keyword] += 1
    return ObjLines({b"v": v, b"vt": vt, b"vn": vn}, faces, counted, runs, libraries, smooth, unread)


def _read_library(name: str, library: Library, context: LoadContext) -> None:
    """Read one file, whose name may hold spaces, or several. Raises FormatError or FileNotFoundError."""
    names = name.split()
    several = len(names) > 1 and all(word.lower().endswith(".mtl") for word in names) and not context.folder.holds(name)
    for each in names if several else [unquoted(name)]:
        library.read(context.folder.get(each), each)


def _corners(lines: ObjLines, sizes: dict[bytes, int], context: LoadContext) -> ObjCorners:
    """Return the indices of corners, written as `1 2 3`, `1/1 2/2 3/3`, `1//1 2//2 3//3` or `1/1/1 2/2/2 3/3/3`, mixed in any
    way. Indices below zero count from the last row so far. Raises FormatError."""
    text = b"\n".join(lines.faces) + b"\n"
    values = numbers(text.replace(b"/", b" "), "the faces", np.int64)
    letters = np.frombuffer(text, np.uint8)
    space, slash = letters <= 32, letters == ord("/")
    corner_at, number_at = word_starts(~space), word_starts(~(space | slash))
    counts = per_line(corner_at, letters)
    if len(number_at) != len(values):
        raise FormatError(
            "expected numbers parted by spaces and slashes in the faces, got others; the file cannot be read"
        )
    index = np.full((int(counts.sum()), 3), -1)
    if slash.any():
        corner = np.searchsorted(corner_at, number_at, side="right") - 1
        slash_at = np.flatnonzero(slash)
        kind = np.searchsorted(slash_at, number_at) - np.searchsorted(slash_at, corner_at)[corner]
        if kind.max() > 2:
            raise FormatError(
                "expected up to three numbers in a corner, as in 1/1/1, got more; the file cannot be read"
            )
    else:
        corner, kind = np.arange(len(values)), np.zeros(len(values), np.int64)
    if not values.all():
        raise FormatError("expected indices that count from 1, got 0 in a face; repair the mesh")
    if lines.counted:
        so_far = np.array(lines.counted)
        face = np.arange(len(counts)).repeat(counts)[corner]
        back = np.flatnonzero(values < 0)
        values[back] += so_far[np.searchsorted(so_far[:, 0], face[back]), kind[back] + 1] + 1
    for which, (name, what) in enumerate(KINDS.items()):
        mine = values[kind == which] if slash.any() else values if which == 0 else values[:0]
        if len(mine) and which and not sizes[name]:
            context.unread.note(f"{what} of faces", "left out, for there are none")
            values, corner, kind = values[kind != which], corner[kind != which], kind[kind != which]
        elif len(mine) and (mine.min() < 1 or mine.max() > sizes[name]):
            bad = int(mine.min() if mine.min() < 1 else mine.max())
            raise FormatError(f"expected indices of {what} from 1 to {sizes[name]}, got {bad}; repair the mesh")
    index[corner, kind] = values - 1
    if (index[:, 0] < 0).any():
        raise FormatError("expected a vertex at each corner of a face, got none; the file cannot be read")
    return ObjCorners(index, counts)


def _colors(rows: np.ndarray, widths: np.ndarray, context: LoadContext) -> torch.Tensor | None:
    """Return the colours after the positions of vertices, if all have some."""
    if widths.min() >= 6:
        return linear_colors("vertex", rows[:, 3:6], srgb=True)
    if widths.max() >= 5:
        context.unread.note("what stands after the positions of some vertices")
    return None


def _groups(lines: ObjLines, origin: np.ndarray, context: LoadContext) -> Iterator[tuple[str, str | None, np.ndarray]]:
    several = len({material for _, _, material in lines.runs if material is not None}) > 1
    starts = np.array([start for start, _, _ in lines.runs])
    run = np.searchsorted(starts, np.arange(len(lines.faces)), side="right") - 1
    parts: dict[tuple[str | None, str | None], int] = {}
    of_run = np.zeros(len(starts), np.int64)
    for i in np.unique(run):  # those that have faces, in the order of the file
        _, thing, material = lines.runs[i]
        of_run[i] = parts.setdefault((thing if context.options.split else None, material), len(parts))
    part = of_run[run][origin]
    order = np.argsort(part, kind="stable")
    ends = np.cumsum(np.bincount(part, minlength=len(parts)))
    used: Counter[str] = Counter()
    for (thing, material), mine in zip(parts, np.split(order, ends[:-1]), strict=True):
        if len(mine):
            words = [word for word in (thing, material if several else None) if word]
            name = "_".join(words) or "geometry"
            used[name] += 1
            yield name if used[name] == 1 else f"{name}_{used[name] - 1}", material, mine
