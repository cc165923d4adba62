"""Mesh files as parts: what each format holds, in its place and checked, and what nobody reads of it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from ..camera.camera import Camera
from ..scene.material import Material
from .formats import gltf, gltf_material, gltf_rig, obj, off, ply, stl, threemf
from .formats.disguised import check_disguised
from .formats.geometry import checked, shape, turned, typed
from .formats.gltf_nodes import cameras, lights
from .formats.gltf_scene import instances as gltf_instances
from .formats.gltf_schema import explained
from .formats.gltf_unread import note_unread
from .formats.part import Fault, Model, Part, Wanted
from .formats.source import Source, linear_colors
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
    if kind != "3mf" or not data.startswith(b"PK"):  # which is an archive itself
        check_disguised(data, f"{'an' if kind in ('obj', 'off', 'stl') else 'a'} {kind.upper()} file")
    with _as_fault(kind):
        model = READERS[kind](data, kind, source)
    if not model.parts:
        raise Fault("expected triangles, got none: the file is truncated, or was exported without faces")
    model = typed(model, wanted.dtype, source)
    source.unsupported.say(path)
    return model


def read_rig(path: PathLike, wanted: Wanted) -> tuple[gltf_rig.RigFile, Model]:
    """What bends in a glTF or GLB file, and its parts before anything moves them: each in the coordinates of its mesh, with its
    normals as they stand in the file. Raises Fault, FileNotFoundError, ValueError or ImportError. Warns of what nobody reads."""
    file = check_readable(path, GLTFS)
    data, kind, source = file.read_bytes(), file.suffix.lower()[1:], Source.of(path, wanted)
    check_disguised(data, f"a {kind.upper()} file")
    known: dict[object, Any] = {}
    with _as_fault(kind):
        given = gltf.read(data, kind)
        with explained(given.tree):
            note_unread(given.tree, source)
            found = gltf_rig.read(given, source)
            parts = []
            for name, primitive, _ in found.parts:
                with _naming(name, alone=len(found.parts) == 1):
                    raw = {"vertices": primitive.positions, "faces": primitive.triangles}
                    parts.append(checked(shape(name, raw, np.eye(4))._replace(**gltf_material.look(primitive, known))))
            if not parts:
                raise Fault("expected triangles, got none: the file is truncated, or was exported without faces")
            model = Model(parts, lights(given.tree, source) if wanted.lit else [])
    model = typed(model, wanted.dtype, source)
    source.unsupported.say(path)
    return found, model


def read_cameras(path: PathLike, size: tuple[int, int]) -> dict[str, Camera | Fault]:
    """Return the cameras of a glTF or GLB file by name, in float64; in place of one that cannot be read its Fault. Raises
    Fault, FileNotFoundError or ValueError."""
    file = check_readable(path, GLTFS)
    data, kind = file.read_bytes(), file.suffix.lower()[1:]
    check_disguised(data, f"a {kind.upper()} file")
    with _as_fault(kind):
        tree = gltf.read(data, kind).tree
        with explained(tree):
            return cameras(tree, size)


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
    known: dict[object, Any] = {}

    def look(raw: dict[str, Any]) -> dict[str, object]:
        return gltf_material.look(raw["primitive"], known)

    with explained(file.tree):
        note_unread(file.tree, source)
        return Model(_parts(gltf_instances(file, source), look), lights(file.tree, source) if source.wanted.lit else [])


def _read_3mf(data: bytes, kind: str, source: Source) -> Model:
    material = Material() if source.wanted.lit else None

    def look(raw: dict[str, Any]) -> dict[str, object]:
        found: dict[str, object] = {"material": material}
        if raw.get("vertex_colors") is not None:
            return found | {"colors": linear_colors("vertex", raw["vertex_colors"], srgb=True)}
        if raw.get("face_colors") is not None:
            return found | {"face_colors": linear_colors("face", raw["face_colors"], srgb=True)}
        return found

    return Model(_parts(threemf.instances(data, source), look), [])


def _read_plain(data: bytes, kind: str, source: Source) -> Model:
    """OBJ, PLY, STL and OFF."""
    found, parts = [part for part in PLAIN[kind](data, source) if len(part.faces)], []
    for part in found:
        with _naming(part.name, alone=len(found) == 1):
            parts.append(_finished(part, np.eye(4)))
    return Model(parts, [])


def _parts(
    placed: list[tuple[str, dict[str, Any], np.ndarray]],
    look: Callable[[dict[str, Any]], dict[str, Any]],
) -> list[Part]:
    """Parts in their places, with the fields that look() makes of the arrays of each."""
    placed = [p for p in placed if len(p[1].get("faces", ()))]  # the others: points and lines
    parts = []
    for name, raw, matrix in placed:
        with _naming(name, alone=len(placed) == 1):
            parts.append(_finished(shape(name, raw, matrix)._replace(**look(raw)), matrix))
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
