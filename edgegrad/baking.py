"""Textures from other knowledge of a surface: another mesh, a function of its points, or pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm import tqdm

from . import raster
from .camera.camera import Camera
from .check import as_tensor, check_choice, check_finite, check_float, check_int, check_positive, check_shape
from .optional import require
from .points.rays import trace
from .sampling import drawn_seed
from .scene.appearance import OnMesh, coordinates
from .scene.mesh import Mesh
from .scene.mikktspace import Fans
from .scene.nearest import NearestPoints, SurfaceIndex
from .scene.scene import Scene, as_scene
from .warnings import warn

BAKED = ("color", "normal", "normal_map", "visibility")
FLAT_NORMAL = (0.5, 0.5, 1.0)  # of a normal map that bends nothing
RAYS_AT_ONCE = 1 << 20  # rays
REACH = 0.05  # of the diagonal of a mesh's box: how far rays look for the other surface
UV_ROUNDING = 1e-4  # of texture coordinates beyond the unit square, by rounding
CONTACT = 1e-4  # of a distance: what lies so close is the surface itself


class SurfacePoints(NamedTuple):
    """N points of a mesh, one for each texel that it uses: the argument of a function for `bake`.

    Attributes
    ----------
    position : (N, 3) float64
    normal : (N, 3) float64, of length 1
        The mesh's own where it has normals, else the faces'.
    face : (N,) int64
    barycentrics : (N, 3) float64
    uv : (N, 2) float64
    """

    position: Tensor
    normal: Tensor
    face: Tensor
    barycentrics: Tensor
    uv: Tensor


def bake(
    mesh: Mesh,
    source: Mesh | Scene | Callable[[SurfacePoints], Tensor],
    size: int | tuple[int, int] = 512,
    *,
    what: str = "color",
    by: str = "rays",
    reach: float | None = None,
    rays: int = 64,
    margin: int | None = 4,
    seed: int | None = None,
    progress: bool = True,
) -> Tensor:
    """Return a texture (h, w, C) for a mesh, of what another surface has where the two lie on each other.

    It is for `mesh.replace(texture=…)`: row 0 on top. It has no gradient. Nearest points and margins need SciPy
    (`pip install 'edgegrad[fit]'`), else ImportError; TypeError and ValueError name a wrong argument.

    Parameters
    ----------
    mesh : Mesh
        With texture coordinates that do not overlap, as unwrap() makes them; where they do, a warning counts the texels.
    source : Mesh, Scene or function
        The other surface, or a function of SurfacePoints of `mesh` that returns (N, C).
    size : int or (h, w), default 512
        Texels.
    what : "color", "normal", "normal_map" or "visibility", default "color"
        "color": its colours, or base colours where it is lit. "normal": its normals (C = 3) in world coordinates, of length 1.
        "normal_map": these in the tangent frames of `mesh`, as Material(normal_map=…) and glTF take them: numbers from 0 to 1,
        with MikkTSpace's frames where `mesh` has normals. "visibility" (C = 1): the share of the sky above a point of `mesh`,
        weighed by the cosine, that the source does not cover.
    by : "rays" or "nearest", default "rays"
        "rays" go along the normals of `mesh`, from outside, as far as `reach` on both sides. Where these meet nothing, and
        with "nearest" everywhere, it is the source's nearest point.
    reach : float, world units, default a twentieth of the diagonal of the mesh's box
    rays : int, default 64
        Rays for each texel, of visibility.
    margin : int or None, default 4
        Texels around charts that take the colour of the nearest texel within, because bilinear look-ups reach beyond seams;
        None: all others. The rest is zero, of a normal map the flat (½, ½, 1).
    seed : int, optional
        Of the directions; by default torch's generator draws one.
    progress : bool, default True
        Whether a bar is shown.
    """
    _check_mesh(mesh)
    shape = _shape(size)
    check_choice("what", what, BAKED)
    if by not in ("rays", "nearest"):
        raise ValueError(f"by: expected 'rays' or 'nearest', got {by!r}")
    check_int("rays", rays, 1, 1 << 16)
    mesh = mesh.detach().to("cpu")
    texels = _Texels.of(mesh, shape)
    empty = FLAT_NORMAL if what == "normal_map" else 0.0
    if isinstance(source, (Mesh, Scene)):
        scene = as_scene(source).detach().to("cpu")
        low, high = mesh.verts.double().aminmax(dim=0)
        diagonal = float((high - low).norm())
        reach = REACH * diagonal if reach is None else check_positive("reach", reach, least=1e-30, most=1e30)
        if what == "visibility":
            values = _visibility(texels.points, scene, CONTACT * diagonal, rays, int(drawn_seed(seed)), progress)
        else:
            values = _of_surface(scene, _matched(texels.points, scene, by, reach), what)
            if what == "normal_map":
                values = _in_tangent_frames(mesh, texels.points, values)
    elif callable(source):
        if what != "color":
            raise ValueError(f"what: expected 'color' with a function, which says itself what it gives, got {what!r}")
        values = as_tensor("source", source(texels.points), floating=True).detach().cpu()
        check_shape("source", values, (len(texels.points.face), "C"), fix="a row for each point")
        check_finite("source", values := values.float())
    else:
        raise TypeError(f"source: expected a Mesh, a Scene or a function, got {type(source).__name__}")
    return texels.texture(values.float(), margin, empty=empty)


def bake_pictures(
    mesh: Mesh,
    images: Sequence[Tensor],
    cameras: Sequence[Camera],
    size: int | tuple[int, int] = 512,
    *,
    masks: Sequence[Tensor] | None = None,
) -> Tensor:
    """Return a texture (h, w, C) for a mesh, from pictures of it; without a gradient.

    Each texel is the mean over the pictures that see it, weighed by the square of the cosine at which they do. It is a start
    for fit_texture(), which finds what pictures say together: `fit_texture(mesh.replace(texture=…), …)`. Texels that no
    picture sees take the nearest colour. Errors are those of bake().

    Parameters
    ----------
    mesh : Mesh
        With texture coordinates that do not overlap, as unwrap() makes them.
    images : sequence of (H, W, C)
        Linear radiance.
    cameras : sequence of Camera, one for each picture
    size : int or (h, w), default 512
        Texels.
    masks : sequence of (H, W) or (H, W, 1)
        1 where a picture shows the mesh; pixels below ½ do not count.
    """
    _check_mesh(mesh)
    if isinstance(cameras, Camera):
        raise TypeError("cameras: expected a list of cameras, one for each picture, got a Camera; use [camera]")
    for k, camera in enumerate(cameras):
        if not isinstance(camera, Camera):
            raise TypeError(f"cameras[{k}]: expected a Camera, got {type(camera).__name__}; images come before cameras")
    if len(cameras) != len(images) or not len(cameras):
        raise ValueError(
            f"images: expected one for each of {len(cameras)} cameras, and at least one, got {len(images)}"
        )
    if masks is not None and len(masks) != len(images):
        raise ValueError(f"masks: expected one for each of {len(images)} pictures, got {len(masks)}")
    mesh = mesh.detach().to("cpu")
    texels = _Texels.of(mesh, _shape(size))
    points = texels.points
    pictures = [
        _picture(f"images[{k}]", image, camera) for k, (camera, image) in enumerate(zip(cameras, images, strict=True))
    ]
    channels = pictures[0].shape[2]
    total, weight = (
        torch.zeros(len(points.face), channels, dtype=torch.float64),
        torch.zeros(len(points.face), 1).double(),
    )
    for k, (camera, image) in enumerate(zip(cameras, pictures, strict=True)):
        if camera.batch is not None:
            raise ValueError(f"cameras[{k}]: expected one camera, got a batch of {camera.batch}; give them one by one")
        check_shape(f"images[{k}]", image, (*camera.size, channels))
        share = _seen(mesh, points, camera.detach().to("cpu"))
        x = torch.nan_to_num(camera.detach().to("cpu").project(points.position).double(), nan=-1.0)
        if masks is not None:
            mask = as_tensor(f"masks[{k}]", masks[k], floating=True).detach().cpu().double()
            mask = mask if mask.dim() == 3 else mask[..., None]
            check_shape(f"masks[{k}]", mask, (*camera.size, 1))
            share = share * (_at(mask, x) >= 0.5)
        H, W = camera.size
        share = share * ((x >= 0) & (x <= x.new_tensor([W, H]))).all(1, keepdim=True)
        total, weight = total + share * _at(image, x), weight + share
    known = weight[:, 0] > 0
    if not bool(known.any()):
        raise ValueError("cameras: expected some that see the mesh, got none; look at where they are with eg.viewer")
    return texels.texture((total[known] / weight[known]).float(), None, known)


class _Texels(NamedTuple):
    """Texels whose centres lie on a face."""

    shape: tuple[int, int]
    place: Tensor  # (N,) int64, row by row, row 0 on top
    points: SurfacePoints

    @classmethod
    def of(cls, mesh: Mesh, shape: tuple[int, int]) -> _Texels:
        assert mesh.uvs is not None and mesh.uv_faces is not None
        used = mesh.uvs.double()[mesh.uv_faces.long()]
        if bool(((used < -UV_ROUNDING) | (used > 1 + UV_ROUNDING)).any()):
            low, high = (round(float(x), 3) for x in used.aminmax())
            raise ValueError(
                f"mesh: expected texture coordinates in the unit square, got some from {low} to {high}; use unwrap(mesh)"
            )
        # Each face at a depth of its own, in their order: a second layer is where two lie on the same texel.
        count = len(used)
        depth = ((2 * torch.arange(count, dtype=torch.float64) + 1) / count - 1).view(-1, 1, 1).expand(-1, 3, 1)
        pos = torch.cat([2 * used - 1, depth, torch.ones_like(depth)], 2).view(1, 3 * count, 4)
        corners = torch.arange(3 * count).view(count, 3)
        with raster.DepthPeeler(raster.RasterizeGLContext(output_db=False), pos, corners, shape) as layers:
            rast, beneath = (layers.rasterize_next_layer()[0][0].flip(0).reshape(-1, 4) for _ in range(2))
        _warn_of_overlaps(rast[:, 3].long(), beneath[:, 3].long())
        place = (rast[:, 3] > 0).nonzero()[:, 0]
        if len(place) == 0:
            raise ValueError(
                f"size: expected texels whose centres lie on faces, got none of {shape}; give a larger size"
            )
        u, v, _, number = rast[place].unbind(1)
        b, face = torch.stack([u, v, 1 - u - v], 1), number.long() - 1
        return cls(shape, place, points_of(mesh, face, b))

    def texture(
        self, values: Tensor, margin: int | None, known: Tensor | None = None, empty: float | tuple[float, ...] = 0.0
    ) -> Tensor:
        """Return a texture (h, w, C) of the values of those that are known; beyond the margin it is `empty`."""
        h, w = self.shape
        place = self.place if known is None else self.place[known]
        left = torch.tensor(empty)
        out = left.expand(h * w, values.shape[1]).clone()
        out[place] = values
        if margin == 0:
            return out.view(h, w, -1)
        unused = np.ones(h * w, bool)
        unused[place.numpy()] = False
        ndimage = require("scipy.ndimage", "edgegrad[fit]", "a margin around charts")
        distance, (rows, columns) = ndimage.distance_transform_edt(unused.reshape(h, w), return_indices=True)
        near = out.view(h, w, -1)[torch.from_numpy(rows).long(), torch.from_numpy(columns).long()]
        if margin is None:
            return near
        check_int("margin", margin, 0, 1 << 14)
        return torch.where(torch.from_numpy(distance <= margin)[..., None], near, left)


def points_of(mesh: Mesh, face: Tensor, b: Tensor) -> SurfacePoints:
    """Return points of one mesh, at barycentrics (N, 3)."""

    def at(rows: Tensor, index: Tensor) -> Tensor:
        return (b[:, :, None] * rows.double()[index[face].long()]).sum(1)

    corners = mesh.verts.double()[mesh.faces[face].long()]
    flat = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if mesh.normals is not None:
        index = mesh.faces if mesh.normal_faces is None else mesh.normal_faces
        smooth = at(mesh.normals, index)
        flat = torch.where(smooth.norm(dim=1, keepdim=True) > 0, smooth, flat)
    uv = torch.zeros(len(face), 2, dtype=torch.float64)
    if mesh.uvs is not None and mesh.uv_faces is not None:
        uv = at(mesh.uvs, mesh.uv_faces)
    return SurfacePoints(at(mesh.verts, mesh.faces), F.normalize(flat, dim=1), face, b, uv)


def _matched(points: SurfacePoints, scene: Scene, by: str, reach: float) -> NearestPoints:
    """Return the source's points that belong to points of the mesh."""
    count = len(points.face)
    face, b = np.full(count, -1), np.zeros((count, 3))
    if by == "rays":
        hits = trace(scene, points.position + reach * points.normal, -2 * reach * points.normal)
        near = hits.depth.detach() <= 1
        rows = hits.ray[near].numpy()
        face[rows], b[rows] = hits.face[near].numpy(), hits.barycentrics[near].detach().double().numpy()
    lost = face < 0
    if lost.any():
        found = SurfaceIndex(scene).nearest(points.position[torch.from_numpy(lost)].numpy())
        face[lost], b[lost] = found.face, found.b
    return NearestPoints(np.zeros((count, 3)), face, b)


def _of_surface(scene: Scene, places: NearestPoints, what: str) -> Tensor:
    if what == "color":
        colors = SurfaceIndex(scene).colors(places)
        if colors is None:
            raise ValueError(
                "source: expected colours, a texture or a material, got none; give it some, or what='normal'"
            )
        return colors
    out = torch.zeros(len(places.face), 3, dtype=torch.float64)
    first = 0
    for mesh in scene.meshes:
        rows = torch.from_numpy((places.face >= first) & (places.face < first + len(mesh.faces)))
        own = torch.from_numpy(places.face)[rows] - first
        out[rows] = points_of(mesh, own, torch.from_numpy(places.b)[rows]).normal
        first += len(mesh.faces)
    return out


def _in_tangent_frames(mesh: Mesh, points: SurfacePoints, normal: Tensor) -> Tensor:
    """Return unit normals (N, 3) as a normal map of the mesh writes them, from 0 to 1, on the outer side of its own."""
    at = OnMesh(mesh, points.face, points.barycentrics, tangents=lambda: _tangents(mesh))
    corners = at.corners()
    flat = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    n = at.smooth_normal(F.normalize(flat, dim=1))
    frame = at.tangent_frame(n, None)
    along = torch.stack([(normal * axis).sum(1) for axis in (frame.tangent, frame.bitangent, n)], 1)
    along[:, 2].clamp_(min=0)  # glTF has no others
    along = torch.where(frame.there & (along.norm(dim=1, keepdim=True) > 0), along, along.new_tensor([0.0, 0, 1]))
    return 0.5 + 0.5 * F.normalize(along, dim=1)


def _tangents(mesh: Mesh) -> Tensor:
    """Return tangents (F, 3, 4) at the corners of a mesh with normals."""
    assert mesh.normals is not None
    uvs, uv_faces = coordinates(mesh, None)
    given = (
        (mesh.verts, mesh.faces),
        (mesh.normals, mesh.faces if mesh.normal_faces is None else mesh.normal_faces),
        (uvs, uv_faces),
    )
    fans = Fans.from_corners(*((values.numpy(), index.numpy()) for values, index in given))
    return fans.tangents(*(values[index.long()] for values, index in given))


def _visibility(points: SurfacePoints, scene: Scene, aside: float, rays: int, seed: int, progress: bool) -> Tensor:
    """Return the share (N, 1) of directions, distributed as the cosine to the normal, that meet nothing."""
    count = len(points.face)
    generator = torch.Generator().manual_seed(seed)
    seen = torch.zeros(count, 1, dtype=torch.float64)
    normal, origin = points.normal, points.position + aside * points.normal
    # A point drawn on the unit sphere around the normal's end is a direction with this density (Shirley et al. 2019).
    parts = max(1, -(-count * rays // RAYS_AT_ONCE))
    for k in tqdm(range(parts), desc="visibility", disable=not progress):
        first, end = k * count // parts, (k + 1) * count // parts
        on_sphere = F.normalize(torch.randn(end - first, rays, 3, dtype=torch.float64, generator=generator), dim=2)
        directions = normal[first:end, None] + (1 - 1e-9) * on_sphere  # of which none is zero
        origins = origin[first:end, None].expand(-1, rays, -1)
        hits = trace(scene, origins.reshape(-1, 3), directions.reshape(-1, 3))
        covered = torch.bincount(hits.ray // rays, minlength=end - first)
        seen[first:end, 0] = 1 - covered.double() / rays
    return seen


def _seen(mesh: Mesh, points: SurfacePoints, camera: Camera) -> Tensor:
    """Return the square of the cosine (N, 1) between the normal and the direction to the camera; 0 where something lies
    between."""
    pose = camera.world_to_camera.double()
    ahead = pose[2, :3]
    if camera.projection == "orthographic":
        low, high = mesh.verts.double().aminmax(dim=0)
        along = ahead.expand_as(points.position) * (2 * (high - low).norm() + 1e-30)
    else:
        along = points.position - camera.eye.double()
    hits = trace(mesh, points.position - along, along)
    first = torch.full((len(points.face),), torch.inf, dtype=torch.float64)
    first[hits.ray] = hits.depth.detach().double()
    visible = first >= 1 - CONTACT
    if camera.projection == "perspective":  # others see behind themselves too, or have no place
        visible &= (points.position @ ahead + pose[2, 3]) > 0
    cosine = -(points.normal * F.normalize(along, dim=1)).sum(1)
    return (visible * cosine.clamp(min=0) ** 2)[:, None]


def _warn_of_overlaps(first: Tensor, second: Tensor) -> None:
    """Warn of overlaps, from the numbers of faces + 1 that each texel has, and of others there; 0: none."""
    both = (second > 0) & (second != first)
    if not bool(both.any()):
        return
    faces = torch.cat([first[both], second[both]]).unique()
    warn(
        "overlapping texture coordinates",
        f"mesh: {int(both.sum())} of {int((first > 0).sum())} texels lie on two faces or more and take what the first has "
        f"({len(faces)} faces overlap, the first of them {int(faces[0]) - 1}); use unwrap(mesh) for coordinates that do not",
    )


def _picture(name: str, image: Tensor, camera: Camera) -> Tensor:
    """Return a picture (H, W, C) float64."""
    if isinstance(image, str):
        raise TypeError(f"{name}: expected a tensor, got a name; use read_image({image!r})")
    given = as_tensor(name, image)
    check_float(name, given)  # bytes would be neither linear nor from 0 to 1
    check_shape(name, given, (*camera.size, "C"))
    check_finite(name, given)
    return given.detach().cpu().double()


def _at(image: Tensor, x: Tensor) -> Tensor:
    """Interpolate (N, C) bilinearly at places (N, 2), px."""
    H, W = image.shape[:2]
    grid = (2 * x / x.new_tensor([W, H]) - 1)[None, None]
    found = F.grid_sample(image.permute(2, 0, 1)[None], grid, padding_mode="border", align_corners=False)
    return found[0, :, 0].T


def _check_mesh(mesh: Mesh) -> None:
    if not isinstance(mesh, Mesh):
        raise TypeError(f"mesh: expected a Mesh, got {type(mesh).__name__}; load one with load_mesh(path)")
    if mesh.uvs is None:
        raise ValueError("mesh: expected texture coordinates, got a mesh without; use unwrap(mesh)")


def _shape(size: int | tuple[int, int]) -> tuple[int, int]:
    both = size if isinstance(size, (tuple, list)) else (size, size)
    if len(both) != 2:
        raise ValueError(f"size: expected an int or (h, w), got {size!r}")
    return check_int("size", both[0], 1, 1 << 14), check_int("size", both[1], 1, 1 << 14)
