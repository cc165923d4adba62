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

Shorter: without no_grad(), the image of primary_hits has the gradient inside faces already.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..camera.camera import Camera
from ..check import as_tensor, check_finite, check_float, check_positive_int, check_shape
from ..kernel.derivatives import moves
from ..kernel.request import Request, make_request
from ..sampling import Sampling
from ..scene.mesh import Mesh
from ..scene.scene import Scene, as_scene
from .hits import Hits
from .image_context import ImageContext
from .moving import Form, velocity
from .records import CurveRecords, SurfaceRecords, with_attributes
from .sampler import shaded_memory
from .shadow_rays import Forced
from .shadows import ShadowLight
from .splat import SplatTerm, boundary, splat
from .surfaces import every_face

ALL_AT_ONCE = 1 << 40


class PrimaryHits:
    """Hits of the rays of an image. All samples of a pixel on one face are one hit, at one of them drawn at random.

    hits      Hits, N points, differentiable functions of vertices and camera at fixed places in the image
    index     (N,) int64, the pixel of each, row by row
    weight    (N,) the share of the pixel's samples on that face
    coverage  (H, W) the share of each pixel that is covered
    """

    def __init__(self, scene: Scene, request: Request) -> None:
        self.context = context = ImageContext(scene, request)
        ((_, found),) = context.sampler.pixel_hits(ALL_AT_ONCE)
        seed = context.seeds_of_pixels("image", found.pixel, 1)
        self.hits = context.moving_hits(found.face, context.rays_at(found.x), found.x, seed)
        self.index, self.weight = context.here(found.pixel), context.here(found.weight).to(context.dtype)
        self.coverage = context.here(context.sampler.coverage)

    def __repr__(self) -> str:
        return f"PrimaryHits({len(self.hits)} points in {self.context.height} x {self.context.width} pixels)"

    def image(self, radiance: Tensor, background: Tensor | None = None) -> Tensor:
        """Return the image (H, W, C) from the radiance (N, C) of the hits, before a background (C,) or (H, W, C).

        Its gradient by the radiance, and so inside faces, is right; that of what moves at edges is not in it. Raises TypeError
        or ValueError that names the argument.
        """
        radiance = _rows("radiance", radiance, len(self.hits))
        background = _background(background, radiance, self.context)
        sums = self.context.image(self.index, self.weight.to(radiance.dtype)[:, None] * radiance)
        return self.context.composed(sums, background)


class SurfaceSamples:
    """Samples inside faces, where the image sees them.

    hits    Hits, S points, differentiable functions of vertices and camera at fixed places in the image
    weight  (S,) px² that each stands for
    """

    def __init__(self, context: ImageContext, records: SurfaceRecords, first: int = 0) -> None:
        self.context, self._records, self._first = context, records, first
        self.weight = context.here(records.weight)
        self._hits: Hits | None = None

    def __len__(self) -> int:
        return len(self._records.face)

    def __repr__(self) -> str:
        return f"SurfaceSamples({len(self)} points)"

    def part(self, first: int, end: int) -> SurfaceSamples:
        """Return the samples from `first` to `end`."""
        return SurfaceSamples(self.context, SurfaceRecords(*(part[first:end] for part in self._records)), first)

    @property
    def hits(self) -> Hits:
        if self._hits is None:
            seed = self.context.seeds("inside", len(self), self._first)
            self._hits = self.context.moving_hits(self._records.face, self._records, self._records.x, seed)
        return self._hits

    def image(self, radiance: Tensor) -> Tensor:
        """Return an estimate of the image (H, W, C) before black from the radiance (S, C) of the samples. Its weights are
        areas, so its gradient is the interior term. Raises TypeError or ValueError that names the argument."""
        radiance = _rows("radiance", radiance, len(self))
        weighted = self.weight.to(radiance.dtype)[:, None] * radiance
        return self.context.composed(splat(self._records.x, weighted, self.context.request), None)

    def _term(self, radiance: Tensor) -> SplatTerm:
        """Return the radiance of the samples as a term of attached()."""
        return SplatTerm(self._records.x, radiance, self._records.weight)


class EdgeSamples:
    """Samples on the curves where the image jumps: silhouettes, borders, intersections and creases, and
    the boundary where a lens folds or ends.

    hits      Hits, the N points on their surfaces, at most three a sample; without derivatives
    sample    (N,) int64, the sample of each point
    x         (S, 2) places in the image, px
    velocity  (S,) along the curve's normal, times the length that a sample stands for: its value is zero, its derivative is
              that of the place by vertices and camera
    """

    def __init__(
        self, context: ImageContext, records: CurveRecords, light: ShadowLight | None = None, only: bool = False
    ) -> None:
        """`light`: the samples lie on borders of its shadow. `only`: all hits are in the light, and what is wanted of them is the
        radiance that it adds."""
        self.context, self._records = context, records
        self.x = context.here(records.x)
        self._in_order = only and len(records.hit_sample) == len(records.x)  # hit i belongs to sample i
        self.sample, self._factor = context.here(records.hit_sample), context.here(records.hit_factor)
        of_hits = slice(None) if self._in_order else self.sample
        self.to_background = context.here(records.to_background)
        points = None
        if light is not None:
            points, share = light.points(context.here(records.light), context.here(records.light_uv))
            self._factor, self.to_background = self._factor * share[of_hits], self.to_background * share
        # All sides of a sample draw the same points of lights.
        seed = context.seeds("edges" if light is None else "shadows", len(self))[of_hits]
        forced = None
        if light is not None and points is not None:
            lit = context.here(records.hit_side == 0).to(context.dtype)
            some = torch.ones_like(lit, dtype=torch.bool)
            forced = Forced(light.number, points.select(of_hits), lit, some, only)
        self.hits = context.fixed_hits(records.hit_face, records.hit_b, records.hit_x, seed, forced=forced)
        self.hits._on_curve = True
        flat = context.request.scene if light is None else context.surfaces.casters
        forms = [
            (Form(records.row_of, records.vertex, records.by_q), context.view.in_camera(context.surfaces.verts)),
            (Form(records.uv_row_of, records.uv, records.by_uv), flat.uvs),
            (Form(records.alpha_row_of, records.alpha, records.by_alpha[:, None]), flat.alphas[:, :1]),
        ]
        every = torch.arange(len(self))
        if len(records.by_k):
            forms.append((Form(every, torch.zeros_like(every), records.by_k), context.intrinsics[None]))
        if (
            light is not None
            and points is not None
            and (moves(context.view.world_to_camera) or light.moves(light.light))
        ):
            place = light.light.place(points).double()
            place = context.view.turned(place) if light.light.infinite else context.view.in_camera(place)
            forms.append((Form(every, every, records.by_light), place))
        self.velocity = context.here(velocity(len(self), forms))

    def __len__(self) -> int:
        return len(self.x)

    def __repr__(self) -> str:
        return f"EdgeSamples({len(self)} samples, {len(self.hits)} points)"

    def jump(self, radiance: Tensor) -> Tensor:
        """Return the jump (S, C) of the image at each sample, from the radiance (N, C) of the hits; a background comes in by
        attach_boundary(). Raises TypeError or ValueError that names the argument."""
        return self.sum(_rows("radiance", radiance, len(self.hits)))

    def sum(self, radiance: Tensor) -> Tensor:
        """Return the sum (S, C) over the points of each sample, from the radiance (N, C)."""
        weighted = self._factor.to(radiance.dtype)[:, None] * radiance
        if self._in_order:
            return weighted
        return radiance.new_zeros((len(self), radiance.shape[1])).index_add(0, self.sample, weighted)


# -- what users call ----------------------------------------------------------------------------------------------------


def primary_hits(
    scene: Scene | Mesh,
    camera: Camera,
    spp: int = 16,
    seed: int | None = None,
    *,
    filter: str = "box",
    sampling: Sampling | None = None,
    generator: torch.Generator | None = None,
) -> PrimaryHits:
    """Return the hits of the rays of an image: render()'s samples, for a pipeline of your own. The arguments are render()'s,
    with one camera. Raises what render() raises."""
    request = make_request(scene, camera, spp, seed, filter=filter, sampling=sampling, generator=generator)
    if camera.batch is not None:
        raise ValueError(f"camera: expected one camera, got a batch of {camera.batch}; take camera[i] one by one")
    return PrimaryHits(as_scene(scene), request)


def surface_samples(primary: PrimaryHits, count: int | None = None) -> SurfaceSamples:
    """Return samples for the gradient inside faces, fewer than those of the image: by default half a sample a pixel of surface.

    primary   of primary_hits()
    count     of samples; see Sampling.surface

    Raises TypeError or ValueError that names the argument, MemoryError if so many do not fit.
    """
    request = _request_of(primary, "surface_samples", count)
    with shaded_memory(request._replace(gradient=request.gradient._replace(edge_samples=0)), gradient=True):
        moving = moves(primary.context.intrinsics)
        surface, _ = primary.context.sampler.samples(request, interior=True, boundary=False, intrinsics=moving)
    return SurfaceSamples(primary.context, surface)


def edge_samples(primary: PrimaryHits, count: int | None = None, creases: bool | Tensor = True) -> EdgeSamples:
    """Samples for the gradient of what moves at edges.

    primary   of primary_hits()
    count     of samples; see Sampling.edges
    creases   at which edges between two visible faces radiance may jump: True, at all; False, at none; or numbers at the corners
              of faces (F, 3, K), at those where these differ on both sides

    Raises TypeError or ValueError that names the argument, MemoryError if so many do not fit.
    """
    request = _request_of(primary, "edge_samples", count)
    F = len(primary.context.surfaces.faces)
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
    request = request._replace(scene=with_attributes(request.scene, attributes))
    context = primary.context
    with shaded_memory(request._replace(gradient=request.gradient._replace(surface_samples=0)), gradient=True):
        _, curves = context.sampler.samples(
            request,
            interior=False,
            boundary=True,
            intrinsics=moves(context.intrinsics),
            discontinuities=request.scene.has_discontinuities,
        )
    return EdgeSamples(context, curves)


def attach_boundary(image: Tensor, samples: EdgeSamples, jump: Tensor, background: Tensor | None = None) -> Tensor:
    """Return the image, with the gradient of what moves at edges: its value is the same.

    image       (H, W, C)
    samples     of edge_samples()
    jump        (S, C) samples.jump(…), without derivatives
    background  (C,) or (H, W, C) behind all surfaces; black when None

    In reverse and in forward mode, once. Raises TypeError or ValueError that names the argument.
    """
    if not isinstance(samples, EdgeSamples):
        raise TypeError(f"samples: expected what edge_samples() returned, got {type(samples).__name__}")
    context = samples.context
    jump = _rows("jump", jump, len(samples)).detach()
    image = as_tensor("image", image, like=jump, floating=True)
    check_float("image", image)
    check_shape("image", image, (context.height, context.width, jump.shape[1]))
    background = _background(background, jump, context)
    terms = boundary(samples.x, samples.velocity, jump, samples.to_background, background)
    return context.attached(image, terms)


def _request_of(primary: PrimaryHits, name: str, count: int | None) -> Request:
    if not isinstance(primary, PrimaryHits):
        raise TypeError(f"primary: expected what primary_hits() returned, got {type(primary).__name__}")
    request = primary.context.request
    if count is None:
        return request
    number = check_positive_int("count", count, most=1 << 40)
    return request._replace(gradient=request.gradient._replace(**{name: number}))


def _rows(name: str, value: Tensor, count: int) -> Tensor:
    value = as_tensor(name, value, floating=True)
    check_float(name, value)
    check_shape(name, value, (count, "C"))
    return value


def _background(background: Tensor | None, like: Tensor, context: ImageContext) -> Tensor | None:
    if background is None:
        return None
    background = as_tensor("background", background, like=like, floating=True)
    check_float("background", background)
    check_shape("background", background, (like.shape[1],), (context.height, context.width, like.shape[1]))
    return background
