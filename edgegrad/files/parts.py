"""Mesh files as parts: what each format holds, in its place and checked, and what nobody reads of it."""

from __future__ import annotations

import io
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from ..camera.camera import Camera
from ..optional import require
from ..scene.material import Material
from .formats import gltf, gltf_material, obj, off, ply, stl, threemf
from .formats.geometry import checked, place, shape, turned, typed
from .formats.gltf_nodes import cameras, lights
from .formats.part import Fault, Model, Part, Wanted
from .formats.source import Source
from .paths import PathLike, check_readable

GLTFS = (".gltf", ".glb")
MESHES = (".obj", *GLTFS, ".ply", ".stl", ".off", ".3mf")


# What trimesh logs, tracebacks among it, becomes an error here; whoever sets up logging still gets it.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


def read_model(path: PathLike, wanted: Wanted) -> Model:
    """The parts of a mesh file, and its lights.

    Raises Fault, FileNotFoundError, ValueError (see check_readable) or ImportError. Warns of what nobody reads.
    """
    file = check_readable(path, MESHES)
    data, kind, source = file.read_bytes(), file.suffix.lower()[1:], Source.of(path, wanted)
    with _as_fault(kind):
        model = READERS[kind](data, kind, source)
    if not model.parts:
        raise Fault("expected triangles, got none: the file is truncated, or was exported without faces")
    parts, dtype = typed(model.parts, wanted.dtype, source)
    source.unsupported.say(path)
    return model._replace(parts=parts, dtype=dtype)


def read_cameras(path: PathLike, size: tuple[int, int], dtype: torch.dtype) -> dict[str, Camera]:
    """Those of a glTF or GLB file, by name. Raises Fault, FileNotFoundError or ValueError."""
    file = check_readable(path, GLTFS)
    with _as_fault(kind := file.suffix.lower()[1:]):
        return cameras(gltf.read_tree(file.read_bytes(), kind), size, dtype)


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
    tree, wanted = gltf.read_tree(data, kind), source.wanted
    loaded = _load(gltf.for_trimesh(data, kind, tree), kind, source)
    primitives = gltf.primitives(tree, loaded["geometry"])
    gltf.note_unsupported(tree, source)
    known: dict[object, Any] = {}

    def look(name: str, raw: dict[str, Any], origin: np.ndarray) -> dict[str, object]:
        return gltf_material.look(gltf_material.Primitive(tree, primitives[name], raw, source), known)

    return Model(_parts(loaded, look), lights(tree, source) if wanted.lit else [])


def _read_3mf(data: bytes, kind: str, source: Source) -> Model:
    instances = threemf.instances(data)
    loaded = _load(data, kind, source)
    if instances != len(loaded["graph"]):
        raise Fault(
            f"expected {instances} instances of objects, and {len(loaded['graph'])} could be read: components are nested "
            "too often, or refer to objects that are not there; export it flat"
        )
    material = Material() if source.wanted.lit else None
    return Model(_parts(loaded, lambda name, raw, origin: {"material": material}), [])


def _read_plain(data: bytes, kind: str, source: Source) -> Model:
    """OBJ, PLY, STL and OFF."""
    found, parts = PLAIN[kind](data, source), []
    for part in found:
        with _naming(part.name, alone=len(found) == 1):
            parts.append(_finished(part, np.eye(4)))
    return Model(parts, [])


def _load(data: bytes, kind: str, source: Source, **options: object) -> dict[str, Any]:
    # The loaders themselves rather than trimesh.load: they hand over the numbers of the file before trimesh rounds
    # colours to 8 bit, and nothing but these formats, no address and no other folder is ever tried.
    loader = require("trimesh.exchange.load", "trimesh", "reading meshes").mesh_loaders[kind]
    return loader(file_obj=io.BytesIO(data), resolver=source.folder, **options)


def _parts(loaded: dict[str, Any], look: Callable[[str, dict[str, Any], np.ndarray], dict[str, Any]]) -> list[Part]:
    """Parts in their places, with the fields that look() gives by name, arrays and the face that each triangle came from."""
    placed = [p for p in place(loaded) if len(p[1].get("faces", ()))]  # the others: points and lines
    parts = []
    for name, raw, matrix in placed:
        with _naming(name, alone=len(placed) == 1):
            part, origin = shape(name, raw, matrix)
            parts.append(_finished(part._replace(**look(name, raw, origin)), matrix))
    return parts


def _finished(part: Part, matrix: np.ndarray) -> Part:
    """With its normals in the world. Raises Fault."""
    return checked(part._replace(normals=turned(part, matrix)))


@contextmanager
def _naming(name: str, alone: bool) -> Iterator[None]:
    """Names the part at fault, unless it is the only one."""
    try:
        yield
    except Fault as fault:
        raise Fault(str(fault) if alone else f"part {name!r}: {fault}") from fault.__cause__


PLAIN = {"obj": obj.read, "ply": ply.read, "stl": stl.read, "off": off.read}
READERS = {"gltf": _read_gltf, "glb": _read_gltf, "3mf": _read_3mf, **dict.fromkeys(PLAIN, _read_plain)}
