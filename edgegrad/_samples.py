"""The kernel's samples for shaders written in PyTorch, as records of tensors, and what becomes of values at them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ._kernel import core
from ._ops import Hits as ImageHits
from ._ops import camera_seed, kernel_camera, kernel_hits, kernel_scene, warn_of_ends
from ._request import Request


class PixelHits(NamedTuple):
    """Some of an image's hits: all samples of a pixel on one face, at one of them."""

    pixel: Tensor  # (N,) int64, row by row
    face: Tensor  # (N,) int64
    b: Tensor  # (N, 2) float64, the last two barycentrics
    x: Tensor  # (N, 2) float64, pixel positions
    weight: Tensor  # (N,) float64, the share of the pixel's samples


class SurfaceSamples(NamedTuple):
    """Samples inside faces."""

    face: Tensor  # (S,) int64
    x: Tensor  # (S, 2) float64, pixel positions
    along: Tensor  # (S, 3) float64, where the ray goes in camera coordinates; in an orthographic view the place it goes through
    along_by_k: Tensor  # (S, 3, 14) float64, its derivatives by K in rows and the distortion, at fixed x
    weight: Tensor  # (S,) float64, px² that a sample stands for


class CurveSamples(NamedTuple):
    """Samples on curves where the image may jump."""

    x: Tensor  # (S, 2) float64, pixel positions
    face: Tensor  # (S, 3) int64 of the surfaces there; -1: the background, -2: none
    b: Tensor  # (S, 3, 2) float64, the last two barycentrics on them
    factor: Tensor  # (S, 3) float64: the jump, times what the sample stands for, is the sum of factor · radiance
    by_k: Tensor  # (S, 14) float64, the curve's velocity by K in rows and the distortion
    row_of: Tensor  # (R,) int64, the sample of a row
    vertex: Tensor  # (R,) int64
    by_q: Tensor  # (R, 3) float64, the curve's velocity by a vertex in camera coordinates


def _record(kind: Any, arrays: dict[str, np.ndarray]) -> Any:
    tensors = (torch.from_numpy(arrays[name]) for name in kind._fields)
    return kind(*(t.long() if t.dtype == torch.int32 else t for t in tensors))


class _Values(torch.autograd.Function):
    """What `compute` makes of the values of tensors, whatever transforms of torch.func are under way."""

    @staticmethod
    def forward(compute: Callable[..., Sequence[Tensor]], *tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(compute(*tensors))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output)
        ctx.counts = len(inputs), len(output)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> tuple[None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return (None,) * ctx.counts[0]

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        return (None,) * ctx.counts[1]

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Any, Any]:
        if any(dim is not None for dim in in_dims):
            raise RuntimeError(
                "torch.vmap: expected one scene and one camera for all of a batch where a shader is given, for each of them "
                "has samples of its own number; render them one by one, or batch the shader's own tensors"
            )
        output = _Values.apply(*args)
        return output, (None,) * len(output)


def _of_values(request: Request, compute: Callable[[Request], Sequence[Tensor]]) -> tuple[Tensor, ...]:
    packed = request.pack()
    places = [i for i, value in enumerate(packed) if isinstance(value, Tensor)]

    def with_values(*tensors: Tensor) -> Sequence[Tensor]:
        values = list(packed)
        for i, tensor in zip(places, tensors, strict=True):
            values[i] = tensor.detach()
        return compute(Request.unpack(values))

    return _Values.apply(with_values, *(packed[i] for i in places))


class Sampler:
    """The samples of one camera of a request."""

    def __init__(self, request: Request, camera: int) -> None:
        self._request, self._camera = request, camera
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

    def pixel_hits(self, at_once: int) -> Iterator[PixelHits]:
        """Those of the image, some `at_once` rows of pixels after another."""
        height, width = self._request.camera.height, self._request.camera.width
        rows = max(1, at_once // (width * min(self._request.image.spp, 4)))
        for first in range(0, height, rows):
            end = min(height, first + rows)

            def compute(request: Request, first: int = first, end: int = end) -> PixelHits:
                options = request.image._replace(seed=camera_seed(request.image.seed, self._camera))
                camera = kernel_camera(request.camera, self._camera)
                if first == 0:
                    warn_of_ends([camera])
                found = kernel_scene(request.scene).pixel_hits(
                    camera=camera,
                    options=core.ImageOptions(**options._asdict()),
                    threads=torch.get_num_threads(),
                    first=first,
                    end=end,
                    hits=kernel_hits(self._hits),
                )
                return _record(PixelHits, found)

            yield PixelHits(*_of_values(self._request, compute))

    def samples(self, scene: Request, interior: bool, boundary: bool) -> tuple[SurfaceSamples, CurveSamples]:
        """Of the gradient, after all pixel hits were taken; `scene` has colours that jump where creases are."""

        def compute(request: Request) -> Sequence[Tensor]:
            flat, options = request.scene, request.gradient
            surface, curves = kernel_scene(flat).samples(
                camera=kernel_camera(request.camera, self._camera),
                image=core.ImageOptions(**request.image._asdict()),
                options=core.GradientOptions(
                    seed=camera_seed(options.grad_seed, self._camera),
                    surface_samples=options.surface_samples,
                    edge_samples=options.edge_samples,
                    interior_geometry=interior,
                    boundary=boundary,
                ),
                threads=torch.get_num_threads(),
                adjoint=np.ones((*self.coverage.shape, flat.background.shape[-1]), self.coverage.numpy().dtype),
                hits=kernel_hits(self._hits),
            )
            return (*_record(SurfaceSamples, surface), *_record(CurveSamples, curves))

        parts = _of_values(scene, compute)
        count = len(SurfaceSamples._fields)
        return SurfaceSamples(*parts[:count]), CurveSamples(*parts[count:])


class Footprints(NamedTuple):
    """The pixels whose filter reaches points of the image."""

    point: Tensor  # (P,) int64
    pixel: Tensor  # (P,) int64
    weight: Tensor  # (P,) float64: the filter there

    @classmethod
    def of(cls, x: Tensor, request: Request) -> Footprints:
        """Of points x (S, 2)."""
        camera = request.camera

        def compute(x: Tensor) -> tuple[Tensor, ...]:
            parts = core.footprints(x.contiguous().numpy(), request.image.filter, camera.width, camera.height)
            return tuple(map(torch.from_numpy, parts))

        return cls(*_Values.apply(compute, x))
