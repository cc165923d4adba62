"""Parts of a renderer to build others from: rays, the hits of an image, samples inside faces and on edges.

render(…, shader=fn) is made of them:

    primary = primary_hits(scene, camera)
    with torch.no_grad():
        image = primary.image(fn(primary.hits), background)
    inside = surface_samples(primary)
    image = image + zero_of(inside.image(fn(inside.hits)))       # x − x.detach(): the gradient inside faces
    edges = edge_samples(primary)
    with torch.no_grad():
        jump = edges.jump(fn(edges.hits))
    image = attach_boundary(image, edges, jump, background)      # the gradient of what moves at silhouettes

Or with less: the image of primary_hits with a graph has the gradient inside faces by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor

from ..camera.camera import Camera
from ..check import as_tensor, check_finite, check_float, check_positive_int, check_shape
from ..kernel.derivatives import moves
from ..kernel.operators import camera_seed
from ..kernel.request import Request, make_request
from ..scene.mesh import Mesh
from ..scene.scene import Scene, as_scene
from .hits import Forced, Hits
from .moving import Form, velocity
from .records import CurveRecords, RayRecords, Sampler, SurfaceRecords, barycentrics, shaded_room, without_colors
from .records import trace as trace_records
from .seeds import sample_seeds
from .shadows import ShadowLight
from .splat import Term, attached, splat
from .steps import Steps
from .surfaces import Rays, Surfaces, View, every_face

ALL_AT_ONCE = 1 << 40
_Rays = TypeVar("_Rays", bound=RayRecords | SurfaceRecords)
SAMPLES = ("image", "inside", "edges", "steps", "shadows", "image again")  # kinds that draw numbers of their own


class Frame:
    """One image of a scene: what all its samples share."""

    def __init__(self, scene: Scene, request: Request, index: int = 0) -> None:
        packed = request.camera
        self.request, self._index = request._replace(scene=without_colors(request.scene)), index
        self.surfaces = Surfaces(scene, self.request.scene)
        self.device, self.dtype = self.surfaces.verts.device, self.surfaces.verts.dtype
        self.sampler = Sampler(self.request, index, torch.finfo(self.dtype).eps ** (2 / 3))
        self.view = View(packed.world_to_camera[index].to(self.device, torch.float64), packed.perspective)
        self.fixed, self.fixed_view = self.surfaces.detach(), self.view.detach()
        self.intrinsics = torch.cat([packed.K[index, :2].reshape(6), packed.distortion[index]])
        self.height, self.width = packed.height, packed.width

    @property
    def pixels(self) -> int:
        return self.height * self.width

    def here(self, tensor: Tensor) -> Tensor:
        """On the device of the scene."""
        return tensor.to(self.device)

    def seeds(self, kind: str, count: int, first: int = 0) -> Tensor:
        """(count,) int64: of the samples of a kind from `first` on."""
        request = self.request
        seed = camera_seed(request.image.seed, self._index) if kind.startswith("image") else self.sampler.grad_seed
        return self.here(sample_seeds(seed, SAMPLES.index(kind), first, count))

    def seeds_of_pixels(self, kind: str, pixel: Tensor, each: int) -> Tensor:
        """(N,) int64: of hits in the pixels (N,), in their order, about `each` in one. A pixel has the same ones whatever the
        others see, so that the images of a scene and of one that is moved a little differ by little."""
        row = torch.arange(len(pixel))
        begins = torch.ones(len(pixel), dtype=torch.bool)
        begins[1:] = pixel[1:] != pixel[:-1]
        among = row - torch.where(begins, row, 0).cummax(0).values if len(pixel) else row
        return self.seeds(kind, 1) + self.here(each * pixel + among)

    def fixed_hits(
        self,
        face: Tensor,
        b: Tensor,
        x: Tensor,
        seed: Tensor | None = None,
        steps: Steps | None = None,
        forced: Forced | None = None,
    ) -> Hits:
        """Without derivatives; b (N, 3), or the last two barycentrics."""
        place = self.here(face), self.here(b if b.shape[1] == 3 else barycentrics(b)), self.here(x)
        return Hits(self.fixed, self.fixed_view, *place, self.sampler.rays_at, steps, seed, forced)

    @property
    def no_hits(self) -> Hits:
        """None of them: for what a shader notes of the scene, such as where it jumps."""
        none = torch.zeros(0, dtype=torch.int64)
        return self.fixed_hits(
            none, torch.zeros(0, 2, dtype=torch.float64), torch.zeros(0, 2, dtype=torch.float64), none
        )

    def moving_hits(
        self, face: Tensor, rays: RayRecords | SurfaceRecords, x: Tensor, seed: Tensor | None = None
    ) -> Hits:
        """Functions of vertices and camera, at fixed places in the image."""
        face = self.here(face)
        b = self.view.barycentrics(self.surfaces, face, self.here(self._moving(rays).along))
        return Hits(
            self.surfaces, self.view, face, b, self.here(x), lambda x: self._moving(self.sampler.rays_at(x)), seed=seed
        )

    def _moving(self, rays: _Rays) -> _Rays:
        """The rays as functions of the intrinsics, at fixed places in the image."""
        if not moves(self.intrinsics):
            return rays
        moved = rays.along_by_k @ (self.intrinsics - self.intrinsics.detach()).to(rays.along_by_k.device)
        return rays._replace(along=rays.along + moved)

    def image(self, pixel: Tensor, values: Tensor, pixels: range | None = None) -> Tensor:
        """(H · W, C), or of these pixels: the sums of rows of values (N, C) by pixel."""
        pixels = pixels or range(self.pixels)
        return values.new_zeros((len(pixels), values.shape[1])).index_add(0, self.here(pixel) - pixels.start, values)

    def attached(self, image: Tensor, terms: Sequence[Term]) -> Tensor:
        """The image, and of terms (H · W, C) their derivatives."""
        return attached(image.reshape(self.pixels, -1), terms, self.request).reshape(image.shape)

    def composed(self, image: Tensor, background: Tensor | None) -> Tensor:
        """(H, W, C), before a background (C,) or (H, W, C)."""
        image = image.reshape(self.height, self.width, -1)
        if background is None:
            return image
        coverage = self.here(self.sampler.coverage).to(image.dtype)
        return image + (1 - coverage)[:, :, None] * background.to(image)


class PrimaryHits:
    """What the rays of an image hit: all samples of a pixel on one face are one hit, at one of them drawn at random.

    hits      Hits, N points, differentiable functions of vertices and camera at fixed places in the image
    index     (N,) int64, the pixel of each, row by row
    weight    (N,) the share of the pixel's samples on that face
    coverage  (H, W) the share of each pixel that is covered
    """

    def __init__(self, scene: Scene, request: Request) -> None:
        self.frame = frame = Frame(scene, request)
        ((_, found),) = frame.sampler.pixel_hits(ALL_AT_ONCE)
        seed = frame.seeds_of_pixels("image", found.pixel, 1)
        self.hits = frame.moving_hits(found.face, frame.sampler.rays_at(found.x), found.x, seed)
        self.index, self.weight = frame.here(found.pixel), frame.here(found.weight).to(frame.dtype)
        self.coverage = frame.here(frame.sampler.coverage)

    def __repr__(self) -> str:
        return f"PrimaryHits({len(self.hits)} points in {self.frame.height} x {self.frame.width} pixels)"

    def image(self, radiance: Tensor, background: Tensor | None = None) -> Tensor:
        """(H, W, C) from the radiance (N, C) of the hits, before a background (C,) or (H, W, C).

        Its gradient by the radiance, and so inside faces, is right; that of what moves at edges is not in it. Raises TypeError
        or ValueError that names the argument.
        """
        radiance = _rows("radiance", radiance, len(self.hits))
        background = _background(background, radiance, self.frame)
        sums = self.frame.image(self.index, self.weight.to(radiance.dtype)[:, None] * radiance)
        return self.frame.composed(sums, background)


class SurfaceSamples:
    """Samples inside faces, where the image sees them.

    hits    Hits, S points, differentiable functions of vertices and camera at fixed places in the image
    weight  (S,) px² that each stands for
    """

    def __init__(self, frame: Frame, records: SurfaceRecords, first: int = 0) -> None:
        self.frame, self._records, self._first = frame, records, first
        self.weight = frame.here(records.weight)
        self._hits: Hits | None = None

    def __len__(self) -> int:
        return len(self._records.face)

    def __repr__(self) -> str:
        return f"SurfaceSamples({len(self)} points)"

    def part(self, first: int, end: int) -> SurfaceSamples:
        """Some of them."""
        return SurfaceSamples(self.frame, SurfaceRecords(*(part[first:end] for part in self._records)), first)

    @property
    def hits(self) -> Hits:
        if self._hits is None:
            seed = self.frame.seeds("inside", len(self), self._first)
            self._hits = self.frame.moving_hits(self._records.face, self._records, self._records.x, seed)
        return self._hits

    def image(self, radiance: Tensor) -> Tensor:
        """(H, W, C) from the radiance (S, C) of the samples: an estimate of the image before black whose gradient is that inside
        faces, for its weights stand for areas of the image and not for shares of a pixel's samples. Raises TypeError or
        ValueError that names the argument."""
        radiance = _rows("radiance", radiance, len(self))
        weighted = self.weight.to(radiance.dtype)[:, None] * radiance
        return self.frame.composed(splat(self._records.x, weighted, self.frame.request), None)

    def _term(self, radiance: Tensor) -> Term:
        """The same, for attached()."""
        return Term(self._records.x, radiance, self._records.weight)


class EdgeSamples:
    """Samples on the curves where the image jumps: silhouettes, borders, intersections and creases, and
    the rim where a lens folds or ends.

    hits      Hits, the N points on their surfaces, at most three a sample; without derivatives
    sample    (N,) int64, whose each is
    x         (S, 2) places in the image, px
    velocity  (S,) of the curve across itself, times the length that a sample stands for: its value is zero, its derivative is
              that of the place by vertices and camera
    """

    def __init__(
        self, frame: Frame, records: CurveRecords, light: ShadowLight | None = None, only: bool = False
    ) -> None:
        """Of borders of the shadow of a light; `only`: the hits, those in the light alone, ask what it adds."""
        self.frame, self._records = frame, records
        self.x = frame.here(records.x)
        self._in_order = only and len(records.hit_sample) == len(records.x)  # whether the i-th hit is the i-th sample's
        self.sample, self._factor = frame.here(records.hit_sample), frame.here(records.hit_factor)
        of_hits = slice(None) if self._in_order else self.sample
        self.to_background = frame.here(records.to_background)
        points = None
        if light is not None:
            points, share = light.points(frame.here(records.light), frame.here(records.light_uv))
            self._factor, self.to_background = self._factor * share[of_hits], self.to_background * share
        # All sides of a sample see the same points of lights.
        seed = frame.seeds("edges" if light is None else "shadows", len(self))[of_hits]
        forced = None
        if light is not None and points is not None:
            lit = frame.here(records.hit_side == 0).to(frame.dtype)
            some = torch.ones_like(lit, dtype=torch.bool)
            forced = Forced(light.number, points.select(of_hits), lit, some, only)
        self.hits = frame.fixed_hits(records.hit_face, records.hit_b, records.hit_x, seed, forced=forced)
        flat = frame.request.scene
        forms = [
            (Form(records.row_of, records.vertex, records.by_q), frame.view.in_camera(frame.surfaces.verts)),
            (Form(records.uv_row_of, records.uv, records.by_uv), flat.uvs),
            (Form(records.alpha_row_of, records.alpha, records.by_alpha[:, None]), flat.alphas[:, :1]),
        ]
        every = torch.arange(len(self))
        if len(records.by_k):
            forms.append((Form(every, torch.zeros_like(every), records.by_k), frame.intrinsics[None]))
        if light is not None and points is not None and (moves(frame.view.world_to_camera) or light.moves(light.light)):
            place = light.light.place(points).double()
            place = frame.view.turned(place) if light.light.infinite else frame.view.in_camera(place)
            forms.append((Form(every, every, records.by_light), place))
        self.velocity = frame.here(velocity(len(self), forms))

    def __len__(self) -> int:
        return len(self.x)

    def __repr__(self) -> str:
        return f"EdgeSamples({len(self)} samples, {len(self.hits)} points)"

    def jump(self, radiance: Tensor) -> Tensor:
        """(S, C) how the image jumps at each sample, from the radiance (N, C) of the hits; a background comes in by
        attach_boundary(). Raises TypeError or ValueError that names the argument."""
        return self.sum(_rows("radiance", radiance, len(self.hits)))

    def sum(self, radiance: Tensor) -> Tensor:
        """(S, C) from the radiance (N, C)."""
        weighted = self._factor.to(radiance.dtype)[:, None] * radiance
        if self._in_order:
            return weighted
        return radiance.new_zeros((len(self), radiance.shape[1])).index_add(0, self.sample, weighted)


# -- what users call ----------------------------------------------------------------------------------------------------


def trace(scene: Scene | Mesh, origins: Tensor, directions: Tensor) -> Hits:
    """The nearest hits of any rays: Hits of those that hit something, with the row of each in `hits.ray`.

    origins, directions  (N, 3) or (3,) world coordinates, directions of any length

    Positions, normals, texture coordinates and the rest are differentiable functions of the vertices, the origins and the
    directions, while each ray meets the same face; what moves at silhouettes is not in them. `hits.depth` is in lengths of the
    direction; there is no `hits.pixel`. Raises TypeError or ValueError that names the argument.
    """
    scene = as_scene(scene)
    like = scene.meshes[0].verts
    given = {}
    for name, value in (("origins", origins), ("directions", directions)):
        tensor = as_tensor(name, value, like=like, floating=True)
        check_float(name, tensor)
        check_shape(name, tensor, (len(tensor) if tensor.dim() == 2 and len(tensor) == 0 else "N", 3), (3,))
        check_finite(name, tensor, largest=1e30)
        given[name] = tensor.to(like.device, torch.float64)
    count = max(len(t) if t.dim() == 2 else 1 for t in given.values())
    for name, tensor in given.items():
        if tensor.dim() == 2 and len(tensor) not in (1, count):
            raise ValueError(f"{name}: expected as many rows as the other, {count}, got {len(tensor)}")
        given[name] = tensor.expand(count, 3)
    d = given["directions"]
    zero = (d.detach() == 0).all(1)
    if bool(zero.any()):
        raise ValueError(f"directions: expected lengths above zero, got zeros in row {int(zero.nonzero()[0])}")
    surfaces = Surfaces(scene)
    found = trace_records(surfaces.bare, given["origins"], d)
    index = (found.face >= 0).nonzero()[:, 0]
    face, index = found.face[index].to(like.device), index.to(like.device)
    rays = Rays(index, given["origins"][index], d[index])
    b = barycentrics(found.b.to(like.device)[index])
    corners = surfaces.corners(face)
    if moves(corners, rays.origin, rays.direction):
        b = rays.barycentrics(corners.double(), b)
    return Hits(surfaces, rays, face, b)


def primary_hits(
    scene: Scene | Mesh,
    camera: Camera,
    spp: int = 16,
    seed: int = 0,
    *,
    filter: str = "box",
    grad_seed: int | None = None,
) -> PrimaryHits:
    """What the rays of an image hit: render()'s samples, for a pipeline of your own. The arguments are render()'s, with one
    camera. Raises what render() raises."""
    request = make_request(scene, camera, spp, seed, filter=filter, grad_seed=grad_seed)
    if camera.batch is not None:
        raise ValueError(f"camera: expected one camera, got a batch of {camera.batch}; take camera[i] one by one")
    return PrimaryHits(as_scene(scene), request)


def surface_samples(primary: PrimaryHits, count: int | None = None) -> SurfaceSamples:
    """Samples for the gradient inside faces, fewer than those of the image: by default half a sample a pixel of surface.

    primary   of primary_hits()
    count     of samples; see surface_samples of render()

    Raises TypeError or ValueError that names the argument, MemoryError if so many do not fit.
    """
    request = _request_of(primary, "surface_samples", count)
    with shaded_room(request._replace(gradient=request.gradient._replace(edge_samples=0)), gradient=True):
        moving = moves(primary.frame.intrinsics)
        surface, _ = primary.frame.sampler.samples(request, interior=True, boundary=False, intrinsics=moving)
    return SurfaceSamples(primary.frame, surface)


def edge_samples(primary: PrimaryHits, count: int | None = None, creases: bool | Tensor = True) -> EdgeSamples:
    """Samples for the gradient of what moves at edges.

    primary   of primary_hits()
    count     of samples; see edge_samples of render()
    creases   at which edges between two visible faces radiance may jump: True, at all; False, at none; or numbers at the corners
              of faces (F, 3, K), at those where these differ on both sides

    Raises TypeError or ValueError that names the argument, MemoryError if so many do not fit.
    """
    request = _request_of(primary, "edge_samples", count)
    F = len(primary.frame.surfaces.faces)
    attributes = None
    if isinstance(creases, Tensor):
        check_float("creases", creases)
        check_shape("creases", creases, (F, 3, "K"))
        check_finite("creases", creases)
        attributes = creases.detach().cpu()
    elif creases is True:
        attributes = every_face(F)
    elif creases is not False:
        raise TypeError(f"creases: expected True, False or a tensor (F, 3, K), got {type(creases).__name__}")
    request = request._replace(scene=without_colors(request.scene, attributes))
    frame = primary.frame
    with shaded_room(request._replace(gradient=request.gradient._replace(surface_samples=0)), gradient=True):
        _, curves = frame.sampler.samples(
            request, interior=False, boundary=True, intrinsics=moves(frame.intrinsics), steps=request.scene.has_steps
        )
    return EdgeSamples(frame, curves)


def attach_boundary(image: Tensor, samples: EdgeSamples, jump: Tensor, background: Tensor | None = None) -> Tensor:
    """The image, with the gradient of what moves at edges: its value is the same.

    image       (H, W, C)
    samples     of edge_samples()
    jump        (S, C) samples.jump(…), without derivatives
    background  (C,) or (H, W, C) behind all surfaces; black when None

    In reverse and in forward mode, once. Raises TypeError or ValueError that names the argument.
    """
    if not isinstance(samples, EdgeSamples):
        raise TypeError(f"samples: expected what edge_samples() returned, got {type(samples).__name__}")
    frame = samples.frame
    jump = _rows("jump", jump, len(samples)).detach()
    image = as_tensor("image", image, like=jump, floating=True)
    check_float("image", image)
    check_shape("image", image, (frame.height, frame.width, jump.shape[1]))
    background = _background(background, jump, frame)
    terms = boundary(samples.x, samples.velocity, jump, samples.to_background, background)
    return frame.attached(image, terms)


# -- shared with shader.py ------------------------------------------------------------------------------------------------


def boundary(
    x: Tensor, velocity: Tensor, jump: Tensor, to_background: Tensor | None, background: Tensor | None
) -> list[Term]:
    """Σ k(x − c) ΔL v over samples on curves, with the curve's velocity v, whose value is zero."""
    x, velocity = x.detach(), velocity.to(jump.dtype)[:, None]
    terms = [Term(x, velocity * jump)]
    if background is not None and to_background is not None:
        behind = background.detach().reshape(-1, jump.shape[1]).to(jump)
        terms.append(Term(x, velocity * to_background.to(jump.dtype)[:, None], behind=behind))
    return terms


def _request_of(primary: PrimaryHits, name: str, count: int | None) -> Request:
    if not isinstance(primary, PrimaryHits):
        raise TypeError(f"primary: expected what primary_hits() returned, got {type(primary).__name__}")
    request = primary.frame.request
    if count is None:
        return request
    number = check_positive_int("count", count, most=1 << 40)
    return request._replace(gradient=request.gradient._replace(**{name: number}))


def _rows(name: str, value: Tensor, count: int) -> Tensor:
    value = as_tensor(name, value, floating=True)
    check_float(name, value)
    check_shape(name, value, (count, "C"))
    return value


def _background(background: Tensor | None, like: Tensor, frame: Frame) -> Tensor | None:
    if background is None:
        return None
    background = as_tensor("background", background, like=like, floating=True)
    check_float("background", background)
    check_shape("background", background, (like.shape[1],), (frame.height, frame.width, like.shape[1]))
    return background
