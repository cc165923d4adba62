"""Meshes of trimesh as parts: those in memory, and files of formats that it alone reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...optional import require
from .context import Textures, UnreadLog, linear_colors
from .part import FormatError, Part


def of_trimesh(given: Any, textures: Textures | None = None) -> Part:
    """Return a part from a trimesh.Trimesh, in float64. Raises FormatError. Colours of vertices, faces and images are sRGB
    there; a material's factor is linear, as in glTF and OBJ files."""
    appearance: dict[str, Any] = {}
    visual = given.visual
    faces = np.asarray(given.faces, np.int64)
    if visual.kind == "vertex":
        appearance["colors"] = linear_colors("vertex", visual.vertex_colors, srgb=True)
    elif visual.kind == "face":
        appearance["face_colors"] = linear_colors("face", visual.face_colors, srgb=True)
    elif visual.kind == "texture":
        material = visual.material
        image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
        factor = _factor(material)
        if visual.uv is not None:
            appearance["uvs"] = np.asarray(visual.uv, np.float32)
        if visual.uv is not None and image is not None:
            image.format = image.format or "PNG"  # one that was made, not read
            # A SimpleMaterial has a grey of its own where its file says none.
            own = tuple(factor) if factor is not None and hasattr(material, "baseColorTexture") else (1.0, 1.0, 1.0)
            appearance["texture"] = (textures or Textures()).get("texture", image, own)
        elif factor is not None:
            appearance["face_colors"] = linear_colors("face", np.tile(factor, (len(faces), 1)), srgb=False)
    return Part("", np.asarray(given.vertices, np.float64), faces, **appearance)


def _factor(material: Any) -> np.ndarray | None:
    """Return the factor (3,), linear; None where the material has none of its own."""
    if hasattr(material, "baseColorFactor"):
        given = material.baseColorFactor
    else:
        given = material.main_color if hasattr(material, "main_color") else None
        default = require("trimesh.visual.color", "trimesh", "colours of meshes").DEFAULT_COLOR
        given = None if given is None or np.array_equal(given, default) else given
    return None if given is None else np.asarray(given[:3], np.float64) / 255.0


def read(file: Path, unread: UnreadLog) -> list[Part]:
    """Return the parts of a file in their places, in metres where it says its unit, along its own axes. Notes missing textures.
    Raises FormatError or ImportError."""
    trimesh = require("trimesh", "trimesh", "reading meshes")
    conversion = require("trimesh.units", "trimesh", "reading meshes").unit_conversion
    try:
        scene = trimesh.load_scene(file, process=False, resolver=_resolver(file, unread))
        meshes = [mesh for mesh in scene.dump(concatenate=False) if hasattr(mesh, "faces") and len(mesh.faces)]
        textures, parts = Textures(), []
        for mesh in meshes:
            part, unit = of_trimesh(mesh, textures), mesh.metadata.get("units")
            scale = 1.0 if unit is None else conversion(unit, "meters")
            parts.append(part._replace(verts=scale * part.verts))
    except (FormatError, ImportError):
        raise
    except Exception as error:
        raise FormatError(
            f"expected a mesh, got one that cannot be read ({type(error).__name__}: {error}); convert it to GLB"
        ) from error
    if not parts:
        raise FormatError("expected triangles, got none: the file is truncated, or was exported without faces")
    return parts


def _resolver(file: Path, unread: UnreadLog) -> Any:
    """Return a resolver of the files that a mesh names, which notes missing files; trimesh goes on without them."""
    base = require("trimesh.resolvers", "trimesh", "reading meshes").FilePathResolver

    class Noting(base):  # type: ignore[misc, valid-type]
        def get(self, name: str) -> bytes:
            try:
                return super().get(name)
            except Exception:
                unread.note(repr(name), "no such file; shown without")
                raise

    return Noting(str(file))
