"""Meshes of trimesh as parts: those in memory, and files of formats that it alone reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...optional import require
from .part import Fault, Part
from .source import Textures, Unsupported, linear_colors


def of_trimesh(given: Any, textures: Textures | None = None) -> Part:
    """A part from a trimesh.Trimesh, in float64. Colours of vertices, faces and images are sRGB there; a material's factor is
    linear, as in glTF and OBJ files. Raises Fault."""
    look: dict[str, Any] = {}
    visual = given.visual
    faces = np.asarray(given.faces, np.int64)
    if visual.kind == "vertex":
        look["colors"] = linear_colors("vertex", visual.vertex_colors, srgb=True)
    elif visual.kind == "face":
        look["face_colors"] = linear_colors("face", visual.face_colors, srgb=True)
    elif visual.kind == "texture":
        material = visual.material
        image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
        factor = _factor(material)
        if visual.uv is not None:
            look["uvs"] = np.asarray(visual.uv, np.float32)
        if visual.uv is not None and image is not None:
            image.format = image.format or "PNG"  # one that was made, not read
            # A SimpleMaterial has a grey of its own where its file says none.
            own = tuple(factor) if factor is not None and hasattr(material, "baseColorTexture") else (1.0, 1.0, 1.0)
            look["texture"] = (textures or Textures()).get("texture", image, own)
        elif factor is not None:
            look["face_colors"] = linear_colors("face", np.tile(factor, (len(faces), 1)), srgb=False)
    return Part("", np.asarray(given.vertices, np.float64), faces, **look)


def _factor(material: Any) -> np.ndarray | None:
    """(3,) linear; None where the material has none of its own."""
    if hasattr(material, "baseColorFactor"):
        given = material.baseColorFactor
    else:
        given = material.main_color if hasattr(material, "main_color") else None
        default = require("trimesh.visual.color", "trimesh", "colours of meshes").DEFAULT_COLOR
        given = None if given is None or np.array_equal(given, default) else given
    return None if given is None else np.asarray(given[:3], np.float64) / 255.0


def read(file: Path, unsupported: Unsupported) -> list[Part]:
    """The parts of a file in their places, in metres where it says its unit, along its own axes. Notes the textures that are not
    there. Raises Fault or ImportError."""
    trimesh = require("trimesh", "trimesh", "reading meshes")
    conversion = require("trimesh.units", "trimesh", "reading meshes").unit_conversion
    try:
        scene = trimesh.load_scene(file, process=False, resolver=_resolver(file, unsupported))
        meshes = [mesh for mesh in scene.dump(concatenate=False) if hasattr(mesh, "faces") and len(mesh.faces)]
        textures, parts = Textures(), []
        for mesh in meshes:
            part, unit = of_trimesh(mesh, textures), mesh.metadata.get("units")
            scale = 1.0 if unit is None else conversion(unit, "meters")
            parts.append(part._replace(verts=scale * part.verts))
    except (Fault, ImportError):
        raise
    except Exception as error:
        raise Fault(
            f"expected a mesh, got one that cannot be read ({type(error).__name__}: {error}); convert it to GLB"
        ) from error
    if not parts:
        raise Fault("expected triangles, got none: the file is truncated, or was exported without faces")
    return parts


def _resolver(file: Path, unsupported: Unsupported) -> Any:
    """Return a resolver that finds the files a mesh names. trimesh goes on without those that are missing; they are noted."""
    base = require("trimesh.resolvers", "trimesh", "reading meshes").FilePathResolver

    class Noting(base):  # type: ignore[misc, valid-type]
        def get(self, name: str) -> bytes:
            try:
                return super().get(name)
            except Exception:
                unsupported.note(repr(name), "no such file; shown without")
                raise

    return Noting(str(file))
