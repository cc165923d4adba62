"""Mesh files as plain arrays, through trimesh, and the faults that trimesh passes over without a word."""

from __future__ import annotations

import io
import json
import logging
import re
import warnings
import zipfile
from pathlib import Path, PureWindowsPath
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
import torch
from torch import Tensor

from ._files import PathLike, check_readable, require
from .image import srgb_to_linear

MOST_ZEROS = 1 << 24  # rows that a glTF may ask for without holding them
MOST_INSTANCES = 100_000  # of the parts of a 3MF: nested components multiply
# What Pillow is let loose on. Not EPS, above all, for which it runs another program.
TEXTURES = ("PNG", "JPEG", "MPO", "JPEG2000", "WEBP", "BMP", "TIFF", "TGA", "GIF", "PPM", "DDS")
# What a glTF calls its samplers' settings.
WRAPS = {33071: "clamp", 33648: "mirror", 10497: "repeat"}
FILTERS = {9728: "nearest", 9729: "linear"}
MESHES = (".obj", ".gltf", ".glb", ".ply", ".stl", ".off", ".3mf")


# What trimesh logs, tracebacks among it, becomes an error here; whoever sets up logging still gets it.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


class Fault(Exception):
    """What is wrong with a file, said without its name."""


RAMP = torch.tensor([[0.0, 1.0]])  # alpha that is looked up where it is known


class Part(NamedTuple):
    """A part of a file as it stands there, before equal vertices are welded; colours are linear."""

    name: str
    verts: np.ndarray  # (N, 3) float32, transformations applied
    faces: np.ndarray  # (F, 3) int64
    uvs: np.ndarray | None = None  # (N, 2) float32, v running up
    texture: Tensor | None = None  # (h, w, 3) float32
    colors: Tensor | None = None  # (N, 3) float32
    face_colors: Tensor | None = None  # (F, 3) float32
    alpha: Tensor | None = None  # (h, w) float32, of what is cut out
    cutoff: float = 0.5
    wrap: tuple[str, str] = ("repeat", "repeat")  # of u and v
    filter: str = "linear"


class _Folder:
    """The folder of a mesh file, from which trimesh gets the files that the mesh names, and from nowhere else.

    Where one fails, trimesh goes on without the material or texture; `failures` remembers why.
    """

    def __init__(self, path: PathLike) -> None:
        self.path = path
        self.root = Path(path).absolute().parent.resolve()
        self.contents: dict[str, bytes] = {}
        self.failures: dict[str, Exception] = {}

    def get(self, name: str) -> bytes:
        try:
            self.contents[name] = self._read(name)
        except Exception as error:
            self.failures[name] = error
            raise
        return self.contents[name]

    __getitem__ = get

    def _read(self, name: str) -> bytes:
        for text in (name.strip(), unquote(name.strip())):  # glTF writes names as URIs
            file = (self.root / text.replace("\\", "/")).resolve()
            if PureWindowsPath(text).drive or Path(text).is_absolute() or not file.is_relative_to(self.root):
                raise Fault(f"names {name!r}, outside its folder, which is not read; copy it beside the mesh")
            if file.is_file():
                return file.read_bytes()
        raise FileNotFoundError(
            f"{self.path}: names {name!r}, and there is no such file in {self.root}; put it there, "
            "or pass materials=False where only its look is missing"
        )


class _Textures:
    """Textures as tensors; parts that share an image share its tensor."""

    def __init__(self) -> None:
        self.known: dict[object, Tensor] = {}

    def get(self, name: str, image: Any, factor: tuple[float, ...] = (1.0, 1.0, 1.0)) -> Tensor:
        """(h, w, 3) linear radiance from a Pillow image, row 0 on top, times a linear factor."""
        if image.format not in TEXTURES:
            raise Fault(
                f"expected a {', '.join(TEXTURES)} image in the texture {name!r}, got {image.format}; convert it"
            )
        key = (id(image), factor)
        if key not in self.known:
            try:
                # convert() would clip 16-bit grey
                deep = image.mode.startswith("I")
                texels = np.asarray(image if deep else image.convert("RGB")) / (65535.0 if deep else 255.0)
            except (OSError, SyntaxError, ValueError) as error:
                raise Fault(f"expected a whole image in the texture {name!r}, got a damaged one ({error})") from error
            linear = srgb_to_linear(torch.from_numpy(texels)).float()
            self.known[key] = (linear[..., None] if linear.dim() == 2 else linear) * linear.new_tensor(factor)
        return self.known[key]

    def alpha(self, image: Any, factor: float) -> Tensor | None:
        """(h, w) float32, of an image that get() took, times a factor; None where it has none."""
        if "A" not in image.getbands() and "transparency" not in image.info:
            return None
        key = (id(image), factor, "alpha")
        if key not in self.known:
            texels = np.asarray(image.convert("RGBA"))[..., 3] / 255.0
            self.known[key] = factor * torch.from_numpy(texels).float()
        return self.known[key]


def read_parts(path: PathLike, materials: bool = True, split: bool = False, unwrap: bool = False) -> list[Part]:
    """The parts of a mesh file, at least one, each with at least one triangle.

    materials  read textures and material colours
    split      keep the objects of an OBJ file apart
    unwrap     give texture coordinates also where the file has no texture

    Raises Fault, FileNotFoundError, ValueError (see check_readable) or ImportError.
    """
    file = check_readable(path, MESHES)
    data, kind, folder, textures = file.read_bytes(), file.suffix.lower()[1:], _Folder(path), _Textures()
    # The loaders themselves rather than trimesh.load: they hand over the numbers of the file before trimesh rounds
    # colours to 8 bit, and nothing but these formats, no address and no other folder is ever tried.
    loader = require("trimesh.exchange.load", "trimesh", "reading meshes").mesh_loaders[kind]
    options: dict[str, object] = {}
    try:
        if kind == "obj":
            data = _tidy_obj(data)
            options["split_objects"] = split
        elif kind == "ply":
            # Without a texture, vertices must not be split at its seams: their colours would not follow.
            header = data.split(b"end_header")[0].lower()
            options["fix_texture"] = unwrap or (materials and b"texturefile" in header)
        instances = _instances(data) if kind == "3mf" else None
        tree = _gltf_tree(data, kind) if kind in ("gltf", "glb") else None
        if tree is not None:
            data = _without_gloss(data, kind, tree)
        with warnings.catch_warnings():
            # Where a text stops being numbers, NumPy drops the rest and only warns.
            warnings.filterwarnings("error", message="string or file could not be read", category=DeprecationWarning)
            loaded = loader(file_obj=io.BytesIO(data), resolver=folder, **options)
        if materials and tree is None:
            _check_folder(folder)
            if kind == "ply" and folder.contents and "visual" not in loaded:
                raise Fault(f"expected texture coordinates for its texture {next(iter(folder.contents))!r}, got none")
        if kind == "obj" and "geometry" in loaded:
            loaded["geometry"] = dict(reversed(loaded["geometry"].items()))  # trimesh turns their order round
        if instances is not None and instances != len(loaded["graph"]):
            raise Fault(
                f"expected {instances} instances of objects, and {len(loaded['graph'])} could be read: components are nested "
                "too often, or refer to objects that are not there; export it flat"
            )
        primitives = None if tree is None else _gltf_primitives(tree, loaded["geometry"])
        placed = [place for place in _place(loaded) if len(place[1].get("faces", ()))]  # the others: points and lines
        parts = []
        for name, raw, matrix in placed:
            try:
                part, origin = _shape(name, raw, matrix)
                if primitives is None or tree is None:
                    look = _look(raw, origin, materials, folder, textures)
                else:
                    look = _gltf_look(tree, primitives[name], raw, materials, folder, textures)
                parts.append(_checked(part._replace(**look)))
            except Fault as fault:
                raise Fault(f"part {name!r}: {fault}" if len(placed) > 1 else str(fault)) from fault.__cause__
    except (Fault, FileNotFoundError, ImportError):
        raise
    except Exception as error:
        raise Fault(
            f"expected a whole {kind.upper()} file, got one that cannot be read ({type(error).__name__}: {error}); "
            "it may be truncated or of another kind: export it again"
        ) from error
    if not parts:
        raise Fault("expected triangles, got none: the file is truncated, or was exported without faces")
    announced, found = _announced_faces(data, kind), sum(len(part.faces) for part in parts)
    if found < announced:
        raise Fault(f"expected the {announced} faces that the file announces, got {found}; it is truncated or damaged")
    return parts


def _place(loaded: dict[str, Any]) -> list[tuple[str, dict[str, Any], np.ndarray]]:
    """(name, arrays, matrix to world) of each part in the order of the file; one part may stand in several places."""
    if "geometry" not in loaded:
        return [("", loaded, np.eye(4))]
    geometry, edges = loaded["geometry"], loaded.get("graph")
    if edges is None:
        return [(name, raw, np.eye(4)) for name, raw in geometry.items()]
    # Node by node, from matrices that are known: trimesh looks for the way to each node anew, which takes minutes where
    # thousands are nested.
    to_matrix = require("trimesh.scene.transforms", "trimesh", "reading meshes").kwargs_to_matrix
    parent = {edge["frame_to"]: edge for edge in edges}
    if len(parent) < len(edges):
        raise Fault("expected a tree of nodes, got some inside two others; export it again")
    base = loaded.get("base_frame", "world")
    world = {base: np.eye(4)}

    def matrix(node: str) -> np.ndarray:
        way = []
        while node not in world:
            if len(way) > len(parent) or node not in parent:
                raise Fault("expected a tree of nodes, got some that no root leads to; export it again")
            way.append(parent[node])
            node = parent[node].get("frame_from", base)
        for edge in reversed(way):
            world[edge["frame_to"]] = world[edge.get("frame_from", base)] @ to_matrix(**edge)
        return world[way[0]["frame_to"]] if way else world[node]

    order = {name: i for i, name in enumerate(geometry)}
    nodes = [(edge["geometry"], edge["frame_to"]) for edge in edges if edge.get("geometry") in order]
    return [(name, geometry[name], matrix(node)) for name, node in sorted(nodes, key=lambda n: order[n[0]])]


def _shape(name: str, raw: dict[str, Any], matrix: np.ndarray) -> tuple[Part, np.ndarray]:
    """Vertices in their place, and triangles; and for each triangle the number of the face it came from."""
    v, faces = np.asarray(raw["vertices"], np.float64), np.asarray(raw["faces"])
    if v.ndim != 2 or v.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] < 3:
        got = f"{v.shape} and {faces.shape}"
        raise Fault(f"expected positions (N, 3) and faces with three corners, got {got}; it may be truncated")
    with np.errstate(over="ignore", invalid="ignore"):
        # Elementwise: a matrix product may round equal rows differently, and they would not be welded.
        v = v[:, 0:1] * matrix[:3, 0] + v[:, 1:2] * matrix[:3, 1] + v[:, 2:3] * matrix[:3, 2] + matrix[:3, 3]
        verts = np.ascontiguousarray(v, np.float32)
    corners = faces.shape[1]
    fans = np.stack([faces[:, [0] * (corners - 2)], faces[:, 1:-1], faces[:, 2:]], -1).reshape(-1, 3).astype(np.int64)
    if np.linalg.det(matrix[:3, :3]) < 0.0:
        fans = fans[:, ::-1]  # in a mirror the front of a face stays its front
    return Part(name, verts, np.ascontiguousarray(fans)), np.arange(len(faces)).repeat(corners - 2)


def _checked(part: Part) -> Part:
    """The part itself, when positions are finite, indices in range and colours as many as they should be."""
    N, F = len(part.verts), len(part.faces)
    if not np.isfinite(part.verts).all():
        bad = int(np.argwhere(~np.isfinite(part.verts))[0, 0])
        raise Fault(f"expected finite positions (float32), got {part.verts[bad].tolist()} at vertex {bad}; repair it")
    low, high = int(part.faces.min()), int(part.faces.max())
    if low < 0 or high >= N:
        raise Fault(f"expected vertex indices from 0 to {N - 1}, got {low if low < 0 else high}; repair the mesh")
    for what, colors, count in (("vertices", part.colors, N), ("triangles", part.face_colors, F)):
        if colors is not None and len(colors) != count:
            raise Fault(f"expected {count} colours for {count} {what}, got {len(colors)}; export triangles only")
    return part


def _look(
    raw: dict[str, Any], origin: np.ndarray, materials: bool, folder: _Folder, textures: _Textures
) -> dict[str, object]:
    """The fields of a part that say what it looks like, in all formats but glTF."""
    visual = raw.get("visual")
    look: dict[str, object] = {"uvs": _uvs(visual)}
    image = getattr(getattr(visual, "material", None), "image", None)
    diffuse = getattr(getattr(visual, "material", None), "kwargs", {}).get("kd")
    if materials and image is not None and image.format:  # the grey image that trimesh makes up comes from no format
        look["texture"] = textures.get(image.info.get("file_path") or next(iter(folder.contents)), image)
    elif raw.get("vertex_colors") is not None:
        look["colors"] = _colors("vertex", raw["vertex_colors"], srgb=True)
    elif raw.get("face_colors") is not None:
        colors = _colors("face", raw["face_colors"], srgb=True)
        # Polygons of mixed sizes come split already, and no longer say which face a triangle is from.
        look["face_colors"] = colors[torch.from_numpy(origin)] if len(colors) == origin[-1] + 1 else colors
    elif materials and diffuse is not None:
        look["face_colors"] = torch.tensor(np.broadcast_to(diffuse, 3), dtype=torch.float32).repeat(len(origin), 1)
    return look


def _uvs(visual: object) -> np.ndarray | None:
    uvs = getattr(visual, "uv", None)
    return None if uvs is None or len(uvs) == 0 else np.asarray(uvs, np.float32)


def _colors(what: str, values: np.ndarray, srgb: bool) -> Tensor:
    """Linear float32 colours (N, 3) from integers of any width, or from floats; sRGB floats reach up to 1 or 255."""
    values = np.asarray(values)
    colors = values[:, :3].astype(np.float64)
    if values.dtype.kind in "iu":
        colors /= np.iinfo(values.dtype).max
    elif srgb and colors.size and colors.max() > 1.0:
        colors /= 255.0
    good = (colors >= 0.0) & (colors <= (1.0 if srgb else np.finfo(np.float32).max))
    if not good.all():
        bad = int(np.argwhere(~good)[0, 0])
        raise Fault(f"expected {what} colours from 0 to 1, got {values[bad].tolist()} at {what} {bad}; repair it")
    linear = torch.from_numpy(colors)
    return (srgb_to_linear(linear) if srgb else linear).float()


def _check_folder(folder: _Folder) -> None:
    """Every file that an OBJ or PLY names was found, and every one that is not a material library is an image."""
    for failure in folder.failures.values():
        raise failure
    for name, content in folder.contents.items():
        if not name.strip().lower().endswith(".mtl"):
            pillow = require("PIL.Image", "pillow", "reading textures")
            try:
                pillow.open(io.BytesIO(content))
            except (OSError, pillow.DecompressionBombError) as error:
                raise _no_image(name) from error


def _no_image(name: str) -> Fault:
    return Fault(f"expected an image in the texture {name!r}, got none that Pillow reads; save it as PNG or JPEG")


def _announced_faces(data: bytes, kind: str) -> int:
    """How many faces a text says that it holds: where it ends early, trimesh gives fewer and says nothing."""
    if kind == "obj":
        return len(re.findall(rb"(?m)^f ", data))
    if kind == "stl" and data[:5].lower() == b"solid":
        return len(re.findall(rb"(?im)^[ \t]*facet[ \t]", data))
    found = None
    if kind == "ply":
        found = re.search(rb"element\s+face\s+(\d+)", data.split(b"end_header")[0])
    elif kind == "off":
        found = re.search(rb"OFF\s+\d+\s+(\d+)", re.sub(rb"#.*", b"", data))
    return int(found[1]) if found else 0


def _tidy_obj(data: bytes) -> bytes:
    """OBJ text as trimesh expects it: one space after a keyword, none before it, no comments (it looks into them)."""
    text = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    text = re.sub(rb"(?m)^([ \t]*|[vf][^#\n]*)#.*$", rb"\1", text)
    text = re.sub(rb"(?m)^[ \t]*(v|vt|vn|f|o|g|s|usemtl|mtllib)[ \t]+", rb"\1 ", text)
    if len(set(re.findall(rb"(?m)^mtllib (.*?)[ \t]*$", text))) > 1:
        raise Fault("expected one mtllib, got several, and only one would be read; join the .mtl files")
    if re.search(rb"(?m)^f .*?(?<=[ /])0+(?=[ /]|$)", text):
        raise Fault("expected indices that count from 1, got 0 in a face; repair the mesh")
    if re.search(rb"(?m)^f .*-", text) and text.rfind(b"\nv ") > text.find(b"\nf "):
        raise Fault("expected all vertices before faces with negative indices, got some after; export it otherwise")
    return text


def _gltf_tree(data: bytes, kind: str) -> dict[str, Any]:
    """The JSON of a glTF or GLB file. Raises Fault where it needs what trimesh lacks."""
    if kind == "glb":
        if data[:4] != b"glTF" or data[16:20] != b"JSON":
            raise Fault("expected a GLB file, got something else; export it again")
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    tree = json.loads(data)
    if not isinstance(tree, dict):
        raise Fault(f"expected a JSON object, got {type(tree).__name__}; export it again")
    harmless = re.compile(r"KHR_materials_(?!pbrSpecularGlossiness)|KHR_lights|EXT_texture_webp")
    needed = [name for name in tree.get("extensionsRequired", []) if not harmless.match(name)]
    if needed:
        raise Fault(f"expected plain glTF 2.0, got one that needs {', '.join(needed)}; export it without compression")
    return tree


def _without_gloss(data: bytes, kind: str, tree: dict[str, Any]) -> bytes:
    """The file as trimesh may see it: its materials without an extension for which it would decode images at once, before
    their format was looked at. Raises Fault when the file asks for large arrays that it does not hold."""
    zeros = sum(accessor["count"] for accessor in tree.get("accessors", []) if "bufferView" not in accessor)
    if zeros > MOST_ZEROS:
        raise Fault(f"expected accessors with data, got some without that would fill {zeros} rows; export it plain")
    gloss = "KHR_materials_pbrSpecularGlossiness"
    if not any(gloss in material.get("extensions", {}) for material in tree.get("materials", [])):
        return data
    plain = [
        {**m, "extensions": {k: v for k, v in m.get("extensions", {}).items() if k != gloss}} for m in tree["materials"]
    ]
    text = json.dumps({**tree, "materials": plain}).encode()
    if kind == "gltf":
        return text
    text += b" " * (-len(text) % 4)
    rest = data[20 + int.from_bytes(data[12:16], "little") :]
    sizes = [(20 + len(text) + len(rest)).to_bytes(4, "little"), len(text).to_bytes(4, "little")]
    return data[:8] + sizes[0] + sizes[1] + b"JSON" + text + rest


def _instances(data: bytes) -> int:
    """How many parts a 3MF places. trimesh gives up without a word where many components are nested, and leaves out those that
    are not defined. Raises Fault, also for an archive that would fill the memory and for XML that names other files."""
    etree = require("lxml.etree", "lxml", "reading 3MF")
    safe = require("trimesh.exchange.common", "trimesh", "reading meshes").XML_PARSER_OPTIONS
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        size = sum(member.file_size for member in archive.infolist())  # no reader goes beyond
        if size > max(100 * len(data), 64_000_000):
            raise Fault(
                f"expected an archive that grows up to 100 times, got {size} bytes in {len(data)}; export it again"
            )
        for member in archive.namelist():
            if b"<!DOCTYPE" in archive.read(member).replace(b"\0", b""):  # without the zeros of UTF-16
                raise Fault(
                    f"expected XML without a DOCTYPE, which may name other files, got one in {member!r}; remove it"
                )
        name = next((name for name in archive.namelist() if "3d/3dmodel.model" in name.lower()), None)
        if name is None:
            raise Fault("expected a 3MF file, got an archive without 3D/3dmodel.model; export it again")
        model = io.BytesIO(archive.read(name))
    components: dict[str, list[str]] = {}
    items: list[str] = []
    for _, element in etree.iterparse(model, tag=("{*}object", "{*}build"), **safe):
        if element.tag.endswith("object"):
            components[element.get("id")] = [child.get("objectid") for child in element.iter("{*}component")]
        else:
            items += [child.get("objectid") for child in element.iter("{*}item")]
        element.clear()
    counts: dict[str, int] = {}

    def leaves(index: str, above: tuple[str, ...]) -> int:
        if index in above:
            raise Fault(f"expected components inside one another, got object {index} inside itself; export it again")
        if index not in counts:
            inside = components.get(index, [])
            counts[index] = sum(leaves(child, (*above, index)) for child in inside) if inside else 1
        return counts[index]

    count = sum(leaves(index, ()) for index in items)
    if count > MOST_INSTANCES:
        raise Fault(f"expected at most {MOST_INSTANCES} instances of objects, got {count}; export it flat")
    return count


def _gltf_primitives(tree: dict[str, Any], geometry: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The primitive of the file that each loaded part was made from. Raises Fault where trimesh misreads one."""
    primitives = [primitive for mesh in tree.get("meshes", []) for primitive in mesh["primitives"]]
    for primitive in primitives:
        if primitive.get("mode", 4) == 6:
            raise Fault("expected triangles or strips, got a triangle fan; export triangles")
        used = {**primitive["attributes"], "indices": primitive.get("indices")}
        for key in ("POSITION", "TEXCOORD_0", "COLOR_0", "indices"):
            accessor = {} if used.get(key) is None else tree["accessors"][used[key]]
            quantized = key in ("POSITION", "TEXCOORD_0") and accessor.get("componentType", 5126) != 5126
            if quantized or "sparse" in accessor:
                raise Fault(f"expected {key} in full, got it {'quantized' if quantized else 'sparse'}; export it plain")
    loaded = [primitive for primitive in primitives if primitive.get("mode", 4) in (0, 1, 4, 5)]  # others are left out
    return dict(zip(geometry, loaded, strict=True))


def _gltf_look(
    tree: dict[str, Any],
    primitive: dict[str, Any],
    raw: dict[str, Any],
    materials: bool,
    folder: _Folder,
    textures: _Textures,
) -> dict[str, object]:
    """The fields of a part that say what it looks like; texture, factor and vertex colours are multiplied."""
    visual = raw.get("visual")
    look: dict[str, object] = {"uvs": _uvs(visual)}
    colors = values = None
    if "COLOR_0" in primitive["attributes"]:
        values = raw["vertex_colors"] if visual is None else visual.vertex_attributes["color"]
        colors = look["colors"] = _colors("vertex", values, srgb=False)
    if not materials or "material" not in primitive:
        return look
    material = tree["materials"][primitive["material"]]
    base = material.get("pbrMetallicRoughness", {})
    masked = material.get("alphaMode") == "MASK"
    opacity = float((*base.get("baseColorFactor", ()), 1.0, 1.0, 1.0, 1.0)[3])
    cutoff = look["cutoff"] = float(material.get("alphaCutoff", 0.5))
    of_vertices = _vertex_alpha(values) if masked and colors is not None else None
    if of_vertices is not None and float(of_vertices.min()) == float(of_vertices.max()):
        opacity, of_vertices = opacity * float(of_vertices[0]), None
    if masked and opacity < cutoff:  # all of it is cut out, whatever a texture says
        look["alpha"] = torch.full((1, 1), opacity)
        look["uvs"] = np.zeros((len(raw["vertices"]), 2), np.float32) if look["uvs"] is None else look["uvs"]
    if "KHR_materials_pbrSpecularGlossiness" in material.get("extensions", {}):
        raise Fault("expected a metallic-roughness material, got specular-glossiness; convert it")
    factor = tuple(float(f) for f in base.get("baseColorFactor", (1.0, 1.0, 1.0))[:3])  # trimesh has it in 8 bit only
    reference = base.get("baseColorTexture")
    if reference is None:
        if colors is None:
            look["face_colors"] = torch.tensor(factor, dtype=torch.float32).repeat(len(raw["faces"]), 1)
        else:
            look["colors"] = colors * colors.new_tensor(factor)
        if of_vertices is not None and "alpha" not in look:
            # Linear over a face, as the texture coordinates by which a ramp of two texels is looked up.
            u = 0.25 + 0.5 * opacity * of_vertices
            look |= {
                "alpha": RAMP,
                "uvs": torch.stack([u, torch.full_like(u, 0.5)], 1).numpy(),
                "wrap": ("clamp", "clamp"),
            }
        return look
    source = tree["images"][tree["textures"][reference["index"]].get("source", 0)]
    name = str(source.get("name") or source.get("uri") or material.get("name") or "in the file")[:60]
    image = visual.material.baseColorTexture  # type: ignore[union-attr]
    if image is None:
        raise folder.failures.get(source.get("uri", ""), _no_image(name))
    if reference.get("texCoord", 0) != 0 or "KHR_texture_transform" in reference.get("extensions", {}):
        raise Fault(f"expected plain TEXCOORD_0 for the texture {name!r}, got others; bake them into one set")
    if colors is not None and not bool((colors == 1.0).all()):
        raise Fault(f"expected the texture {name!r} or vertex colours, got both; bake one into the other")
    if of_vertices is not None and "alpha" not in look:
        raise Fault(
            f"expected the texture {name!r} or the alpha of COLOR_0 to cut out, got both; bake the alpha into the texture"
        )
    look.pop("colors", None)
    look["texture"] = textures.get(name, image, factor)
    if masked and "alpha" not in look:
        look["alpha"] = textures.alpha(image, opacity)
    return {**look, **_gltf_sampler(tree, tree["textures"][reference["index"]], name)}


def _vertex_alpha(values: Any) -> Tensor | None:
    """(N,) float32 the fourth number of colours, if there is one."""
    values = np.asarray(values)
    if values.shape[1] < 4:
        return None
    whole = np.iinfo(values.dtype).max if values.dtype.kind in "iu" else 1.0
    alpha = values[:, 3].astype(np.float64) / whole
    if not ((alpha >= 0.0) & (alpha <= 1.0)).all():
        bad = int(np.argwhere(~((alpha >= 0.0) & (alpha <= 1.0)))[0, 0])
        raise Fault(f"expected alpha of COLOR_0 from 0 to 1, got {alpha[bad]} at vertex {bad}; repair it")
    return torch.from_numpy(alpha).float()


def _gltf_sampler(tree: dict[str, Any], texture: dict[str, Any], name: str) -> dict[str, object]:
    """How a texture is looked up. The filter for magnification is taken: pixels are means of points as it is."""
    sampler = tree["samplers"][texture["sampler"]] if "sampler" in texture else {}
    wraps, nearest = [sampler.get(key, 10497) for key in ("wrapS", "wrapT")], sampler.get("magFilter", 9729)
    if any(wrap not in WRAPS for wrap in wraps) or nearest not in FILTERS:
        raise Fault(
            f"expected a sampler of glTF 2.0 for the texture {name!r}, got wraps {wraps} and magFilter {nearest}; "
            "export it again"
        )
    return {"wrap": (WRAPS[wraps[0]], WRAPS[wraps[1]]), "filter": FILTERS[nearest]}
