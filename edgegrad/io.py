"""Meshes, scenes and cameras from files; images come from edgegrad.image.

What colours mean: vertex and face colours of OBJ and PLY files and the texels of every texture are sRGB on disk and
become linear radiance; factors of materials (glTF baseColorFactor, OBJ Kd) and vertex colours of glTF are linear
already. All become three float32 channels; lights are dropped, as are normals and everything of a material but its
base colour. A glTF multiplies the texture, the factor and the vertex colours. Elsewhere, where a file gives several
looks, the first of these is taken: texture, vertex colours, face colours, the material's colour.

Alpha is dropped, but where a material of a glTF has the alphaMode MASK: the alpha of its texture, or of its vertices
(COLOR_0), times that of its factor is then the mesh's, with its alphaCutoff. Wrap and filter are those of a glTF's sampler.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ._files import PathLike, check_readable, check_suffix, replacing
from ._parts import Fault, Part, read_parts
from .camera import Camera
from .image import linear_to_srgb, read_image, srgb_to_linear, write_image
from .mesh import Mesh
from .scene import Scene

__all__ = [
    "linear_to_srgb",
    "load_camera",
    "load_mesh",
    "load_scene",
    "read_image",
    "save_camera",
    "srgb_to_linear",
    "write_image",
]


def load_mesh(path: PathLike, texture: PathLike | Tensor | None = None, materials: bool = True) -> Mesh:
    """One Mesh from an OBJ, glTF, GLB, PLY, STL, OFF or 3MF file, in the file's units and axes.

    Vertices that the file repeats (at texture seams, for normals, in triangle soups) are welded where their float32
    positions are equal; unused ones are left out; polygons become fans of triangles. Texture coordinates are indexed
    apart, v running up. Where welded vertices had different colours, they become `corner_colors`. OFF and 3MF give
    the shape only. What colours mean stands at the top of this module. Parts that look alike (all plain, all with
    vertex colours, all with face colours, all on one texture) become one Mesh. Files that the file names are read
    from its folder and below, and from nowhere else.

    texture    an image file, or (h, w, C) linear radiance, to lay on the file's texture coordinates instead of its look
    materials  False leaves out the file's textures and material colours, and does not miss their files

    Raises FileNotFoundError (the file, or one that it names), ValueError (another kind of file, damaged, without
    triangles, bad indices or positions, or parts that do not look alike: use load_scene), TypeError, or ImportError
    without trimesh.
    """
    with _naming(path):
        parts = read_parts(path, materials and texture is None, unwrap=texture is not None)
        if texture is not None:
            image = texture if isinstance(texture, Tensor) else read_image(texture, channels=3)
            parts = [part._replace(colors=None, face_colors=None, texture=image) for part in parts]
        return _to_mesh(_merge(parts))


def load_scene(path: PathLike, materials: bool = True) -> Scene:
    """A Scene with one Mesh for each part of a file: a primitive at a node of a glTF, a material in an object of an
    OBJ, a solid of an STL, an item of a 3MF. Transformations are applied to the vertices.

    See load_mesh for everything else, and for the errors.
    """
    with _naming(path):
        return Scene([_to_mesh(part) for part in read_parts(path, materials, split=True)])


def save_camera(path: PathLike, camera: Camera) -> None:
    """Writes a camera, or a batch, as JSON: world_to_camera, K (rows, in pixels), size [H, W], projection, and
    distortion if it has any.

    Raises ValueError (a name that does not end in .json), TypeError or FileNotFoundError (no such folder).
    """
    file = check_suffix(path, (".json",))
    if not isinstance(camera, Camera):
        raise TypeError(f"camera: expected a Camera, got {type(camera).__name__}")
    fields = {
        "world_to_camera": camera.world_to_camera.tolist(),
        "K": camera.K.tolist(),
        "size": list(camera.size),
        "projection": camera.projection,
    }
    if camera.distortion is not None:
        fields["distortion"] = camera.distortion.tolist()
    with replacing(file) as temporary:
        temporary.write_text(json.dumps(fields, indent=1) + "\n", encoding="utf-8")


def load_camera(path: PathLike, dtype: torch.dtype = torch.float32) -> Camera:
    """A camera as save_camera writes it; "projection" may be left out (perspective), and "distortion" (none).

    Raises FileNotFoundError, or ValueError that names the file and the key.
    """
    file = check_readable(path, (".json",))
    known = {"world_to_camera", "K", "size", "projection", "distortion"}
    try:
        fields = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(fields, dict):
            raise ValueError(f"expected a JSON object with {', '.join(sorted(known))}, got {type(fields).__name__}")
        for key in sorted(known - {"projection", "distortion"} - set(fields)):
            raise ValueError(f"{key}: expected this key, got only {', '.join(sorted(fields)) or 'an empty object'}")
        for key in sorted(set(fields) - known):
            raise ValueError(f"{key}: expected only the keys {', '.join(sorted(known))}; remove it")
        for key in ("world_to_camera", "K", "distortion")[: 3 if "distortion" in fields else 2]:
            try:
                fields[key] = torch.tensor(fields[key], dtype=dtype)
            except (TypeError, ValueError) as error:
                raise ValueError(f"{key}: expected rows of numbers ({error})") from error
        if not isinstance(fields["size"], list):
            raise ValueError(f"size: expected [height, width], got {fields['size']!r}")
        return Camera(**fields)
    except (TypeError, ValueError) as error:  # what json and UTF-8 raise are ValueErrors too
        raise ValueError(f"{path}: {error}") from error


@contextmanager
def _naming(path: PathLike) -> Iterator[None]:
    """Makes every fault of a file an error that names the file."""
    try:
        yield
    except Fault as fault:
        raise ValueError(f"{path}: {fault}") from fault.__cause__
    except ValueError as error:
        if str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: {error}") from error


def _look_of(part: Part) -> tuple[object, ...]:
    """What parts that become one mesh have in common."""
    kinds = part.colors is None, part.face_colors is None, id(part.texture), id(part.alpha)
    return *kinds, part.cutoff if part.alpha is not None else None, part.wrap, part.filter


def _merge(parts: list[Part]) -> Part:
    """One part from parts that look alike. Raises Fault when they do not."""
    if len(parts) == 1:
        return parts[0]
    if len({_look_of(part) for part in parts}) > 1:
        names = ", ".join(repr(part.name) for part in parts[:5]) + (", …" if len(parts) > 5 else "")
        raise Fault(
            f"expected one mesh, got {len(parts)} parts ({names}) with different textures or kinds of colour; "
            "use load_scene, which keeps them apart, or materials=False"
        )

    def joined(name: str) -> list:
        found = [getattr(part, name) for part in parts]
        return [] if any(value is None for value in found) else found

    start = np.cumsum([0] + [len(part.verts) for part in parts])
    return Part(
        name=parts[0].name,
        verts=np.concatenate(joined("verts")),
        faces=np.concatenate([part.faces + n for part, n in zip(parts, start, strict=False)]),
        uvs=np.concatenate(joined("uvs")) if joined("uvs") else None,
        texture=parts[0].texture,
        colors=torch.cat(joined("colors")) if joined("colors") else None,
        face_colors=torch.cat(joined("face_colors")) if joined("face_colors") else None,
        alpha=parts[0].alpha,
        cutoff=parts[0].cutoff,
        wrap=parts[0].wrap,
        filter=parts[0].filter,
    )


def _to_mesh(part: Part) -> Mesh:
    verts, faces = _weld(part.verts, part.faces)
    images: dict[str, Any] = {}
    if part.texture is not None or part.alpha is not None:
        if part.uvs is None:
            raise Fault(f"part {part.name!r}: expected texture coordinates for its texture, got none; unwrap the mesh")
        uvs, uv_faces = _weld(part.uvs, part.faces)
        wrap = part.wrap[0] if part.wrap[0] == part.wrap[1] else part.wrap
        images = {"uvs": uvs, "uv_faces": uv_faces, "texture": part.texture, "wrap": wrap, "filter": part.filter}
    if part.alpha is not None:
        images |= {"alpha": part.alpha, "alpha_cutoff": part.cutoff}
    if part.colors is None or part.texture is not None:
        return Mesh(verts, faces, face_colors=part.face_colors if part.texture is None else None, **images)
    corners = part.colors[torch.from_numpy(part.faces)]
    colors = corners.new_zeros(len(verts), 3)
    colors[faces] = corners
    if torch.equal(colors[faces], corners):
        return Mesh(verts, faces, colors=colors, **images)
    return Mesh(verts, faces, corner_colors=corners, **images)


def _weld(rows: np.ndarray, index: np.ndarray) -> tuple[Tensor, Tensor]:
    """The rows that `index` (F, 3) uses, equal ones once, in the order of the file; and the index into them."""
    used, flat = np.unique(index, return_inverse=True)
    rows = rows[used]
    order = np.lexsort(rows.T)
    starts = np.concatenate([[True], (rows[order[1:]] != rows[order[:-1]]).any(1)])
    first = np.empty(len(rows), np.int64)
    first[order] = order[starts][np.cumsum(starts) - 1]  # the sort is stable: a group starts with its first row
    kept, renumbered = np.unique(first, return_inverse=True)
    faces = renumbered.reshape(-1)[flat.reshape(-1)].reshape(-1, 3).astype(np.int64)
    return torch.from_numpy(rows[kept]), torch.from_numpy(faces)
