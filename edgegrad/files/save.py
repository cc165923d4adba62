"""Conversion to and from trimesh, and meshes and scenes into files by it.

trimesh keeps colours as 8-bit sRGB, while here they are linear; its texture coordinates belong to vertices, which are split at
seams.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..camera.camera import Camera
from ..optional import require
from ..scene.mesh import Mesh
from ..scene.scene import Scene
from ..warnings import warn
from .formats.geometry import in_double, rounding
from .formats.gltf_pack import scene_to_gltf, to_glb
from .formats.part import FormatError
from .formats.text_write import to_obj, to_off
from .formats.trimesh_parts import of_trimesh
from .image import to_bytes
from .paths import PathLike, check_suffix, replacing
from .welding import to_mesh

WRITTEN = (".ply", ".obj", ".glb", ".stl", ".off")
SCENES = (".glb", ".gltf")
CLAMPED = ("clamp", "clamp")  # an MTL clamps both coordinates or neither


def from_trimesh(given: Any) -> Mesh:
    """Return the mesh of a trimesh.Trimesh with equal vertices welded.

    It has the vertex or face colours or the texture, which are sRGB there, or the colour of its material, which is linear. It
    is float64 where float32 would move vertices by more than a millionth of the extent, else float32.

    Parameters
    ----------
    given : trimesh.Trimesh; others raise TypeError, those without faces ValueError
    """
    trimesh = require("trimesh", "trimesh", "from_trimesh")
    if isinstance(given, trimesh.Scene):
        raise TypeError("mesh: expected a trimesh.Trimesh, got a Scene; take scene.to_mesh(), or one of scene.geometry")
    if not isinstance(given, trimesh.Trimesh):
        raise TypeError(f"mesh: expected a trimesh.Trimesh, got {type(given).__name__}")
    if len(given.faces) == 0:
        raise ValueError(
            "mesh: expected a trimesh.Trimesh with faces, got one without; was it loaded from an empty file?"
        )
    try:
        part = of_trimesh(given)
        if rounding(part.verts)[1]:
            return to_mesh(in_double([part])[0], torch.float64)
        return to_mesh(part._replace(verts=part.verts.astype(np.float32)))
    except FormatError as error:
        raise ValueError(f"mesh: {error}") from error.__cause__


def to_trimesh(mesh: Mesh, faces_colored: bool = True) -> Any:
    """Return a trimesh.Trimesh of a mesh, with colours or texture as 8-bit sRGB.

    Vertices are split where texture coordinates or the colours of corners differ.

    Parameters
    ----------
    mesh : Mesh
        Of 1 or 3 channels, else ValueError; ImportError without trimesh.
    faces_colored : bool, default True
        False: colours of faces become colours of vertices, which are split for them.
    """
    trimesh = require("trimesh", "trimesh", "to_trimesh")
    _check_channels(mesh)
    faces = _array(mesh.faces)
    verts, colors = _array(mesh.verts), mesh.colors
    if mesh.texture is not None:
        assert mesh.uvs is not None and mesh.uv_faces is not None
        pairs, index = np.unique(
            np.stack([faces.reshape(-1), _array(mesh.uv_faces).reshape(-1)], 1), axis=0, return_inverse=True
        )
        pillow = require("PIL.Image", "edgegrad[files]", "saving textures")
        material = trimesh.visual.material.PBRMaterial(
            baseColorTexture=pillow.fromarray(to_bytes(mesh.texture)),
            baseColorFactor=[255] * 4,
            metallicFactor=0.0,
            roughnessFactor=1.0,
        )
        visual = trimesh.visual.TextureVisuals(uv=_array(mesh.uvs)[pairs[:, 1]], material=material)
        faces = index.reshape(-1, 3)
        return trimesh.Trimesh(verts[pairs[:, 0]], faces, visual=visual, process=False)
    if mesh.corner_colors is not None or (mesh.face_colors is not None and not faces_colored):
        given = mesh.corner_colors if mesh.face_colors is None else mesh.face_colors[:, None].expand(-1, 3, -1)
        assert given is not None
        verts, faces = verts[faces.reshape(-1)], np.arange(faces.size).reshape(-1, 3)
        colors = given.reshape(-1, given.shape[-1])
    appearance = {}
    if colors is not None:
        appearance["vertex_colors"] = to_bytes(colors)
    elif mesh.face_colors is not None:
        appearance["face_colors"] = to_bytes(mesh.face_colors)
    return trimesh.Trimesh(verts, faces, process=False, **appearance)


def save_mesh(path: PathLike, mesh: Mesh) -> None:
    """Write a mesh as PLY, OBJ, GLB, STL or OFF by the name's ending. Missing folders are made.

    A GLB holds material, normals, alpha and textures with their coordinates, wraps and filters, as
    `load_scene(path, lit=True)` reads them: factors and vertex colours in full, textures in 8 bit (colour as sRGB), clipped to
    0 … 1. Metallic, roughness and emission of vertices become their mean, because glTF has none. A Lambertian material is one
    without a highlight (KHR_materials_specular). PLY and OBJ hold colours in 8-bit sRGB, an OBJ also a texture, repeated or
    clamped, which is written next to it with its .mtl; STL and OFF hold the shape alone. Positions in PLY, STL and GLB are
    float32; those in OBJ and OFF have all digits of the mesh's type. A warning names what is left out, rounded or clipped.

    Parameters
    ----------
    path : str or Path
    mesh : Mesh

    Raises
    ------
    TypeError, ValueError, OSError, ImportError
        ValueError: another ending, or channels that are not 1 or 3. OSError: it cannot be written. ImportError: trimesh is
        missing.

    Examples
    --------
    >>> import tempfile, torch, edgegrad as eg
    >>> box = eg.shapes.box().replace(colors=torch.ones(8, 3))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     eg.save_mesh(f"{folder}/box.ply", box)
    ...     eg.load_mesh(f"{folder}/box.ply")
    Mesh(8 vertices, 12 faces, colors (8, 3), torch.float32)
    """
    file = check_suffix(path, WRITTEN)
    if not isinstance(mesh, Mesh):
        raise TypeError(f"mesh: expected a Mesh, got {type(mesh).__name__}; a Scene is for save_scene")
    _check_channels(mesh)
    kind = file.suffix.lower()[1:]
    extra_files = {}
    if kind == "glb":
        content, lost = to_glb(mesh)
    else:
        made, lost = to_trimesh(mesh, faces_colored=kind != "obj"), _left_out(mesh, kind)
        dtype = _array(mesh.verts).dtype
        if kind == "obj":
            content, extra_files = to_obj(made, dtype, file.stem, clamp=mesh.wraps == CLAMPED)
        else:
            content = to_off(made, dtype) if kind == "off" else made.export(file_type=kind)
    if kind in ("ply", "stl", "glb") and rounding(mesh.verts.detach().cpu().numpy())[1]:
        lost = [*lost, "positions beyond float32"]
    if lost:
        warn(
            f"left out of {kind}",
            f"save_mesh: {file.name} holds no {', no '.join(lost)}; "
            "torch.save(Scene(mesh).state_dict(), path) keeps all of a Mesh",
        )
    for name, data in {**extra_files, file.name: content}.items():
        with replacing(file.parent / Path(name).name) as temporary:
            temporary.write_bytes(data.encode() if isinstance(data, str) else data)


def save_scene(
    path: PathLike, scene: Scene | Mesh, cameras: Camera | Sequence[Camera] | Mapping[str, Camera] | None = None
) -> None:
    """Write a scene as GLB or glTF by the name's ending; a .gltf embeds its arrays and images. Missing folders are made.

    `load_scene(path, lit=True)` reads the meshes in their order and the lights, load_cameras(path, size) the cameras. A glTF
    has no environments, spherical harmonics, backgrounds or lenses, and no cameras whose principal point is off the middle or
    whose pixels are not square: a warning names what is left out, rounded or clipped.

    Parameters
    ----------
    path : str or Path
    scene : Scene or Mesh
        Each mesh becomes a node, with its material as save_mesh() writes it; one without a material is marked as unlit
        (KHR_materials_unlit). Directional, point and spot lights are KHR_lights_punctual. What meshes share is written once.
    cameras : Camera, a batch, a sequence, or a mapping by name, default none
        Nodes, too. Errors are those of save_mesh().
    """
    file = check_suffix(path, SCENES)
    if not isinstance(scene, Scene | Mesh):
        raise TypeError(f"scene: expected a Scene or a Mesh, got {type(scene).__name__}")
    whole = Scene([scene]) if isinstance(scene, Mesh) else scene
    if whole.channels not in (1, 3):
        raise ValueError(f"scene: expected 1 or 3 channels, got {whole.channels}; pick some")
    content, lost = scene_to_gltf(whole, _named(cameras), file.suffix.lower()[1:])
    if any(rounding(mesh.verts.detach().cpu().numpy())[1] for mesh in whole.meshes):
        lost = [*lost, "positions beyond float32"]
    if lost:
        warn(
            f"left out of {file.suffix}",
            f"save_scene: {file.name} holds no {', no '.join(lost)}; "
            "torch.save(scene.state_dict(), path) keeps all of a Scene, and save_camera() all of a camera",
        )
    with replacing(file) as temporary:
        temporary.write_bytes(content)


def _named(cameras: object) -> dict[str, Camera]:
    """Return single cameras by name, numbered where they have no names. Raises TypeError."""
    if cameras is None:
        return {}
    given = dict(cameras) if isinstance(cameras, Mapping) else None
    if given is None:
        if not isinstance(cameras, Camera | Sequence) or isinstance(cameras, str):
            raise TypeError(
                f"cameras: expected a Camera, a sequence of them, or some by name, got {type(cameras).__name__}"
            )
        given = (
            {"camera": cameras} if isinstance(cameras, Camera) else {f"camera {k}": c for k, c in enumerate(cameras)}
        )
    found = {}
    for name, camera in given.items():
        if not isinstance(camera, Camera):
            raise TypeError(f"cameras[{name!r}]: expected a Camera, got {type(camera).__name__}")
        several = camera.batch is not None
        found |= {f"{name}{f' {k}' if several else ''}": one for k, one in enumerate(camera if several else [camera])}
    return found


def _check_channels(mesh: Mesh) -> None:
    if mesh.channels not in (None, 1, 3):
        raise ValueError(f"mesh: expected 1 or 3 channels, got {mesh.channels}; pick some")


def _left_out(mesh: Mesh, kind: str) -> list[str]:
    """Return the names of what a file of this kind, other than GLB, does not hold of a mesh."""
    appearance = {"colors": mesh.colors, "face_colors": mesh.face_colors, "corner_colors": mesh.corner_colors}
    appearance["texture"] = mesh.texture
    never = {"material": mesh.material, "normals": mesh.normals, "alpha": mesh.alpha}
    never["uvs"] = mesh.uvs if mesh.texture is None or kind != "obj" else None
    found = [name for name, value in never.items() if value is not None]
    for name, value in appearance.items():
        if value is None:
            continue
        if kind in ("stl", "off") or (name == "texture" and kind != "obj"):
            found.append(name)
        elif bool((value < 0).any() | (value > 1).any()):
            found.append(f"{name} beyond 0 … 1")
    if mesh.texture is not None or mesh.alpha is not None:
        held = kind == "obj" and mesh.texture is not None and mesh.wraps == CLAMPED
        if mesh.wraps != ("repeat", "repeat") and not held:
            found.append(f"wrap {mesh.wrap!r}")
        if mesh.filter != "linear":
            found.append(f"filter {mesh.filter!r}")
    return found


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()
