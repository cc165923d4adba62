"""Meshes and scenes from files; images come from image.py, cameras from cameras.py.

What colours mean: vertex and face colours of OBJ, PLY and 3MF files and the texels of textures of colour are sRGB on disk and
become linear; factors of materials (glTF baseColorFactor, emissiveFactor, OBJ Kd, Ke), vertex colours of glTF and textures of
data (normals, metallic, roughness) are linear already. Integers of a PLY reach up to 255, or 65535 where one is larger; floats
up to 1, which rounding may pass by 0.01, or, where one is 2 or more, up to 255; between is an error. A glTF multiplies the
texture, the factor and the vertex colours; those that differ from vertex to vertex beside a texture need lit=True, for a mesh
that is not lit has one kind of colour. An OBJ multiplies map_Kd and Kd. Elsewhere, where a file gives several looks, the first
of these is taken: texture, vertex colours, face colours, the material's colour.

lit=False, the default, takes these colours for radiance. Lights are dropped, as are normals and everything of a material but its
base colour. Alpha is dropped, but where a material of a glTF has the alphaMode MASK: the alpha of its texture, or of its
vertices (COLOR_0), times that of its factor is then the mesh's, with its alphaCutoff. Wrap and filter are those of a glTF's
sampler.

lit=True takes them for base colours:

- glTF: metallic-roughness materials with all five textures, each on its own set of texture coordinates with its own
  KHR_texture_transform, wraps and filter (mipmaps, but where the sampler says otherwise); KHR_materials_emissive_strength;
  KHR_materials_specular where its factor, and metallic, are 0: Lambertian;
  doubleSided, without which the back of faces is black; alphaMode MASK and BLEND (see Material). A material with
  KHR_materials_unlit is none, and its colours are radiance. Normals, in the world, where the file has them; else faces are
  flat. Point, spot and directional lights of KHR_lights_punctual, whose range is without end. Units are glTF's: candela, lux
  and candela a square metre.
- OBJ: Lambertian, with Ke for emission, and d and map_d cut out below 0.5. With highlights (Ks, unless illum is 0 or 1) a
  dielectric, rough by Ns; with Pr or Pm metallic-roughness. vn are its normals.
- other formats: Lambertian, with the normals of a PLY or an OFF.

What else stands in a file is said once, in one UserWarning that names it: elements, properties, keywords, extensions,
attributes and bytes that nothing reads, but those that change no picture; and of a glTF animations, morph targets, skins (the
transformation of a skinned node itself does not count), instancing, points and lines. Without lit=True not what is of materials
and lights alone. Nodes that KHR_node_visibility hides are not there.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from ..scene.mesh import Mesh
from ..scene.scene import Scene
from .formats import trimesh_parts
from .formats.geometry import typed
from .formats.part import Fault, Model, Wanted, naming
from .formats.source import Source
from .image import read_image
from .parts import MESHES, read_model
from .paths import PathLike, StoredPath
from .welding import merge, to_mesh


def load_mesh(
    path: PathLike,
    texture: PathLike | Tensor | None = None,
    materials: bool = True,
    lit: bool = False,
    dtype: torch.dtype | None = None,
) -> Mesh:
    """One Mesh from an OBJ, glTF, GLB, PLY, STL, OFF or 3MF file, in the file's units and axes.

    Vertices that the file repeats (at texture seams, for normals, in triangle soups) are welded where their positions are
    equal; unused ones are left out. Convex polygons become fans of triangles, concave ones triangles that cover them.
    Texture coordinates are indexed apart, v running up, and are there without a texture too. Where welded vertices had
    different colours, they become `corner_colors`. STL gives the shape only. What colours mean stands at the top of
    this module. Parts that look alike (all plain, all with
    vertex colours, all with face colours, all on one texture; lit, all with one material) become one Mesh. Files that the
    file names are read from its folder and below, and from nowhere else.

    texture    an image file, or (h, w, C) linear radiance, to lay on the file's texture coordinates instead of its look. Pixels
               are those that are stored, as of textures that the file names: an EXIF orientation is not applied
    materials  False leaves out the file's textures and materials, and does not miss their files
    lit        True: a mesh for lit scenes, with a material and normals; Lambertian where the file's own is left out. Lights of
               the file come by load_scene
    dtype      torch.float32 or torch.float64, of all tensors of the mesh. None: float64 where float32 would move vertices by
               more than a millionth of the extent, as it does in coordinates of a map; else float32. Vertices are welded
               before they are rounded to less than that, which a warning tells

    Raises FileNotFoundError (the file, or one that it names), ValueError (another kind of file, damaged, without
    triangles, bad indices or positions, or parts that do not look alike: use load_scene), TypeError, or ImportError
    without trimesh, or without mapbox_earcut where a file has concave faces with more than four corners.
    """
    wanted = Wanted(materials and texture is None, _checked_lit(lit), dtype=_checked_dtype(dtype))
    with naming(path):
        model = read_model(path, wanted)
        parts = model.parts
        if texture is not None:
            image = texture if isinstance(texture, Tensor) else read_image(StoredPath(texture), channels=3)
            parts = [part._replace(colors=None, face_colors=None, texture=image) for part in parts]
        return to_mesh(merge(parts), model.dtype)


def load_scene(path: PathLike, materials: bool = True, lit: bool = False, dtype: torch.dtype | None = None) -> Scene:
    """A Scene with one Mesh for each part of a file: a primitive at a node of a glTF, a material in an object of an
    OBJ, a solid of an STL, an item of a 3MF. Transformations are applied to the vertices.

    lit   True: with materials, normals and the lights of the file; without lights, one that has none is black

    See load_mesh for everything else, and for the errors.
    """
    wanted = Wanted(materials, _checked_lit(lit), split=True, dtype=_checked_dtype(dtype))
    with naming(path):
        model = read_model(path, wanted)
        return Scene([to_mesh(part, model.dtype) for part in model.parts], lights=model.lights)


def load_parts(path: PathLike, materials: bool = True) -> list[Mesh]:
    """Return one Mesh of a file whose parts have one kind of look, else one for each of them. Reads DAE files, too, and others
    of trimesh, in metres where the file says its unit. See load_mesh for the rest, and for the errors."""
    wanted = Wanted(materials)
    with naming(path):
        if Path(path).suffix.lower() in MESHES:
            model = read_model(path, wanted)
        else:
            source = Source.of(path, wanted)
            model = typed(Model(trimesh_parts.read(Path(path), source.unsupported), []), None, source)
            source.unsupported.say(path)
        try:
            parts = [merge(model.parts)]
        except Fault:
            parts = model.parts
        return [to_mesh(part, model.dtype) for part in parts]


def _checked_lit(lit: object) -> bool:
    if not isinstance(lit, bool):
        raise TypeError(f"lit: expected True or False, got {type(lit).__name__} ({lit!r})")
    return lit


def _checked_dtype(dtype: torch.dtype | None) -> torch.dtype | None:
    if dtype not in (None, torch.float32, torch.float64):
        raise TypeError(f"dtype: expected torch.float32, torch.float64 or None, got {dtype!r}")
    return dtype
