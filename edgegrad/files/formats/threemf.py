"""3MF packages: the objects of their model parts wherever the build places them, with their colours."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Iterator
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np

from ...optional import require
from .context import LoadContext
from .part import FormatError
from .text import numbers
from .threemf_unread import CORE, MATERIAL, NEEDED, PATH, note_unread

MOST_INSTANCES = 100_000  # of the objects of a file: nested components multiply
MOST_NESTED = 64
UNITS = {"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "inch": 0.0254, "foot": 0.3048, "meter": 1.0}
# No entity, other file or address is looked at, and trees are of bounded depth.
SAFE = {"resolve_entities": False, "no_network": True, "load_dtd": False, "huge_tree": False}


Palettes = dict[str | None, list[tuple[int, ...]] | None]  # colours of groups by id; None: of a group that is not read


class ObjectReference(NamedTuple):
    """An object where an item of the build, or a component, places it."""

    part: str  # of the package, by its name there
    id: str
    matrix: np.ndarray  # (4, 4)


class MeshObject(NamedTuple):
    """An object of triangles or of components."""

    name: str
    arrays: dict[str, np.ndarray]  # `vertices`, `faces`, and `face_colors` or `vertex_colors` of 8-bit sRGB
    components: list[ObjectReference]


class ModelPart(NamedTuple):
    unit: float  # m
    objects: dict[str, MeshObject]
    items: list[ObjectReference]


def instances(data: bytes, context: LoadContext) -> list[tuple[str, dict[str, Any], np.ndarray]]:
    """Return (name, arrays, matrix to the space of the build) of each mesh wherever it is placed, in the order of the build.
    Raises FormatError, also for an archive that would fill the memory and for XML that names other files."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        size = sum(member.file_size for member in archive.infolist())  # no reader goes beyond
        if size > max(100 * len(data), 64_000_000):
            raise FormatError(
                f"expected an archive that grows up to 100 times, got {size} bytes in {len(data)}; export it again"
            )
        package = _Package(archive, context)
        root = package.root()
        if package.part(root).objects and not package.part(root).items:
            raise FormatError("expected items in the build, which say what is shown, got none; export it again")
        count = sum(package.count(item, ()) for item in package.part(root).items)
        if count > MOST_INSTANCES:
            raise FormatError(f"expected at most {MOST_INSTANCES} instances of objects, got {count}; export it flat")
        found: list[tuple[str, dict[str, Any], np.ndarray]] = []
        for item in package.part(root).items:
            package.place(item, root, np.eye(4), found)
    return found


class _Package:
    def __init__(self, archive: zipfile.ZipFile, context: LoadContext) -> None:
        self.archive, self.context = archive, context
        self.names = {name.lower().replace("\\", "/").lstrip("/"): name for name in archive.namelist()}
        self.parts: dict[str, ModelPart] = {}
        self.counts: dict[tuple[str, str], int] = {}

    def root(self) -> str:
        """Return the name of the part that says what is built."""
        if "_rels/.rels" in self.names:
            for relation in self._parsed("_rels/.rels").iter("{*}Relationship"):
                if (
                    relation.get("Type", "").endswith("/3dmodel")
                    and (name := _name(relation.get("Target"))) in self.names
                ):
                    return name
        found = next((name for name in self.names if "3d/3dmodel.model" in name), None)
        if found is None:
            raise FormatError("expected a 3MF file, got an archive without 3D/3dmodel.model; export it again")
        return found

    def part(self, name: str) -> ModelPart:
        if name not in self.parts:
            if name not in self.names:
                raise FormatError(f"expected the model part {name!r}, got none; export it again")
            root = self._parsed(name)
            needed = [root.nsmap.get(p, p) for p in root.get("requiredextensions", "").split()]
            if unknown := [uri for uri in needed if uri not in NEEDED]:
                raise FormatError(f"expected plain 3MF, got one that needs {', '.join(unknown)}; export it without")
            note_unread(root, self.context)
            self.parts[name] = _read_part(name, root, self.context)
        return self.parts[name]

    def object(self, reference: ObjectReference) -> MeshObject:
        found = self.part(reference.part).objects.get(reference.id)
        if found is None:
            raise FormatError(
                f"expected an object with the id {reference.id} in {reference.part!r}, got none; export it again"
            )
        return found

    def count(self, reference: ObjectReference, above: tuple[tuple[str, str], ...]) -> int:
        """Return how many meshes a reference places."""
        key = reference.part, reference.id
        if key in above:
            raise FormatError(
                f"expected components inside one another, got object {key[1]} inside itself; export it again"
            )
        if len(above) > MOST_NESTED:
            raise FormatError(f"expected components nested up to {MOST_NESTED} times, got more; export it flat")
        if key not in self.counts:
            inside = self.object(reference).components
            self.counts[key] = sum(self.count(one, (*above, key)) for one in inside) if inside else 1
        return self.counts[key]

    def place(self, reference: ObjectReference, part: str, above: np.ndarray, found: list[Any]) -> None:
        """Add what a reference of a part places; `above` is the part's matrix."""
        world = above @ reference.matrix
        if reference.part != part:
            world = world @ np.diag([*[self.part(reference.part).unit / self.part(part).unit] * 3, 1.0])
        shown = self.object(reference)
        if len(shown.arrays["faces"]):
            found.append((shown.name, shown.arrays, world))
        for component in shown.components:
            self.place(component, reference.part, world, found)

    def _parsed(self, name: str) -> Any:
        etree = require("lxml.etree", "edgegrad[files]", "reading 3MF")
        content = self.archive.read(self.names[name])
        if b"<!DOCTYPE" in content.replace(b"\0", b""):  # without the zeros of UTF-16
            raise FormatError(
                f"expected XML without a DOCTYPE, which may name other files, got one in {name!r}; remove it"
            )
        return etree.fromstring(content, etree.XMLParser(**SAFE))


def _name(path: str) -> str:
    """Return a part's name from its path in the package, in lower case because case does not matter."""
    return unquote(path).lower().lstrip("/")


def _read_part(name: str, root: Any, context: LoadContext) -> ModelPart:
    if root.tag != f"{{{CORE}}}model":
        raise FormatError(f"expected a model of 3MF in {name!r}, got {root.tag!r}; export it again")
    unit = root.get("unit", "millimeter")
    if unit not in UNITS:
        raise FormatError(f"expected a unit of 3MF ({', '.join(UNITS)}), got {unit!r}; export it again")
    groups = root.iter(f"{{{CORE}}}basematerials", f"{{{MATERIAL}}}colorgroup") if context.options.materials else ()
    palettes: Palettes = {given.get("id"): None for given in root.iterfind(f"{{{CORE}}}resources/*[@id]")}
    palettes |= {group.get("id"): [_color(child) for child in group.iterchildren("{*}*")] for group in groups}
    objects: dict[str, MeshObject] = {}
    for given in _core(root, "object"):
        if "id" not in given.attrib:
            raise FormatError(f"expected the attribute id of each object in {name!r}, got one without; export it again")
        if objects.setdefault(given.attrib["id"], found := _object(given, name, palettes, context)) is not found:
            raise FormatError(
                f"expected an id for each object, got {given.get('id')!r} for two in {name!r}; export it again"
            )
    return ModelPart(UNITS[unit], objects, [_reference(item, name) for item in _core(root, "item")])


def _core(within: Any, name: str) -> Iterator[Any]:
    """Yield elements of the format itself; extensions may use the same names."""
    return within.iter(f"{{{CORE}}}{name}")


def _reference(given: Any, part: str) -> ObjectReference:
    values = numbers(given.get("transform", "1 0 0 0 1 0 0 0 1 0 0 0").encode(), "a transform")
    if len(values) != 12:
        raise FormatError(f"expected 12 numbers for a transform, got {len(values)}; export it again")
    matrix = np.eye(4)
    matrix[:3] = values.reshape(4, 3).T
    if "objectid" not in given.attrib:
        raise FormatError(
            "expected the attribute objectid of each item and component, got one without; export it again"
        )
    return ObjectReference(_name(given.get(PATH, part)), given.attrib["objectid"], matrix)


def _object(given: Any, part: str, palettes: Palettes, context: LoadContext) -> MeshObject:
    vertices, faces = _rows(given, "vertex", "x", "y", "z"), _rows(given, "triangle", "v1", "v2", "v3")
    return MeshObject(
        given.get("name") or f"object {given.get('id')}",
        _arrays(vertices, faces, _colors(given, palettes, context)),
        [_reference(component, part) for component in _core(given, "component")],
    )


def _rows(given: Any, element: str, *names: str) -> np.ndarray:
    """Return attributes (N, 3) of the elements of an object. Raises FormatError. They are parsed as one text, because a call
    for each number takes three times as long."""
    a, b, c = names
    where = f"each {element} of object {given.get('id')}"
    kind = np.float64 if element == "vertex" else np.int64
    try:
        rows = [f"{one.attrib[a]} {one.attrib[b]} {one.attrib[c]}" for one in _core(given, element)]
    except KeyError as error:
        raise FormatError(
            f"expected the attributes {a}, {b} and {c} of {where}, got one without {error}; export it again"
        ) from None
    flat = numbers(" ".join(rows).encode(), f"{a}, {b} and {c} of {where}", kind)
    if len(flat) != 3 * len(rows):
        raise FormatError(f"expected one number for each of {a}, {b} and {c} of {where}, got others; export it again")
    return flat.reshape(-1, 3)


def _colors(given: Any, palettes: Palettes, context: LoadContext) -> np.ndarray | None:
    """Return colours of the corners of triangles, by their own properties or the object's; None where none has one that is
    read."""
    own = given.get("pid"), given.get("pindex"), None, None
    of_faces = given.xpath("boolean(.//c:triangle[@pid or @p1])", namespaces={"c": CORE})
    if not context.options.materials or (own[0] is None and not of_faces):
        return None
    if own[0] is not None and own[1] is None:
        context.unread.note("pid of an object without pindex")
    white, found, plain = (255,) * 4, [], 0
    for triangle in _core(given, "triangle"):
        pid, first, second, third = own
        if triangle.get("p1") is not None:
            pid, first = triangle.get("pid", pid), triangle.get("p1")
            second, third = triangle.get("p2"), triangle.get("p3")
        elif triangle.get("pid") is not None:
            context.unread.note("pid of a triangle without p1")
        if first is not None and pid is None:
            context.unread.note("p1 of a triangle without pid")
        elif first is not None and pid not in palettes:
            context.unread.note(f"pid {pid}", "no such group")
        palette = palettes.get(pid)
        if palette is None or first is None:
            plain += 1
            found.append((white,) * 3)
            continue
        indices = [first if index is None else index for index in (first, second, third)]
        if not all(index.strip().isdecimal() for index in indices):
            raise FormatError(
                f"expected whole numbers for colours of group {pid}, got {', '.join(indices)}; export it again"
            )
        indices = [int(index) for index in indices]
        if not all(0 <= index < len(palette) for index in indices):
            raise FormatError(
                f"expected colours from 0 to {len(palette) - 1} of group {pid}, got {indices}; export it again"
            )
        found.append(tuple(palette[index] for index in indices))
    if plain == len(found):
        return None
    if plain:
        context.unread.note("triangles without a colour beside others with one", "white")
    colors = np.array(found, np.uint8)
    if (colors[..., 3] < 255).any():
        context.unread.note("alpha of colours")
    return colors


def _color(given: Any) -> tuple[int, ...]:
    """Return 8-bit sRGB and alpha from #RRGGBB or #RRGGBBAA."""
    text = given.get("color") or given.get("displaycolor", "")
    if not re.fullmatch("#([0-9a-fA-F]{2}){3,4}", text):
        raise FormatError(f"expected a colour as #RRGGBB or #RRGGBBAA, got {text!r}; export it again")
    return tuple(bytes.fromhex(f"{text[1:]}FF"[:8]))


def _arrays(vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray | None) -> dict[str, np.ndarray]:
    """Return arrays with colours (F, 3, 4) of corners; vertices are split where those of a face differ."""
    if colors is None:
        return {"vertices": vertices, "faces": faces}
    if bool((colors == colors[:, :1]).all()):
        return {"vertices": vertices, "faces": faces, "face_colors": colors[:, 0]}
    if faces.min() < 0 or faces.max() >= len(vertices):
        bad = faces.min() if faces.min() < 0 else faces.max()
        raise FormatError(f"expected vertex indices from 0 to {len(vertices) - 1}, got {bad}; repair the mesh")
    apart = np.arange(faces.size).reshape(-1, 3)
    return {"vertices": vertices[faces.reshape(-1)], "faces": apart, "vertex_colors": colors.reshape(-1, 4)}
