"""Mesh files as plain arrays: glTF and 3MF by what formats/ reads of them, others through trimesh, with the faults that it
passes over without a word."""

from __future__ import annotations

import io
import logging
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from ..camera.camera import Camera
from ..optional import require
from .formats import gltf, gltf_material, obj, threemf
from .formats.geometry import checked, place, shape, turned
from .formats.gltf_nodes import cameras, lights
from .formats.gltf_scene import instances as gltf_instances
from .formats.gltf_unread import note_unread
from .formats.part import Fault, Model, Part, Wanted
from .formats.source import Folder, Source, linear_colors, opened
from .paths import PathLike, check_readable

GLTFS = (".gltf", ".glb")
MESHES = (".obj", *GLTFS, ".ply", ".stl", ".off", ".3mf")


# What trimesh logs, tracebacks among it, becomes an error here; whoever sets up logging still gets it.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


def read_model(path: PathLike, wanted: Wanted) -> Model:
    """The parts of a mesh file, and its lights.

    Raises Fault, FileNotFoundError, ValueError (see check_readable) or ImportError. Warns of what a lit scene asks for in vain.
    """
    file = check_readable(path, MESHES)
    data, kind, source = file.read_bytes(), file.suffix.lower()[1:], Source.of(path, wanted)
    with _as_fault(kind):
        if kind == "3mf":
            model = Model(_parts(threemf.instances(data, source), _plain_look(source)), [])
        else:
            model = _read_gltf(data, kind, source) if kind in ("gltf", "glb") else _read_plain(data, kind, source)
    if not model.parts:
        raise Fault("expected triangles, got none: the file is truncated, or was exported without faces")
    announced, found = _announced_faces(data, kind), sum(len(part.faces) for part in model.parts)
    if found < announced:
        raise Fault(f"expected the {announced} faces that the file announces, got {found}; it is truncated or damaged")
    source.unsupported.say(path)
    return model


def read_cameras(path: PathLike, size: tuple[int, int], dtype: torch.dtype) -> dict[str, Camera]:
    """Those of a glTF or GLB file, by name. Raises Fault, FileNotFoundError or ValueError."""
    file = check_readable(path, GLTFS)
    with _as_fault(kind := file.suffix.lower()[1:]):
        return cameras(gltf.read(file.read_bytes(), kind).tree, size, dtype)


@contextmanager
def _as_fault(kind: str) -> Iterator[None]:
    """Makes whatever goes wrong while a file is read a fault of the file."""
    try:
        yield
    except (Fault, FileNotFoundError):
        raise
    except ImportError as error:
        if "pip install" in str(error):
            raise
        raise ImportError(  # trimesh's own, of what its extras bring
            f"reading this {kind.upper()} file needs {error.name or 'more'}; install it with: pip install 'edgegrad[files]' "
            f"({error})"
        ) from error
    except Exception as error:
        raise Fault(
            f"expected a whole {kind.upper()} file, got one that cannot be read ({type(error).__name__}: {error}); "
            "it may be truncated or of another kind: export it again"
        ) from error


def _read_gltf(data: bytes, kind: str, source: Source) -> Model:
    file = gltf.read(data, kind)
    note_unread(file.tree, source)
    known: dict[object, Any] = {}

    def look(name: str, raw: dict[str, Any], origin: np.ndarray) -> dict[str, object]:
        return gltf_material.look(raw["primitive"], known)

    return Model(_parts(gltf_instances(file, source), look), lights(file.tree, source) if source.wanted.lit else [])


def _read_plain(data: bytes, kind: str, source: Source) -> Model:
    """All formats but glTF and 3MF."""
    wanted, folder = source.wanted, source.folder
    options: dict[str, object] = {}
    if kind == "obj":
        data = obj.tidy(data)
        options["split_objects"] = wanted.split
    elif kind == "ply":
        # Without a texture, vertices must not be split at its seams: their colours would not follow.
        header = data.split(b"end_header")[0].lower()
        options["fix_texture"] = wanted.unwrap or (wanted.materials and b"texturefile" in header)
    with warnings.catch_warnings():  # after which Python says again what it said before, so not for a glTF
        # Where a text stops being numbers, NumPy drops the rest and only warns.
        warnings.filterwarnings("error", message="string or file could not be read", category=DeprecationWarning)
        loaded = _load(data, kind, source, **options)
    if wanted.materials:
        _check_folder(folder)
        if kind == "ply" and folder.contents and "visual" not in loaded:
            raise Fault(f"expected texture coordinates for its texture {next(iter(folder.contents))!r}, got none")
    if kind == "obj" and "geometry" in loaded:
        loaded["geometry"] = dict(reversed(loaded["geometry"].items()))  # trimesh turns their order round
    return Model(_parts(place(loaded), _plain_look(source)), [])


def _plain_look(source: Source) -> Callable[[str, dict[str, Any], np.ndarray], dict[str, Any]]:
    """What look() of _parts() is in all formats but glTF."""
    materials = obj.Materials()

    def look(name: str, raw: dict[str, Any], origin: np.ndarray) -> dict[str, object]:
        found = _look(raw, origin, source)
        return found | _lit(raw, source, materials, has_uvs=found["uvs"] is not None) if source.wanted.lit else found

    return look


def _load(data: bytes, kind: str, source: Source, **options: object) -> dict[str, Any]:
    # The loaders themselves rather than trimesh.load: they hand over the numbers of the file before trimesh rounds
    # colours to 8 bit, and nothing but these formats, no address and no other folder is ever tried.
    loader = require("trimesh.exchange.load", "trimesh", "reading meshes").mesh_loaders[kind]
    return loader(file_obj=io.BytesIO(data), resolver=source.folder, **options)


def _parts(
    placed: list[tuple[str, dict[str, Any], np.ndarray]],
    look: Callable[[str, dict[str, Any], np.ndarray], dict[str, Any]],
) -> list[Part]:
    """Parts in their places, with the fields that look() gives by name, arrays and the face that each triangle came from."""
    placed = [p for p in placed if len(p[1].get("faces", ()))]  # the others: points and lines
    parts = []
    for name, raw, matrix in placed:
        try:
            part, origin = shape(name, raw, matrix)
            part = part._replace(**look(name, raw, origin))
            parts.append(checked(part._replace(normals=turned(part, matrix))))
        except Fault as fault:
            raise Fault(f"part {name!r}: {fault}" if len(placed) > 1 else str(fault)) from fault.__cause__
    return parts


def _look(raw: dict[str, Any], origin: np.ndarray, source: Source) -> dict[str, Any]:
    """The fields of a part that say what it looks like, in all formats but glTF."""
    visual, wanted = raw.get("visual"), source.wanted
    look: dict[str, Any] = {"uvs": _uvs(visual)}
    image = getattr(getattr(visual, "material", None), "image", None)
    diffuse = _mtl(visual).get("kd")
    if (
        wanted.materials and image is not None and image.format
    ):  # the grey image that trimesh makes up comes from no format
        look["texture"] = source.textures.get(image.info.get("file_path") or next(iter(source.folder.contents)), image)
    elif raw.get("vertex_colors") is not None:
        look["colors"] = linear_colors("vertex", raw["vertex_colors"], srgb=True)
    elif raw.get("face_colors") is not None:
        colors = linear_colors("face", raw["face_colors"], srgb=True)
        # Polygons of mixed sizes come split already, and no longer say which face a triangle is from.
        look["face_colors"] = colors[torch.from_numpy(origin)] if len(colors) == origin[-1] + 1 else colors
    elif wanted.materials and diffuse is not None:
        look["face_colors"] = torch.tensor(np.broadcast_to(diffuse, 3), dtype=torch.float32).repeat(len(origin), 1)
    return look


def _lit(raw: dict[str, Any], source: Source, materials: obj.Materials, has_uvs: bool) -> dict[str, Any]:
    """The fields of a part that say how it scatters light, in all formats but glTF."""
    given = _mtl(raw.get("visual")) if source.wanted.materials else {}
    look: dict[str, Any] = {"material": materials.get(given, source), "normals": raw.get("vertex_normals")}
    look["alpha"] = obj.alpha(given, source)
    if look["alpha"] is not None and look["alpha"].numel() == 1 and not has_uvs:
        look["uvs"] = np.zeros((len(raw["vertices"]), 2), np.float32)  # one number for all
    return look


def _mtl(visual: object) -> dict[str, Any]:
    """What an MTL file says of a part."""
    return getattr(getattr(visual, "material", None), "kwargs", {})


def _uvs(visual: object) -> np.ndarray | None:
    uvs = getattr(visual, "uv", None)
    return None if uvs is None or len(uvs) == 0 else np.asarray(uvs, np.float32)


def _check_folder(folder: Folder) -> None:
    """Every file that an OBJ or PLY names was found, and every one that is not a material library is an image."""
    for failure in folder.failures.values():
        raise failure
    for name, content in folder.contents.items():
        if not name.strip().lower().endswith(".mtl"):
            opened(name, content)


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
