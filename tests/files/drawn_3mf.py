"""Unusual but valid 3MF files, which hypothesis draws, each with the arrays that it was written from."""

from __future__ import annotations

import io
import uuid
import zipfile
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from drawn_files import DrawnFile, ExpectedMesh, one_of, placed
from hypothesis import strategies as st

Draw = Callable[[st.SearchStrategy], Any]
MICROSOFT = "http://schemas.microsoft.com/3dmanufacturing"
SPACES = {"": f"{MICROSOFT}/core/2015/02", "p": f"{MICROSOFT}/production/2015/06", "m": f"{MICROSOFT}/material/2015/02"}


OPC = "application/vnd.openxmlformats-package"
CONTENT_TYPES = (
    f'<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types"><Default Extension="rels" '
    f'ContentType="{OPC}.relationships+xml"/><Default Extension="model" '
    'ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
)


class Xml:
    """Elements of a model part in one of the many ways to write them."""

    def __init__(self, random: np.random.Generator) -> None:
        self.random = random
        self.prefixes = {
            "": one_of(random, "", "core"),
            "p": one_of(random, "p", "prod"),
            "m": one_of(random, "m", "mat"),
        }
        self.between = one_of(random, "", "\n  ", "<!-- <object> -->", "<?odd?>")
        self.float = one_of(random, repr, "{:+.17e}".format, "{:.17G}".format)

    def name(self, name: str) -> str:
        space, _, local = name.rpartition(":")
        prefix = self.prefixes[space]
        return f"{prefix}:{local}" if prefix else local

    def element(self, tag: str, attributes: dict[str, Any], inside: str = "") -> str:
        """Return an element with attributes in any order. Attributes without a prefix have no namespace."""
        pairs = [
            (self.name(key) if ":" in key and key[:5] != "xmlns" else key, value) for key, value in attributes.items()
        ]
        quotes = "\"'"[int(self.random.integers(2))]
        written = "".join(f" {pairs[k][0]}={quotes}{pairs[k][1]}{quotes}" for k in self.random.permutation(len(pairs)))
        return f"<{self.name(tag)}{written}>{self.between}{inside}</{self.name(tag)}>{self.between}"


class Reference(NamedTuple):
    part: int
    id: str
    matrix: np.ndarray


def reference(xml: Xml, tag: str, one: Reference, part: int, paths: list[str]) -> str:
    attributes = {"objectid": one.id}
    if one.part != part:
        attributes["p:path"] = f"/{paths[one.part]}"
    if not np.array_equal(one.matrix, np.eye(4)):
        attributes["transform"] = " ".join(xml.float(float(number)) for number in one.matrix[:3].T.reshape(-1))
    return xml.element(tag, attributes)


def mesh_3mf(
    xml: Xml, random: np.random.Generator, palettes: np.ndarray | None
) -> tuple[str, dict[str, Any], ExpectedMesh]:
    """Return the mesh, attributes of its object, and what it shows."""
    points = random.integers(-40, 41, (int(random.integers(3, 7)), 3)) / 8
    faces = np.stack([random.permutation(len(points))[:3] for _ in range(int(random.integers(1, 4)))])
    attributes, colors, of_faces = {}, None, [{} for _ in faces]
    if palettes is not None:
        groups = random.integers(2, size=len(faces) + 1)  # the last is the object's
        numbers = random.integers(4, size=(len(faces) + 1, 3))
        numbers[-1] = numbers[-1, 0]
        attributes = {"pid": 10 + groups[-1], "pindex": numbers[-1, 0]}
        for k, (a, b, c) in enumerate(numbers[:-1].tolist()):
            form = one_of(random, "object's", "one", "three")
            if form == "object's":
                groups[k], numbers[k] = groups[-1], numbers[-1]
                continue
            own = {} if groups[k] == groups[-1] and one_of(random, False, True) else {"pid": 10 + groups[k]}
            of_faces[k] = {"p1": a, **own} if form == "one" else {"p1": a, "p2": b, "p3": c, **own}
            numbers[k] = (a,) * 3 if form == "one" else (a, b, c)
        shares = palettes[groups[:-1, None], numbers[:-1]] / 255.0
        colors = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    vertices = "".join(
        xml.element("vertex", {axis: xml.float(x) for axis, x in zip("xyz", point, strict=True)})
        for point in points.tolist()
    )
    triangles = "".join(
        xml.element("triangle", {"v1": a, "v2": b, "v3": c, **more})
        for (a, b, c), more in zip(faces.tolist(), of_faces, strict=True)
    )
    text = xml.element("mesh", {}, xml.element("vertices", {}, vertices) + xml.element("triangles", {}, triangles))
    return text, attributes, ExpectedMesh(points[faces], colors)


@st.composite
def threemf_files(draw: Draw) -> DrawnFile:
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    paths = [one_of(random, "3D/3dmodel.model", "3D/3DModel.Model", "a/b.model")]
    paths += [f"3D/Objects/part_{k}.model" for k in range(draw(st.integers(0, 2)))]
    unit = one_of(random, None, "inch", "meter", "micron")
    texts: dict[str, str] = {}
    known: dict[tuple[int, str], ExpectedMesh | list[Reference]] = {}

    def refer(candidates: list[tuple[int, str]]) -> Reference:
        part, id = candidates[int(random.integers(len(candidates)))]
        matrix = np.eye(4)
        if random.random() < 0.7:
            matrix[:3] = random.integers(-8, 9, (3, 4)) / 4
        return Reference(part, id, matrix if abs(np.linalg.det(matrix)) > 0.1 else np.eye(4))

    items: list[Reference] = []
    for part in reversed(range(len(paths))):  # the root, which may refer to all others, comes last
        xml = Xml(random)
        resources, palettes = "", None
        if one_of(random, False, True):
            palettes = random.integers(0, 256, (2, 4, 3))
            hexes = [["#" + bytes(color).hex() for color in colors] for colors in palettes.astype(np.uint8).tolist()]
            bases = "".join(xml.element("base", {"name": "a", "displaycolor": color}) for color in hexes[0])
            colors = "".join(xml.element("m:color", {"color": color.upper() + "FF"}) for color in hexes[1])
            resources += xml.element("basematerials", {"id": "10"}, bases)
            resources += xml.element("m:colorgroup", {"id": "11"}, colors)
        for k in range(draw(st.integers(1, 3))):
            id = str(k + 2)  # the same ids in all parts
            candidates = [key for key in known if key[0] == part or part == 0]
            if candidates and one_of(random, True, False):
                known[part, id] = inside = [refer(candidates) for _ in range(int(random.integers(1, 3)))]
                written = "".join(reference(xml, "component", one, part, paths) for one in inside)
                resources += xml.element("object", {"id": id}, xml.element("components", {}, written))
            else:
                text, attributes, known[part, id] = mesh_3mf(xml, random, palettes)
                if one_of(random, False, True):
                    attributes |= {"type": "model", "name": "é &amp; 1", "p:UUID": uuid.UUID(bytes=random.bytes(16))}
                resources += xml.element("object", {"id": id, **attributes}, text)
        build = ""
        if part == 0:
            items = [refer(list(known)) for _ in range(draw(st.integers(1, 3)))]
            build = "".join(reference(xml, "item", one, 0, paths) for one in items)
        spaces = {f"xmlns:{xml.prefixes[k]}" if xml.prefixes[k] else "xmlns": uri for k, uri in SPACES.items()}
        more = {} if unit is None else {"unit": unit}
        if one_of(random, True, False):
            more["requiredextensions"] = f"{xml.prefixes['p']} {xml.prefixes['m']}"
        metadata = xml.element("metadata", {"name": "Title"}, "x") if random.random() < 0.5 else ""
        inside = metadata + xml.element("resources", {}, resources) + xml.element("build", {}, build)
        texts[paths[part]] = xml.element("model", spaces | more, inside)

    def show(one: Reference, above: np.ndarray) -> list[ExpectedMesh]:
        world, found = above @ one.matrix, known[one.part, one.id]
        return (
            [placed(found, world)]
            if isinstance(found, ExpectedMesh)
            else [s for inner in found for s in show(inner, world)]
        )

    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", one_of(random, zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED)) as archive:
        archive.writestr("[Content_Types].xml", CONTENT_TYPES)
        folder, _, name = paths[0].rpartition("/")
        for file, targets in (("_rels/.rels", paths[:1]), (f"{folder}/_rels/{name}.rels", paths[1:])):
            relations = "".join(
                f'<Relationship Id="r{k}" Type="{MICROSOFT}/2013/01/3dmodel" Target="/{target}"/>'
                for k, target in enumerate(targets)
            )
            space = "http://schemas.openxmlformats.org/package/2006/relationships"
            archive.writestr(file, f'<Relationships xmlns="{space}">{relations}</Relationships>')
        for path, text in texts.items():
            encoding = one_of(random, "utf-8", "utf-8-sig", "utf-16")
            head = (
                f'<?xml version="1.0" encoding="{encoding.removesuffix("-sig")}"?>\n' if random.random() < 0.7 else ""
            )
            archive.writestr(path, (head + text).encode(encoding))
    return DrawnFile({"a.3mf": stream.getvalue()}, [found for item in items for found in show(item, np.eye(4))])
