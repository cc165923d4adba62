"""Unusual but valid OBJ, PLY, STL and OFF files, drawn by hypothesis, each with the arrays that it was written from.

Vertices lie on a parabola in a plane, so that any of them in their order are the corners of a convex face, whose fan is known.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np
from drawn_files import DrawnFile, ExpectedMesh
from hypothesis import strategies as st
from mesh_files import linear


class Shape(NamedTuple):
    verts: np.ndarray  # (V, 3) float64
    faces: list[list[int]]


EIGHTHS = st.integers(-64, 64).map(lambda n: n / 8)  # exact in any type of floating point, and as a decimal
NAMES = st.sampled_from(
    ["a", "Würfel", "solid part", "x#1", "vertex", "endsolid", "endsolid f", "facet", "o", "two  words", "é"]
)
COLORS = st.tuples(*[st.integers(0, 255)] * 3)
COMMENTS = st.sampled_from(["", "# José", "#f 1 2 3", "#", "# mtllib no.mtl"])


@st.composite
def shapes(draw: Any) -> Shape:
    """Draw faces of three to seven corners, in their order or reversed, from any corner on."""
    n = draw(st.integers(3, 9))
    t = np.arange(n) / 4
    plane = np.stack([t, t**2, np.zeros(n)], 1)[:, list(draw(st.permutations([0, 1, 2])))]
    offset = draw(st.sampled_from([0.0, 0.0, -3.0, 1000.5, 4600000.25]))
    order = draw(st.permutations(range(n)))
    verts = np.empty((n, 3))
    verts[list(order)] = plane + offset * np.array(draw(st.sampled_from([(1, 1, 1), (1, -1, 0), (0, 0, 1)])))
    faces = []
    for _ in range(draw(st.integers(1, 6))):
        corners = sorted(draw(st.sets(st.integers(0, n - 1), min_size=3, max_size=7)))
        corners = corners[(k := draw(st.integers(0, 6)) % len(corners)) :] + corners[:k]
        faces.append([order[i] for i in (corners[::-1] if draw(st.booleans()) else corners)])
    return Shape(verts, faces)


def fan(corners: list[Any]) -> list[list[Any]]:
    return [[corners[0], corners[i], corners[i + 1]] for i in range(1, len(corners) - 1)]


def fans(faces: list[list[Any]]) -> list[list[Any]]:
    return [triangle for corners in faces for triangle in fan(corners)]


def stripped(strips: list[list[int]]) -> list[list[int]]:
    """Return the triangles of strips, every other one reversed, without degenerate ones."""
    found = []
    for strip in strips:
        for i in range(len(strip) - 2):
            a, b, c = strip[i : i + 3]
            if len({a, b, c}) == 3:
                found.append([b, a, c] if i % 2 else [a, b, c])
    return found


def number(draw: Any, value: float) -> str:
    """Return a decimal as some program or other writes it."""
    plain = repr(float(value))
    forms = [
        plain,
        f"{value:.17g}",
        f"{value:.17e}",
        f"{value:.17E}",
        f"{value:.8f}",
        "+" + plain if value >= 0 else plain,
    ]
    if plain.endswith(".0"):
        forms += [plain[:-1], plain[:-2]]
    if plain.startswith("0."):
        forms.append(plain[1:])
    return draw(st.sampled_from(forms))


def numbers(draw: Any, values: Any) -> str:
    return draw(st.sampled_from([" ", "  ", "\t"])).join(number(draw, value) for value in values)


def encoded(draw: Any, lines: list[str]) -> bytes:
    text = draw(st.sampled_from(["\n", "\r\n", "\r"])).join(lines) + draw(st.sampled_from(["", "\n", "\n\n"]))
    return text.encode(draw(st.sampled_from(["utf-8", "latin-1", "utf-8-sig", "utf-16"])))


@st.composite
def obj_files(draw: Any) -> DrawnFile:
    """Draw lines in any order that the format allows, with materials, objects, and corners of all four kinds."""
    verts, faces = draw(shapes())
    colors = draw(st.one_of(st.none(), st.lists(COLORS, min_size=len(verts), max_size=len(verts))))
    uvs = [[draw(EIGHTHS), draw(EIGHTHS)] for _ in range(draw(st.integers(1, 4)))]
    normals = [[draw(EIGHTHS), draw(EIGHTHS), 1.0] for _ in range(draw(st.integers(1, 4)))]
    materials = dict(zip(draw(st.lists(NAMES, max_size=3, unique=True)), draw(st.tuples(*[COLORS] * 3)), strict=False))
    kinds = {"v": verts.tolist(), "vt": uvs, "vn": normals}
    last = {"v": lambda: [1.0] if colors is None and draw(st.booleans()) else [], "vt": lambda: [0.0] * draw(st.integers(0, 1)),
            "vn": lambda: []}  # fmt: skip
    count = dict.fromkeys(kinds, 0)
    queue = [kind for kind, rows in kinds.items() for _ in rows] + ["f"] * len(faces)
    queue = draw(st.permutations(queue))
    lines = [f"mtllib {draw(st.sampled_from(['a.mtl', ' a.mtl ', 'sub/my lib.mtl']))}"] if materials else []
    library = lines[0][7:].strip() if lines else ""
    parts: dict[tuple[str | None, str | None], list] = {}
    thing = material = None
    remaining = list(faces)
    for kind in queue:
        for _ in range(draw(st.integers(0, 1))):
            word = draw(st.sampled_from(["o", "usemtl", "g", "s", "", "#"]))
            if word == "o":
                thing = draw(NAMES)
                lines.append(f"o {thing}")
            elif word == "usemtl" and materials:
                material = draw(st.sampled_from(sorted(materials)))
                lines.append(f"usemtl {material}")
            elif word in ("g", "s"):
                lines.append({"g": "g f 1 2 3", "s": "s off"}[word])
            elif word == "#":
                lines.append(draw(COMMENTS))
        if kind != "f":
            row = kinds[kind][count[kind]]
            more = last[kind]()
            if kind == "v" and colors is not None:
                more = [c / 255 for c in colors[count[kind]]]
            count[kind] += 1
            lines.append(f"{draw(st.sampled_from(['', ' ']))}{kind} {numbers(draw, [*row, *more])}")
            continue
        corners = remaining.pop(0)
        has_uvs, has_normals = draw(st.booleans()), draw(st.booleans())
        words, given = [], []
        for vertex in corners:
            refs = [vertex, draw(st.integers(0, len(uvs) - 1)) if has_uvs else None,
                    draw(st.integers(0, len(normals) - 1)) if has_normals else None]  # fmt: skip
            given.append(refs)
            text = []
            for name, ref in zip(kinds, refs, strict=True):
                back = ref is not None and ref < count[name] and draw(st.booleans())
                text.append("" if ref is None else str(ref - count[name] if back else ref + 1))
            words.append(
                "/".join(text).rstrip("/") + ("/" if has_uvs and not has_normals and draw(st.booleans()) else "")
            )
        gap = draw(st.sampled_from([" ", "  ", "\t", " \\\n"]))
        lines.append(f"f {gap.join(words)}{draw(st.sampled_from(['', ' ', ' # f 1 2 3']))}")
        parts.setdefault((thing, material), []).extend(fan(given))
    several = len({line for line in lines if line.startswith("usemtl")}) > 1
    used: dict[str, int] = {}
    expected = []
    for (o, m), triangles in parts.items():
        name = "_".join(word for word in (o, m if several else None) if word) or "geometry"
        used[name] = used.get(name, 0) + 1
        index = np.array([[[-1 if ref is None else ref for ref in refs] for refs in t] for t in triangles])
        v, vt, vn = index[..., 0], index[..., 1], index[..., 2]
        appearance = None
        if colors is not None:
            appearance = linear(np.array(colors))[v]
        elif m is not None:
            appearance = np.broadcast_to(np.array(materials[m]) / 255, (*v.shape, 3))
        expected.append(
            ExpectedMesh(
                verts[v],
                appearance,
                np.array(uvs)[vt] if (vt >= 0).all() else None,
                np.array(normals)[vn] if (vn >= 0).all() else None,
                name if used[name] == 1 else f"{name}_{used[name] - 1}",
            )
        )
    content = {"a.obj": encoded(draw, [part for line in lines for part in line.split("\n")])}
    if materials:
        text = []
        for name, color in materials.items():
            text += [draw(COMMENTS), f"newmtl {name}", f"\tKd {numbers(draw, np.array(color) / 255)}", "illum 1"]
        content[library] = encoded(draw, text)
    return DrawnFile(content, expected)


TYPES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d",
         "int8": "b", "uint8": "B", "int32": "i", "float32": "f", "float64": "d"}  # fmt: skip
FORMATS = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}
COLOR_NAMES = [("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")]


@st.composite
def ply_files(draw: Any) -> DrawnFile:
    """Draw properties and elements in any order, of any type and name, among others that nobody reads."""
    verts, faces = draw(shapes())
    n, f = len(verts), len(faces)
    order = draw(st.sampled_from(["", "<", ">"]))
    real = st.sampled_from(["float", "float32", "double", "float64"])
    large = bool(np.abs(verts).max() > 1e5)
    place = draw(st.sampled_from(["double", "float64"])) if large and order else draw(real)
    vertex: list[list[tuple[str, str, list]]] = [[(place, axis, verts[:, i].tolist()) for i, axis in enumerate("xyz")]]
    face: list[list[tuple[str, str, list]]] = []
    index = draw(st.sampled_from(["char", "uchar", "short", "int", "uint", "int32"]))
    face.append([(f"list {draw(st.sampled_from(['uchar', 'char', 'int', 'uint8', 'ushort']))} {index}",
                  draw(st.sampled_from(["vertex_indices", "vertex_index"])), faces)])  # fmt: skip
    strips = draw(st.lists(st.lists(st.integers(0, n - 1), max_size=6), max_size=3)) if draw(st.booleans()) else None
    triangles = np.array(fans(faces) + stripped(strips or []))
    uvs = normals = appearance = None
    if draw(st.booleans()):
        rows = [[draw(EIGHTHS), draw(EIGHTHS), 1.0] for _ in range(n)]
        normals = np.array(rows)[triangles]
        kind = draw(real)
        vertex.append([(kind, name, [row[i] for row in rows]) for i, name in enumerate(("nx", "ny", "nz"))])
    if draw(st.booleans()):
        rows = [[draw(EIGHTHS), draw(EIGHTHS)] for _ in range(n)]
        uvs = np.array(rows)[triangles]
        names = draw(st.sampled_from([("s", "t"), ("u", "v"), ("texture_u", "texture_v")]))
        kind = draw(real)
        vertex.append([(kind, name, [row[i] for row in rows]) for i, name in enumerate(names)])
    if draw(st.booleans()):
        rows = [[[draw(EIGHTHS), draw(EIGHTHS)] for _ in corners] for corners in faces]
        if len(triangles) == len(fans(faces)):  # else those of the strips would have none
            uvs = np.array(fans(rows))
        flat = [[value for pair in row for value in pair] for row in rows]
        face.append([(f"list uchar {draw(real)}", "texcoord", flat)])
    on = draw(st.sampled_from(["vertex", "face", None]))
    if on is not None:
        count = n if on == "vertex" else f
        rows = np.array(draw(st.lists(COLORS, min_size=count, max_size=count)))
        rows[0, 0] = max(rows[0, 0], 2)  # or numbers up to 255 would be 0 and 1 alone
        kind, scale = draw(st.sampled_from([("uchar", 1), ("uint8", 1), ("int", 1), ("short", 1), ("ushort", 257), ("uint", 257),
                                            ("float", 1 / 255), ("double", 1 / 255), ("double", 1)]))  # fmt: skip
        names = draw(st.sampled_from(COLOR_NAMES))
        (vertex if on == "vertex" else face).append(
            [(kind, name, (rows[:, i] * scale).tolist()) for i, name in enumerate(names)]
        )
        shade = linear(rows)
        many = [len(corners) - 2 for corners in faces]
        if on == "vertex":
            appearance = shade[triangles]
        elif strips is None:
            appearance = np.repeat(shade.repeat(many, 0)[:, None], 3, 1)

    def others(count: int) -> list[list[tuple[str, str, list]]]:
        """Draw a number and a list that nothing reads."""
        found = [[("int", "label", [draw(st.integers(-5, 5)) for _ in range(count)])]] if draw(st.booleans()) else []
        if draw(st.booleans()):
            rows = [draw(st.lists(EIGHTHS, max_size=3)) for _ in range(count)]
            found.append([("list uchar double", "weights", rows)])
        return found

    elements = {
        "vertex": (n, [p for group in draw(st.permutations(vertex + others(n))) for p in group]),
        "face": (f, [p for group in draw(st.permutations(face + others(f))) for p in group]),
    }
    if strips is not None:
        joined = [i for strip in strips for i in [*strip, -1]]
        joined = joined[:-1] if draw(st.booleans()) else joined
        elements["tristrips"] = (1, [("list int int", "vertex_indices", [joined])])
    for name in draw(st.lists(st.sampled_from(["edge", "camera", "thing"]), unique=True, max_size=2)):
        count = draw(st.integers(0, 3))
        properties = [p for group in others(count) for p in group]
        if properties:
            elements[name] = (count, properties)
    head = ["ply", f"format {FORMATS[order]} 1.0"]
    body, rows = b"", []
    for name in draw(st.permutations(sorted(elements))):
        count, properties = elements[name]
        head += [draw(st.sampled_from(["comment José", "obj_info num_cols 3", "comment"])), f"element {name} {count}"]
        head += [f"property {kind} {label}" for kind, label, _ in properties]
        for row in range(count):
            words = []
            for kind, _, column in properties:
                value = column[row]
                if kind.startswith("list"):
                    _, length, kind = kind.split()
                    words.append(str(len(value)))
                    if order:
                        body += struct.pack(order + TYPES[length], len(value))
                else:
                    value = [value]
                whole = kind not in ("float", "float32", "double", "float64")
                words += [str(int(v)) if whole else number(draw, v) for v in value]
                if order:
                    body += struct.pack(
                        f"{order}{len(value)}{TYPES[kind]}", *([int(v) for v in value] if whole else value)
                    )
            rows.append(" ".join(words))
    newline = draw(st.sampled_from(["\n", "\r\n"]))
    text = newline.join([*head, "end_header", ""]).encode(draw(st.sampled_from(["utf-8", "latin-1"])))
    content = text + (body if order else newline.join([*rows, ""]).encode())
    return DrawnFile({"a.ply": content}, [ExpectedMesh(verts[triangles], appearance, uvs, normals)])


@st.composite
def stl_files(draw: Any) -> DrawnFile:
    """Draw a binary file, or a text of several solids in capitals or not, whose names may be keywords."""
    if draw(st.booleans()):
        verts, faces = draw(shapes())
        corners = verts[np.array(fans(faces))].astype("<f4")
        records = np.zeros(len(corners), [("normal", "<f4", 3), ("verts", "<f4", (3, 3)), ("attribute", "<u2")])
        records["verts"] = corners
        records["attribute"] = draw(st.integers(0, 65535))
        head = draw(st.sampled_from([b"", b"solid of a kind", b"COLOR=\xff\x00\xff\xff", b"Jos\xe9"]))
        head = head.ljust(80, draw(st.sampled_from([b" ", b"\0"])))
        more = bytes(draw(st.integers(0, 3)))
        content = head + struct.pack("<I", len(records)) + records.tobytes() + more
        return DrawnFile({"a.stl": content}, [ExpectedMesh(corners.astype(np.float64))])
    lines, parts = [], []
    capital, indent = draw(st.booleans()), draw(st.sampled_from(["", "  ", "\t"]))
    for name in draw(st.lists(st.one_of(st.just(""), NAMES), min_size=1, max_size=3)):
        verts, faces = draw(shapes())
        corners = verts[np.array(fans(faces))]
        lines.append(f"{'SOLID' if capital else 'solid'} {name}")
        for triangle in corners:
            block = ["facet normal 0 0 1", f"{indent}outer loop"]
            block += [f"{indent * 2}vertex {numbers(draw, v)}" for v in triangle]
            block += [f"{indent}endloop", "endfacet", *[""] * draw(st.integers(0, 1))]
            lines += [line.upper() if capital else line for line in block]
        lines.append(f"{'ENDSOLID' if capital else 'endsolid'} {draw(st.sampled_from(['', name]))}")
        parts.append(ExpectedMesh(corners, name=name or None))
    return DrawnFile({"a.stl": encoded(draw, lines)}, parts)


@st.composite
def off_files(draw: Any) -> DrawnFile:
    """Draw normals, colours and texture coordinates of vertices, or colours of faces."""
    verts, faces = draw(shapes())
    triangles = np.array(fans(faces))
    rows: list[list] = verts.tolist()
    word = "OFF"
    uvs = normals = appearance = None
    if draw(st.booleans()):
        word = "N" + word
        given = [[draw(EIGHTHS), draw(EIGHTHS), 1.0] for _ in verts]
        rows = [row + more for row, more in zip(rows, given, strict=True)]
        normals = np.array(given)[triangles]
    colors = draw(st.sampled_from(["vertex", "face", None]))
    whole = draw(st.booleans())
    alpha = draw(st.sampled_from([[], [255 if whole else 1.0]]))

    def shades(count: int) -> tuple[list, np.ndarray]:
        found = np.array(draw(st.lists(COLORS, min_size=count, max_size=count)))
        found[0, 0] = max(found[0, 0], 2)  # or whole numbers would be 0 and 1 alone
        return [[*(c if whole else c / 255).tolist(), *alpha] for c in found], linear(found)

    if colors == "vertex":
        word = "C" + word
        given, shade = shades(len(verts))
        rows = [row + more for row, more in zip(rows, given, strict=True)]
        appearance = shade[triangles]
    if draw(st.booleans()):
        word = "ST" + word
        given = [[draw(EIGHTHS), draw(EIGHTHS)] for _ in verts]
        rows = [row + more for row, more in zip(rows, given, strict=True)]
        uvs = np.array(given)[triangles]
    lists = [[len(corners), *corners] for corners in faces]
    text = [" ".join(map(str, row)) for row in lists]
    if colors == "face":
        given, shade = shades(len(faces))
        text = [f"{row} {numbers(draw, more)}" for row, more in zip(text, given, strict=True)]
        appearance = np.repeat(shade.repeat([len(corners) - 2 for corners in faces], 0)[:, None], 3, 1)
    counts = f"{len(verts)} {len(faces)}{draw(st.sampled_from(['', ' 0', ' 12']))}"
    head = [f"{word} {counts}"] if draw(st.booleans()) else [word, draw(COMMENTS), counts]
    lines = (
        head
        + [part for row in rows for part in (numbers(draw, row), *[draw(COMMENTS)] * draw(st.integers(0, 1)))]
        + text
    )
    return DrawnFile({"a.off": encoded(draw, lines)}, [ExpectedMesh(verts[triangles], appearance, uvs, normals)])


TEXT_FORMATS = {"obj": obj_files(), "ply": ply_files(), "stl": stl_files(), "off": off_files()}
