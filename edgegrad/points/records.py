"""The kernel's samples for shaders written in PyTorch, as records of tensors. They work under the transforms of torch.func."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..kernel import memory as memory
from ..kernel.derivatives import moves
from ..kernel.first_order import without_derivatives
from ..kernel.flat import Flat, flatten
from ..kernel.operators import Hits as ImageHits
from ..kernel.operators import (
    camera_seed,
    faces_with_textures,
    kernel_camera,
    kernel_hits,
    kernel_scene,
    lower,
    pass_size,
    warn_of_ends,
)
from ..kernel.request import Request
from ..library import core
from ..scene.scene import Scene


class PixelRecords(NamedTuple):
    """The image's hits: one, or several, of the samples of a pixel on one face stand for all of these."""

    pixel: Tensor  # (N,) int64, row by row
    face: Tensor  # (N,) int64
    b: Tensor  # (N, 2) float64, the last two barycentrics
    x: Tensor  # (N, 2) float64, pixel positions
    weight: Tensor  # (N,) float64, the share of the pixel's samples


class SurfaceRecords(NamedTuple):
    """Samples inside faces."""

    face: Tensor  # (S,) int64
    x: Tensor  # (S, 2) float64, pixel positions
    along: Tensor  # (S, 3) float64, the ray's direction in camera coordinates; in an orthographic view a point on it
    along_by_k: Tensor  # (S, 3, 14) float64, its derivatives by K in rows and the distortion, at fixed x; empty where these stay
    weight: Tensor  # (S,) float64, px² that a sample stands for


class CurveRecords(NamedTuple):
    """Samples on curves where the image may jump."""

    x: Tensor  # (S, 2) float64, pixel positions
    # N points of surfaces there, at most three a sample. The jump, times what a sample stands for, is Σ factor · radiance.
    hit_sample: Tensor  # (N,) int64, the sample of each point
    hit_face: Tensor  # (N,) int64
    hit_side: Tensor  # (N,) int64, its number among the points of the sample
    hit_b: Tensor  # (N, 3) float64, barycentrics
    hit_x: Tensor  # (N, 2) float64, pixel position
    hit_factor: Tensor  # (N,) float64
    to_background: Tensor  # (S,) float64, the factor of what lies behind all surfaces
    by_k: Tensor  # (S, 14) float64, the curve's velocity by K in rows and the distortion; empty where these stay
    row_of: Tensor  # (R,) int64, the sample of a row
    vertex: Tensor  # (R,) int64
    by_q: Tensor  # (R, 3) float64, the curve's velocity by a vertex in camera coordinates
    uv_row_of: Tensor  # (P,) int64, the sample of a row by texture coordinates, of alpha-tested faces
    uv: Tensor  # (P,) int64
    by_uv: Tensor  # (P, 2) float64
    alpha_row_of: Tensor  # (Q,) int64, the sample of a row by texels of alpha
    alpha: Tensor  # (Q,) int64
    by_alpha: Tensor  # (Q,) float64
    transparent_row_of: Tensor  # (P,) int64, the sample of a row by faces through which it is seen
    transparent: Tensor  # (P,) int64
    transparent_b: Tensor  # (P, 2) float64, the last two barycentrics there
    # For borders of shadows alone: the first point is the one in the light, the second the one in the shadow.
    light: Tensor  # (S,) int64, the part of the light
    light_uv: Tensor  # (S, 2) float64, where on it
    by_light: (
        Tensor  # (S, 3) float64, by the place in camera coordinates, or by the direction towards a light at infinity
    )


class LightParts(NamedTuple):
    """A light as one point, or as triangles."""

    corner: Tensor  # (L, 3, 3) float64: world coordinates, or, at infinity, directions towards it; a point thrice
    chance: Tensor  # (L,) float64 above zero, the probability that a point of the light is drawn there
    face: Tensor  # (L,) int32, the face of the scene; −1: none
    infinite: bool
    extended: bool
    two_sided: bool


class PlaceRecords(NamedTuple):
    """What is seen at places in the image."""

    face: Tensor  # (N,) int64, −1: none
    part: Tensor  # (N,) int64, the connected part of the surface, −1: none
    b: Tensor  # (N, 2) float64


class RayRecords(NamedTuple):
    """Rays to places in the image; see SurfaceRecords."""

    along: Tensor  # (N, 3) float64
    along_by_x: Tensor  # (N, 3, 2) float64, by the place
    along_by_k: Tensor  # (N, 3, 14) float64; empty where they are not wanted


class TraceRecords(NamedTuple):
    """What rays hit."""

    face: Tensor  # (N,) int64, −1: none
    b: Tensor  # (N, 2) float64


# Bytes of a record, and of the rows of curves: four vertices each.
SURFACE_BYTES, CURVE_BYTES = 8 * (1 + 2 + 3 + 3 * 14 + 1), 8 * (2 + 3 + 6 + 3 + 14 + 4 * (1 + 1 + 3))


def shaded_memory(
    request: Request, gradient: bool | None = None, textured: bool = False
) -> AbstractContextManager[None]:
    """Raises MemoryError before its block if the image of a shader does not fit, and if an allocation in it fails. What the
    shader itself takes is not known. The samples of the `gradient` count too, by default where gradients are enabled."""
    size, options = size_of_values(request), request.gradient
    pixels = request.camera.height * request.camera.width
    needs = core.image_bytes(size, request.cameras)
    if torch.is_grad_enabled() if gradient is None else gradient:
        # By default about half a sample a pixel of surface, one where it is lit and has a texture, and some at edges.
        default = pixels if textured else pixels // 2
        surface = options.surface_samples if options.surface_samples >= 0 else default
        edge = options.edge_samples if options.edge_samples >= 0 else pixels // 8
        needs["samples"] = request.cameras * (SURFACE_BYTES * surface + CURVE_BYTES * edge)
    return memory.room("render with a shader", needs, lambda: lower(request) + ", or what the shader keeps of a point")


def barycentrics(b: Tensor) -> Tensor:
    """(N, 3) from the last two."""
    u, v = b.unbind(-1)
    return torch.stack([1 - (u + v), u, v], -1)


def _record(kind: Any, arrays: dict[str, np.ndarray]) -> Any:
    tensors = (torch.from_numpy(arrays[name]) for name in kind._fields)
    return kind(*(t.long() if t.dtype == torch.int32 else t for t in tensors))


def values_of(*tensors: Tensor) -> list[np.ndarray]:
    """The values of tensors, also under transforms of torch.func."""
    found: list[np.ndarray] = []

    def keep(*values: Tensor) -> Sequence[Tensor]:
        found.extend(value.detach().cpu().contiguous().numpy() for value in values)
        return (torch.zeros(0),)

    without_derivatives(keep, *tensors)
    return found


def _of_values(packed: Sequence[Any], compute: Callable[..., Sequence[Tensor]], *more: Tensor) -> tuple[Tensor, ...]:
    """compute(packed, *more), with the values of tensors in place of these."""
    places = [i for i, value in enumerate(packed) if isinstance(value, Tensor)]

    def with_values(*tensors: Tensor) -> Sequence[Tensor]:
        values = list(packed)
        for i, tensor in zip(places, tensors[: len(places)], strict=True):
            values[i] = tensor.detach()
        return compute(values, *(tensor.detach() for tensor in tensors[len(places) :]))

    return without_derivatives(with_values, *(packed[i] for i in places), *more)


def size_of_values(request: Request) -> Any:
    """pass_size(), also under transforms of torch.func."""
    found: list[Any] = []

    def keep(packed: Sequence[Any]) -> Sequence[Tensor]:
        found.append(pass_size(Request.unpack(packed)))
        return (torch.zeros(0),)

    _of_values(request.pack(), keep)
    return found[0]


def _tensors_of(flat: Flat | None) -> list[Tensor]:
    return [part for part in flat or () if isinstance(part, Tensor)]


def _with_tensors(flat: Flat, tensors: Sequence[Tensor]) -> Flat:
    """With these in place of its own."""
    values = iter(tensors)
    found: list[Any] = [next(values) if isinstance(part, Tensor) else part for part in flat]
    return Flat(*found)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.cpu().double().contiguous().numpy()


def bare(scene: Scene, blended: bool = True) -> Flat:
    """The surfaces of a scene alone; see flatten()."""
    return without_colors(flatten(scene, blended=blended))


def without_colors(flat: Flat, attributes: Tensor | None = None) -> Flat:
    """The geometry of a scene with these numbers (F, 3, K) for colours."""
    F = len(flat.faces)
    if attributes is not None and attributes.numel():
        colors = attributes.reshape(3 * F, -1).to(flat.colors.dtype).contiguous()
        corners = torch.arange(3 * F, dtype=torch.int32).reshape(F, 3)
    else:
        colors, corners = torch.zeros((1, 1), dtype=flat.colors.dtype), torch.zeros((F, 3), dtype=torch.int32)
    return flat._replace(
        corners=corners,
        colors=colors,
        uvs=flat.uvs if len(flat.alpha_masks) else flat.uvs.new_zeros((0, 2)),
        texels=colors.new_zeros((0, colors.shape[1])),
        textures=flat.textures.new_zeros((0, 6)),
        face_texture=flat.face_texture.new_zeros(0),
        background=colors.new_zeros(colors.shape[1]),
    )


# -- any rays -----------------------------------------------------------------------------------------------------------


def trace(flat: Flat, origins: Tensor, directions: Tensor, ignored: Tensor | None = None) -> TraceRecords:
    """The nearest hits of rays (N, 3); each passes through one face, `ignored` (N,), −1: none."""

    def compute(values: list[Any], origins: Tensor, directions: Tensor, *ignored: Tensor) -> Sequence[Tensor]:
        found = kernel_scene(Flat(*values)).trace(
            origins=_array(origins),
            directions=_array(directions),
            ignored=ignored[0].cpu().int().contiguous().numpy() if ignored else None,
            threads=torch.get_num_threads(),
        )
        return _record(TraceRecords, found)

    more = () if ignored is None else (ignored,)
    return TraceRecords(*_of_values(flat, compute, origins, directions, *more))


def visible(flat: Flat, face: Tensor, b: Tensor, to: Tensor, contact: Tensor) -> Tensor:
    """(N,) bool: whether nothing lies between points of faces and the points `to` (N, 3), but within `contact` (N,) of either."""

    def compute(values: list[Any], face: Tensor, b: Tensor, to: Tensor, contact: Tensor) -> Sequence[Tensor]:
        found = kernel_scene(Flat(*values)).visible(
            face=face.cpu().int().contiguous().numpy(),
            b=_array(b),
            to=_array(to),
            contact=_array(contact),
            threads=torch.get_num_threads(),
        )
        return (torch.from_numpy(found).bool(),)

    return _of_values(flat, compute, face, b, to, contact)[0].to(face.device)


def has_intersections(flat: Flat) -> bool:
    """Whether faces pass through each other anywhere."""
    found: list[bool] = []

    def compute(values: list[Any]) -> Sequence[Tensor]:
        found.append(kernel_scene(Flat(*values)).has_intersections(torch.get_num_threads()))
        return (torch.zeros(0),)

    _of_values(flat, compute)
    return found[0]


# -- of a camera --------------------------------------------------------------------------------------------------------


class Sampler:
    """The samples of one camera of a request."""

    def __init__(self, request: Request, camera: int, least: float) -> None:
        """`least`: the smallest barycentric of points on curves."""
        self._request, self._camera, self._least = request, camera, least
        self.transparent: Tensor | None = None  # (F,) bool: faces that hide no curve, for one sees through them
        self._kept: tuple[list[Any], Flat, Any] | None = None
        height, width, faces = request.camera.height, request.camera.width, len(request.scene.faces)
        dtype = request.scene.colors.dtype
        self._hits = ImageHits(
            torch.empty((1, height, width), dtype=dtype),
            torch.empty((1, height, width), dtype=torch.float32),
            torch.empty((1, height, width, 2), dtype=torch.int32),
            torch.zeros((1, faces), dtype=torch.uint8),
        )

    @property
    def coverage(self) -> Tensor:
        """(H, W), once all pixel hits were taken."""
        return self._hits.coverage[0]

    @property
    def grad_seed(self) -> int:
        return camera_seed(self._request.gradient.grad_seed, self._camera)

    @property
    def _transparent(self) -> np.ndarray | None:
        return None if self.transparent is None else self.transparent.cpu().to(torch.uint8).numpy()

    def _scene(self, flat: Flat) -> Any:
        """The kernel's scene, checked once: most calls have the same arrays."""
        key = [part.data_ptr() if isinstance(part, Tensor) else part for part in flat]
        if self._kept is None or self._kept[0] != key:
            self._kept = key, flat, kernel_scene(flat)  # `flat` too: else other tensors might get the same addresses
        return self._kept[2]

    def _compute(self, request: Request, compute: Callable[..., Sequence[Tensor]], *more: Tensor) -> tuple[Tensor, ...]:
        """compute(request, the kernel's camera, *more), with the values of tensors."""

        by_distortion = moves(request.camera.distortion)

        def with_request(values: list[Any], *more: Tensor) -> Sequence[Tensor]:
            values_of = Request.unpack(values)
            return compute(values_of, kernel_camera(values_of.camera, self._camera, by_distortion), *more)

        return _of_values(request.pack(), with_request, *more)

    def pixel_hits(
        self, at_once: int, most: int = 1, only: Tensor | None = None
    ) -> Iterator[tuple[range, PixelRecords]]:
        """Ranges of pixels, row by row, and their hits, about `at_once` together.

        most   hits of a pixel on one face
        only   (H, W) bool: these pixels alone, in a second pass, with hits drawn anew
        """
        height, width = self._request.camera.height, self._request.camera.width
        rows = max(1, at_once // (width * min(self._request.image.spp, 4 * most)))
        places = () if only is None else (only.to(torch.uint8),)
        for first in range(0, height, rows):
            end = min(height, first + rows)

            def compute(
                request: Request, camera: Any, *only: Tensor, first: int = first, end: int = end
            ) -> PixelRecords:
                if first == 0 and not only:
                    warn_of_ends([camera])
                found = self._scene(request.scene).pixel_hits(
                    first=first,
                    end=end,
                    most=most,
                    only=only[0].numpy() if only else None,
                    **self._image(request, camera),
                )
                return _record(PixelRecords, found)

            yield range(first * width, end * width), PixelRecords(*self._compute(self._request, compute, *places))

    def _image(self, request: Request, camera: Any) -> dict[str, Any]:
        """The kernel's arguments for the image."""
        options = request.image._replace(seed=camera_seed(request.image.seed, self._camera))
        return {
            "camera": camera,
            "image": core.ImageOptions(**options._asdict()),
            "threads": torch.get_num_threads(),
            "hits": kernel_hits(self._hits),
        }

    def lit_image(self, compute: Callable[..., Sequence[Tensor]], *tables: Tensor) -> tuple[Tensor, ...]:
        """compute(the kernel's scene, its faces, its arguments for the image, *tables), in place of pixel_hits()."""

        def with_request(request: Request, camera: Any, *tables: Tensor) -> Sequence[Tensor]:
            warn_of_ends([camera])
            return compute(self._scene(request.scene), request.scene.faces, self._image(request, camera), *tables)

        return self._compute(self._request, with_request, *tables)

    def samples(
        self,
        request: Request,
        interior: bool,
        boundary: bool,
        intrinsics: bool = False,
        steps: bool = False,
        lit: Scene | None = None,
        importance: Tensor | None = None,
    ) -> tuple[SurfaceRecords, CurveRecords]:
        """Of the gradient, to be called after pixel_hits(). The scene of `request` has colours that differ at creases.

        lit     the scene whose lights shade them
        importance  (H, W), above zero: how much they are to look at each pixel; None: the same everywhere
        """
        of_pixels = () if importance is None else (importance.to(self._hits.coverage.dtype),)

        def compute(request: Request, camera: Any, *importance: Tensor) -> Sequence[Tensor]:
            flat, options = request.scene, request.gradient
            surface, curves = self._scene(flat).samples(
                camera=camera,
                image=core.ImageOptions(**request.image._asdict()),
                options=core.GradientOptions(
                    seed=self.grad_seed,
                    surface_samples=options.surface_samples,
                    edge_samples=options.edge_samples,
                    interior_geometry=interior,
                    boundary=boundary,
                    intrinsics=intrinsics,
                    steps=steps,
                    step_spacing=options.step_spacing,
                    lit=lit is not None,
                ),
                least=self._least,
                threads=torch.get_num_threads(),
                hits=kernel_hits(self._hits),
                detailed=faces_with_textures(lit),
                transparent=self._transparent,
                importance=importance[0].cpu().contiguous().numpy() if importance else None,
            )
            return (*_record(SurfaceRecords, surface), *_record(CurveRecords, curves))

        parts = self._compute(request, compute, *of_pixels)
        count = len(SurfaceRecords._fields)
        return SurfaceRecords(*parts[:count]), CurveRecords(*parts[count:])

    def shadow_samples(
        self,
        light: LightParts,
        seed: int,
        samples: int,
        intrinsics: bool,
        one: bool = False,
        casters: Flat | None = None,
        seen: bool = True,
    ) -> CurveRecords:
        """On the borders of a light's shadows, to be called after pixel_hits(). `samples`: how many, −1: the default. `one`: with
        only the point in the light. `casters`: the faces that shadow rays meet, where they differ from what the camera sees.
        `seen`: by the camera; else so many on surfaces, seen or not, with velocities by world coordinates and no places x."""
        parts, count = _tensors_of(casters), len(light[:3])

        def compute(request: Request, camera: Any, *tensors: Tensor) -> CurveRecords:
            arrays = (tensor.cpu().contiguous().numpy() for tensor in tensors[:count])
            scene = self._scene(request.scene)
            found = scene.shadow_samples(
                casters=scene if casters is None else kernel_scene(_with_tensors(casters, tensors[count:])),
                light=core.LightParts(*arrays, *light[3:]),
                one=one,
                seen=seen,
                **self._of_curves(request, camera, seed, samples, intrinsics),
            )
            return _record(CurveRecords, found)

        return CurveRecords(*self._compute(self._request, compute, *light[:3], *parts))

    def secondary_edge_samples(
        self,
        compute: Callable[..., tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]],
        tables: Sequence[Tensor],
        seed: int,
        samples: int,
        intrinsics: bool,
        casters: Flat | None = None,
    ) -> tuple[CurveRecords, Tensor, Tensor]:
        """On the borders of what surfaces see of one another, each with its point that receives light alone, and what else there
        is of compute(the kernel's scene, that of `casters`, the faces, its arguments for curves, *tables). See
        shadow_samples()."""
        parts, count = _tensors_of(casters), len(tables)

        def with_request(request: Request, camera: Any, *tensors: Tensor) -> Sequence[Tensor]:
            scene = self._scene(request.scene)
            casting = scene if casters is None else kernel_scene(_with_tensors(casters, tensors[count:]))
            arguments = self._of_curves(request, camera, seed, samples, intrinsics)
            found, *more = compute(scene, casting, request.scene.faces, arguments, *tensors[:count])
            return *_record(CurveRecords, found), *map(torch.from_numpy, more)

        *fields, jump, origin = self._compute(self._request, with_request, *tables, *parts)
        return CurveRecords(*fields), jump, origin

    def _of_curves(self, request: Request, camera: Any, seed: int, samples: int, intrinsics: bool) -> dict[str, Any]:
        """The kernel's arguments for samples on curves."""
        return {
            "camera": camera,
            "image": core.ImageOptions(**request.image._asdict()),
            "options": core.GradientOptions(seed=seed, intrinsics=intrinsics),
            "samples": samples,
            "least": self._least,
            "threads": torch.get_num_threads(),
            "hits": kernel_hits(self._hits),
            "transparent": self._transparent,
        }

    def hits_at(self, x: Tensor) -> PlaceRecords:
        """What is seen at places (N, 2) in the image."""

        def compute(request: Request, camera: Any, x: Tensor) -> PlaceRecords:
            found = self._scene(request.scene).hits_at(camera=camera, x=_array(x), threads=torch.get_num_threads())
            return _record(PlaceRecords, found)

        return PlaceRecords(*self._compute(self._request, compute, x))

    def rays_at(self, x: Tensor, intrinsics: bool = True) -> RayRecords:
        """The rays to places (N, 2) in the image, with their derivatives by the intrinsics."""

        def compute(request: Request, camera: Any, x: Tensor) -> RayRecords:
            found = core.rays_at(camera=camera, x=_array(x), intrinsics=intrinsics, threads=torch.get_num_threads())
            return _record(RayRecords, found)

        return RayRecords(*(part.to(x.device) for part in self._compute(self._request, compute, x)))
