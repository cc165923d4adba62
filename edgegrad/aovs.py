"""render_aovs(): several channels of a scene from the samples of one image, differentiable (arbitrary output variables).

Each channel is one number of the surface points that the rays find, and a pixel is its filtered sum, as the image is one of
radiance. Channels that follow from vertices and camera are made here, by torch operations, so their derivatives are autograd's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .camera.camera import Camera
from .kernel.autograd import faces_at_centers, render_image
from .kernel.flat import image_dtype
from .kernel.request import Channels, Request, check_camera, make_request
from .light.lit_operator import lit_image
from .light.radiance import Lighting
from .light.unused_options import warn_of_unused
from .sampling import Sampling, check_sampling, drawn_seed
from .scene.mesh import Mesh
from .scene.rows import areas, rows_of, unit
from .scene.scene import Scene, as_scene
from .scene.tree import savable

IDS = ("mesh_id", "face_id")
# The kernel has them in this order (csrc/scene/scene.h).
AOVS = ("image", "alpha", "position", "depth", "shading_normal", "normal", "barycentrics", "uv", *IDS)
CONSTANT = ("alpha", "normal")  # over a face


def render_aovs(
    scene: Scene | Mesh,
    camera: Camera,
    aovs: Sequence[str],
    spp: int = 16,
    seed: int | None = None,
    *,
    filter: str = "box",
    visibility: bool = True,
    shadows: bool = True,
    bounces: int = 1,
    sampling: Sampling | None = None,
    generator: torch.Generator | None = None,
) -> dict[str, Tensor]:
    """Render channels of a scene (arbitrary output variables), all from the same samples.

    A pixel holds the filtered sum over its samples, with zero where a sample hits nothing (the image: its background): values
    are premultiplied with alpha. Where a surface ends within a pixel, or two meet, `depth / alpha` is the mean depth of what is
    seen there, and a mean normal is shorter than 1. Ids come from the one ray through the centre.

    All but the ids are differentiable, as render() is, in every tensor of scene and camera that they depend on. That includes
    what moves at silhouettes, and at the creases where a channel jumps: of `normal` at all edges that are not flat, of
    `barycentrics` at all edges. Channels have the dtype of the image. Raises what render() raises, and ValueError for a name
    that is unknown or given twice, and for "uv" of a mesh without uvs.

    Parameters
    ----------
    scene, camera, spp, seed, filter, visibility, shadows, bounces, sampling, generator
        As of render().
    aovs : sequence of str
        Names, each once, in any order, of channels with c numbers:

        - image (C): render()'s, to the bit.
        - alpha (1): the share of the pixel that is covered, the soft mask for silhouette losses.
        - depth (1): along the optical axis, +Z of the camera, in world units; not the distance from the eye.
        - position (3): of the surface point, world coordinates.
        - normal (3): of the face, world axes, length 1, on the side from which its corners run anticlockwise.
        - shading_normal (3): interpolated from the vertices and given the length 1 at each point, on that side; at a vertex the
          mean of the faces around it by area. Vertices with an index of their own keep an edge sharp.
        - uv (2): texture coordinates; all meshes need uvs.
        - barycentrics (3): weights of the face's three corners.
        - mesh_id (1): int64, place in scene.meshes of what is seen through the pixel's centre; −1: nothing.
        - face_id (1): int64, row of that mesh's faces; −1: nothing.

    Returns
    -------
    dict of str to Tensor
        (H, W, c) each, or (B, H, W, c) for a batch of cameras.
    """
    names = check_aovs(aovs)
    scene = as_scene(scene)
    check_camera(camera)
    sampling, drawn = check_sampling(sampling), drawn_seed(seed, generator)
    lighting = Lighting.from_options(shadows, bounces, sampling)
    if "image" in names:
        warn_of_unused(scene, False, lighting, sampling)
    if "uv" in names:
        _check_uvs(scene)
    options: dict[str, Any] = {"filter": filter, "visibility": visibility, "sampling": sampling}
    batched, device = camera.batch is not None, scene.meshes[0].verts.device
    found: dict[str, Tensor] = {}
    shaded = scene.is_shaded and "image" in names
    if shaded:
        scene, camera = savable(scene), savable(camera)
        request = make_request(scene, camera, spp, drawn, **options)
        found["image"] = lit_image(lighting, scene, camera, request)
        if names == ["image"]:
            return found
    radiance = "image" in names and not shaded
    request = make_request(
        scene if radiance else _without_radiance(scene), camera, spp, drawn, **options, all_uvs="uv" in names
    )
    if any(name in IDS for name in names):
        found |= {name: ids.to(device) for name, ids in _ids(scene, faces_at_centers(request, batched)).items()}
    rendered = [name for name in names if name not in (*IDS, *found)]
    if rendered:
        image = render_image(with_channels(request, rendered), batched).to(device)
        found |= by_name(scene, rendered, image)
    return {name: found[name] for name in names}


def aovs_request(scene: Scene, camera: Camera, aovs: Sequence[str], spp: int, seed: int) -> Request:
    """Return the kernel's request for channels that it makes alone: no ids, and of a scene that is lit no image."""
    radiance = "image" in aovs
    request = make_request(scene if radiance else _without_radiance(scene), camera, spp, seed, all_uvs="uv" in aovs)
    return with_channels(request, aovs)


def by_name(scene: Scene, aovs: Sequence[str], image: Tensor) -> dict[str, Tensor]:
    """Return the parts (…, c) of the kernel's image for with_channels()."""
    rendered = [name for name in AOVS if name in aovs]
    widths = [{"image": scene.channels, "alpha": 1, "depth": 1, "uv": 2}.get(n, 3) for n in rendered]
    return dict(zip(rendered, image.split(widths, dim=-1), strict=True))


def check_aovs(aovs: Sequence[str]) -> list[str]:
    if isinstance(aovs, str) or not isinstance(aovs, Sequence):
        raise TypeError(f'aovs: expected a list of names, such as ["image", "alpha"], got {aovs!r}')
    if not aovs:
        raise ValueError(f"aovs: expected at least one of {', '.join(AOVS)}, got none")
    for i, name in enumerate(aovs):
        if name not in AOVS:
            raise ValueError(f"aovs: expected names among {', '.join(AOVS)}, got {name!r}")
        if name in aovs[:i]:
            raise ValueError(f"aovs: expected each name once, got {name!r} twice")
    return list(aovs)


def _check_uvs(scene: Scene) -> None:
    for i, mesh in enumerate(scene.meshes):
        if mesh.uvs is None:
            raise ValueError(
                f"aovs: expected uvs of all meshes for 'uv', got none of meshes[{i}]; "
                "give it uvs and uv_faces, or leave 'uv' out"
            )


def _without_radiance(scene: Scene) -> Scene:
    """Return the surfaces with one channel of radiance that nobody sees, in the image's dtype."""
    dtype = image_dtype(scene)

    def bare(mesh: Mesh) -> Mesh:
        colors = mesh.verts.detach().new_zeros((len(mesh.verts), 1), dtype=dtype)
        return mesh.replace(colors=colors, uvs=mesh.uvs, uv_faces=mesh.uv_faces, material=None)

    return Scene([bare(mesh) for mesh in scene.meshes])


def with_channels(request: Request, names: Sequence[str]) -> Request:
    """Return the request of an image with these channels, in the order of AOVS; so are those of vertices: position, depth,
    normal."""
    if list(names) == ["image"]:
        return request
    flat, camera = request.scene, request.camera
    if "image" not in names:
        flat = flat._replace(colors=flat.colors[:, :0], texels=flat.texels[:, :0], background=flat.background[..., :0])
    faces = flat.faces.long()
    across = areas(rows_of(flat.verts, faces)) if "normal" in names or "shading_normal" in names else flat.verts
    of_vertices = []
    if "position" in names:
        of_vertices.append(flat.verts.expand(request.cameras, -1, -1))
    if "depth" in names:
        axis = camera.world_to_camera[:, 2]  # (B, 4)
        of_vertices.append((axis[:, :3] @ flat.verts.T + axis[:, 3:])[..., None])
    normals = -1
    if "shading_normal" in names:
        normals = sum(part.shape[-1] for part in of_vertices)
        around = flat.verts.new_zeros(flat.verts.shape)
        for corner in range(3):
            around = around.index_add(0, faces[:, corner], across)
        of_vertices.append(unit(around).expand(request.cameras, -1, -1))
    channels = Channels(
        "alpha" in names,
        torch.cat(of_vertices, -1).contiguous() if of_vertices else request.auxiliary.vertex_attributes,
        normals,
        unit(across) if "normal" in names else request.auxiliary.face_attributes,
        "barycentrics" in names,
        "uv" in names,
    )
    width = channels.alpha + channels.vertex_attributes.shape[-1] + channels.face_attributes.shape[-1]
    width += 3 * channels.barycentrics + 2 * channels.uv
    background = torch.nn.functional.pad(flat.background, (0, width))
    vary = any(name not in CONSTANT for name in names if name != "image")
    vary = vary or ("image" in names and request.gradient.channels_vary)
    return request._replace(
        scene=flat._replace(background=background),
        auxiliary=channels,
        gradient=request.gradient._replace(channels_vary=vary),
    )


def _ids(scene: Scene, face: Tensor) -> dict[str, Tensor]:
    """Return ids of faces (…, H, W) as the flat scene counts them."""
    ends = torch.tensor([len(mesh.faces) for mesh in scene.meshes], device="cpu").cumsum(0)
    face = face.long()[..., None]
    mesh = torch.bucketize(face, ends, right=True)
    first = torch.nn.functional.pad(ends, (1, 0))[mesh]
    return {"mesh_id": torch.where(face < 0, -1, mesh), "face_id": torch.where(face < 0, -1, face - first)}
