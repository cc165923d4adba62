"""Meshes and scenes from files; images come from image.py, cameras from cameras.py.

What colours mean: vertex and face colours of OBJ, PLY and 3MF files and the texels of colour textures are sRGB on disk and
become linear. Factors of materials (glTF baseColorFactor, emissiveFactor, OBJ Kd, Ke), vertex colours of glTF and data textures
(normals, metallic, roughness) are linear already. Integers of a PLY reach up to 255, or 65535 where one is larger. Floats reach
up to 1, which rounding may pass by 0.01, or up to 255 where one is 2 or more; between is an error. A glTF multiplies texture,
factor and vertex colours. Vertex colours that differ next to a texture need lit=True, because an unlit mesh has one kind of
colour. An OBJ multiplies map_Kd and Kd. Of several kinds in another file the first of these counts: texture, vertex colours,
face colours, the material's colour.

lit=False, the default, takes these colours for radiance. Lights, normals and everything of a material but its base colour are
dropped. Alpha is dropped, too, except where a material of a glTF has the alphaMode MASK: the alpha of its texture, or of its
vertices (COLOR_0), times that of its factor becomes the mesh's, with its alphaCutoff. The wrap is that of a glTF's
sampler, the filter that of its magnification, without mipmaps.

lit=True takes them for base colours:

- glTF: metallic-roughness materials with all five textures, each on its own set of texture coordinates with its own
  KHR_texture_transform, wraps and filter (mipmaps unless the sampler says otherwise). KHR_materials_emissive_strength is read;
  KHR_materials_specular is Lambertian where its factor, and metallic, are 0. Without doubleSided the back of faces is black.
  alphaMode is MASK or BLEND (see Material). KHR_materials_unlit means no material: colours are radiance. Normals are in the
  world where the file has them; otherwise faces are flat. Point, spot and directional lights of KHR_lights_punctual have no
  range. Units are glTF's: candela, lux and candela a square metre.
- OBJ: Lambertian, with Ke for emission, and d and map_d as alpha masks at 0.5. With highlights (Ks, unless illum is 0 or 1) it
  is a dielectric, rough by Ns; with Pr or Pm metallic-roughness. vn are its normals.
- Other formats: Lambertian, with the normals of a PLY or an OFF.

One UserWarning names everything else in a file: elements, properties, keywords, extensions, attributes and bytes that nothing
reads, unless they change no picture; and of a glTF animations, morph targets, skins (the transformation of a skinned node
itself does not count), instancing, points and lines. Without lit=True it leaves out what concerns materials and lights alone.
Nodes that KHR_node_visibility hides are left out.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from ..check import check_dtype, check_flag
from ..scene.mesh import Mesh
from ..scene.scene import Scene
from .formats import trimesh_parts
from .formats.context import LoadContext
from .formats.geometry import typed
from .formats.part import FormatError, LoadOptions, MeshFile, errors_with_path
from .image import read_image
from .parts import MESHES, read_mesh_file
from .paths import PathLike, StoredPath
from .welding import merge, to_mesh


def load_mesh(
    path: PathLike,
    texture: PathLike | Tensor | None = None,
    materials: bool = True,
    lit: bool = False,
    dtype: torch.dtype | None = None,
) -> Mesh:
    """Return one Mesh from an OBJ, glTF, GLB, PLY, STL, OFF or 3MF file, in the file's units and axes.

    Vertices that the file repeats (at texture seams, for normals, in triangle soups) are welded where their positions are
    equal; unused ones are left out. Convex polygons become fans of triangles, concave ones triangles that cover them. Texture
    coordinates run up, and are kept without a texture, too. Where welded vertices had different colours, they become
    `corner_colors`. Parts of one appearance (all plain, all with vertex colours, all with face colours, all on one texture;
    lit, all with one material) become one Mesh. Files that the file names are read from its folder and below, and from nowhere
    else.

    Parameters
    ----------
    path : str or Path
    texture : str, Path or (h, w, C) tensor, default the file's
        Image file, or linear radiance, for the file's texture coordinates in place of its colours. Like textures that the file
        names, an image is read as it is stored: its EXIF orientation is not applied.
    materials : bool, default True
        False ignores the file's textures and materials, and does not need their files.
    lit : bool, default False
        True gives the mesh a material and normals for lit scenes; Lambertian where the file's own material is left out.
        load_scene() also reads lights.
    dtype : torch.float32, torch.float64 or None
        Type of all tensors. None: float64 where float32 would move vertices by more than a millionth of the extent, as it does
        in map coordinates; else float32. Vertices are welded before they are rounded to less than that, which a warning tells.

    Raises
    ------
    FileNotFoundError, TypeError, ValueError, ImportError
        The file, or one that it names, is not there. ValueError: it is of another kind, damaged, without triangles, or has bad
        indices or positions; or its parts differ in appearance: use load_scene(). ImportError: trimesh is missing, or
        mapbox_earcut for concave faces of more than four corners.

    Notes
    -----
    Colours become linear radiance, or base colours with `lit`; STL gives the shape only. Colour textures and the colours of
    vertices and faces of OBJ, PLY and 3MF are sRGB; factors of materials and vertex colours of glTF are linear. Texture,
    factor and vertex colours of a glTF are multiplied, and so are map_Kd and Kd of an OBJ; otherwise the first of texture,
    vertex colours, face colours and material counts.
    """
    options = LoadOptions(materials and texture is None, check_flag("lit", lit), dtype=check_dtype(dtype))
    with errors_with_path(path):
        model = read_mesh_file(path, options)
        parts = model.parts
        if texture is not None:
            image = texture if isinstance(texture, Tensor) else read_image(StoredPath(texture), channels=3)
            parts = [part._replace(colors=None, face_colors=None, texture=image) for part in parts]
        return to_mesh(merge(parts), model.dtype)


def load_scene(path: PathLike, materials: bool = True, lit: bool = False, dtype: torch.dtype | None = None) -> Scene:
    """Return a Scene with one Mesh for each part of a file.

    A part is a primitive at a node of a glTF, a material in an object of an OBJ, a solid of an STL, or an item of a 3MF.
    Transformations are applied to the vertices. With `lit`, the scene has materials, normals and the lights of the file;
    without lights it is black.

    Parameters
    ----------
    path, materials, lit, dtype
        As of load_mesh(), and so are the errors.
    """
    options = LoadOptions(materials, check_flag("lit", lit), split=True, dtype=check_dtype(dtype))
    with errors_with_path(path):
        model = read_mesh_file(path, options)
        return Scene([to_mesh(part, model.dtype) for part in model.parts], lights=model.lights)


def load_parts(path: PathLike, materials: bool = True) -> list[Mesh]:
    """Return one Mesh where all parts of a file have one kind of appearance, else one for each part. Reads DAE files, too, and
    others of trimesh, in metres where the file says its unit. See load_mesh() for the rest, and for the errors."""
    options = LoadOptions(materials)
    with errors_with_path(path):
        if Path(path).suffix.lower() in MESHES:
            model = read_mesh_file(path, options)
        else:
            context = LoadContext.from_path(path, options)
            model = typed(MeshFile(trimesh_parts.read(Path(path), context.unread), []), None, context)
            context.unread.warn(path)
        try:
            parts = [merge(model.parts)]
        except FormatError:
            parts = model.parts
        return [to_mesh(part, model.dtype) for part in parts]
