"""Mesh files as parts: the content of each format, placed and checked, and what nobody reads of it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from ..camera.camera import Camera
from ..scene.material import Material
from .formats import gltf, gltf_material, gltf_rig, obj, off, ply, stl, threemf
from .formats.context import LoadContext, check_file_type, linear_colors
from .formats.geometry import checked, shape, turned, typed
from .formats.gltf_nodes import cameras, lights
from .formats.gltf_scene import instances as gltf_instances
from .formats.gltf_schema import explained
from .formats.gltf_unread import note_unread
from .formats.part import FormatError, LoadOptions, MeshFile, Part
from .paths import PathLike, check_readable

GLTFS = (".gltf", ".glb")
Appearance = Callable[[dict[str, Any]], dict[str, Any]]  # the fields of a part, from the arrays of a file


# Errors here replace the tracebacks that trimesh logs; a user who sets up logging still gets them.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


def read_mesh_file(path: PathLike, options: LoadOptions) -> MeshFile:
    """Return the parts of a mesh file, and its lights, and warn of what nobody reads. Raises FormatError, FileNotFoundError,
    ValueError (see check_readable) or ImportError."""
    data, kind = _read_bytes(path, MESHES)
    context = LoadContext.from_path(path, options)
    with _as_format_error(kind):
        model = READERS[kind](data, kind, context)
    return _checked_file(model, path, context)


def read_rig(path: PathLike, options: LoadOptions) -> tuple[gltf_rig.RigFile, MeshFile]:
    """Return what moves vertices in a glTF or GLB file, and its parts before anything moves them, in the coordinates of their
    meshes. Normals are those of the file. Warns of what nobody reads. Raises FormatError, FileNotFoundError, ValueError or
    ImportError."""
    data, kind = _read_bytes(path, GLTFS)
    context = LoadContext.from_path(path, options)
    with _as_format_error(kind):
        given = gltf.read(data, kind)
        with explained(given.tree):
            note_unread(given.tree, context)
            found = gltf_rig.read(given, context)
            appearance, parts = _gltf_appearance(), []
            for name, primitive, _ in found.parts:
                with _errors_with_part(name, alone=len(found.parts) == 1):
                    raw = {"vertices": primitive.positions, "faces": primitive.triangles, "primitive": primitive}
                    parts.append(checked(shape(name, raw, np.eye(4))._replace(**appearance(raw))))
            model = MeshFile(parts, lights(given.tree, context) if options.lit else [])
    return found, _checked_file(model, path, context)


def read_cameras(path: PathLike, size: tuple[int, int]) -> dict[str, Camera | FormatError]:
    """Return the cameras of a glTF or GLB file by name, in float64; the FormatError stands in place of one that cannot be read.
    Raises FormatError, FileNotFoundError or ValueError."""
    data, kind = _read_bytes(path, GLTFS)
    with _as_format_error(kind):
        tree = gltf.read(data, kind).tree
        with explained(tree):
            return cameras(tree, size)


def _read_bytes(path: PathLike, suffixes: tuple[str, ...]) -> tuple[bytes, str]:
    """Return the content and the kind of a file that is what its name says."""
    file = check_readable(path, suffixes)
    data, kind = file.read_bytes(), file.suffix.lower()[1:]
    if kind != "3mf" or not data.startswith(b"PK"):  # which is an archive itself
        check_file_type(data, f"{'an' if kind in ('obj', 'off', 'stl') else 'a'} {kind.upper()} file")
    return data, kind


def _checked_file(model: MeshFile, path: PathLike, context: LoadContext) -> MeshFile:
    """Return the content in its type, and warn of what nobody reads. Raises FormatError without parts."""
    if not model.parts:
        raise FormatError("expected triangles, got none: the file is truncated, or was exported without faces")
    model = typed(model, context.options.dtype, context)
    context.unread.warn(path)
    return model


@contextmanager
def _as_format_error(kind: str) -> Iterator[None]:
    """Turn every error while a file is read into a FormatError."""
    try:
        yield
    except (FormatError, FileNotFoundError):
        raise
    except ImportError as error:
        if "pip install" in str(error):
            raise
        raise ImportError(  # trimesh's own, of what its extras bring
            f"reading this {kind.upper()} file needs {error.name or 'more'}; install it with: pip install 'edgegrad[files]' "
            f"({error})"
        ) from error
    except Exception as error:
        raise FormatError(
            f"expected a whole {kind.upper()} file, got one that cannot be read ({type(error).__name__}: {error}); "
            "it may be truncated or of another kind: export it again"
        ) from error


def _read_gltf(data: bytes, kind: str, context: LoadContext) -> MeshFile:
    file = gltf.read(data, kind)
    with explained(file.tree):
        note_unread(file.tree, context)
        parts = _parts(gltf_instances(file, context), _gltf_appearance())
        return MeshFile(parts, lights(file.tree, context) if context.options.lit else [])


def _gltf_appearance() -> Appearance:
    """Return the appearance of primitives, which share the materials of a file."""
    known: dict[object, Any] = {}
    return lambda raw: gltf_material.appearance(raw["primitive"], known)


def _read_3mf(data: bytes, kind: str, context: LoadContext) -> MeshFile:
    material = Material() if context.options.lit else None

    def appearance(raw: dict[str, Any]) -> dict[str, object]:
        found: dict[str, Any] = {"material": material}
        for field, key, what in (("colors", "vertex_colors", "vertex"), ("face_colors", "face_colors", "face")):
            if raw.get(key) is not None:  # one of both at most
                found[field] = linear_colors(what, raw[key], srgb=True)
        return found

    return MeshFile(_parts(threemf.instances(data, context), appearance), [])


def _read_parts(data: bytes, kind: str, context: LoadContext) -> MeshFile:
    """Read OBJ, PLY, STL and OFF."""
    found, parts = [part for part in PART_READERS[kind](data, context) if len(part.faces)], []
    for part in found:
        with _errors_with_part(part.name, alone=len(found) == 1):
            parts.append(_finished(part, np.eye(4)))
    return MeshFile(parts, [])


def _parts(placed: list[tuple[str, dict[str, Any], np.ndarray]], appearance: Appearance) -> list[Part]:
    """Return parts in their places, with the fields that appearance() makes of the arrays of each."""
    placed = [p for p in placed if len(p[1].get("faces", ()))]  # the others: points and lines
    parts = []
    for name, raw, matrix in placed:
        with _errors_with_part(name, alone=len(placed) == 1):
            parts.append(_finished(shape(name, raw, matrix)._replace(**appearance(raw)), matrix))
    return parts


def _finished(part: Part, matrix: np.ndarray) -> Part:
    """Return the checked part with its normals in the world. Raises FormatError."""
    return checked(part._replace(normals=turned(part, matrix)))


@contextmanager
def _errors_with_part(name: str, alone: bool) -> Iterator[None]:
    """Name the part in an error, unless it is the only one."""
    try:
        yield
    except FormatError as error:
        raise FormatError(str(error) if alone else f"part {name!r}: {error}") from error.__cause__


PART_READERS = {"obj": obj.read, "ply": ply.read, "stl": stl.read, "off": off.read}
READERS = {
    "obj": _read_parts, "gltf": _read_gltf, "glb": _read_gltf, **dict.fromkeys(PART_READERS, _read_parts), "3mf": _read_3mf
}  # fmt: skip
MESHES = tuple(f".{kind}" for kind in READERS)
