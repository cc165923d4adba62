"""The kernel's samples of one camera's image and gradient, for shaders written in PyTorch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..kernel import memory as memory
from ..kernel.derivatives import moves
from ..kernel.flat import Flat
from ..kernel.operators import (
    HitBuffers,
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
from ..kernel.threads import threads
from ..library import core
from ..scene.scene import Scene
from .records import (
    CURVE_BYTES,
    SURFACE_BYTES,
    CurveRecords,
    ImagePointRecords,
    LightParts,
    PixelRecords,
    RayRecords,
    SurfaceRecords,
    apply_to_values,
    double_array,
    record_from,
)


def shaded_memory(
    request: Request, gradient: bool | None = None, textured: bool = False, indirect: bool = False
) -> AbstractContextManager[None]:
    """Raise MemoryError before its block if the image of a shader does not fit, and if an allocation in it fails.

    What the shader itself takes is not known. The samples of the `gradient` count too, by default where gradients are enabled.
    """
    size, options = size_of_values(request), request.gradient
    pixels = request.camera.height * request.camera.width
    needs = core.image_bytes(size, request.cameras)
    if torch.is_grad_enabled() if gradient is None else gradient:
        # By default about half a sample a pixel of surface, one where it is lit and has a texture, and some at edges; four
        # times as many inside where surfaces light each other.
        growth = core.sample_growth(request.image.spp)
        default = int(growth * (4 if indirect else 1) * (pixels if textured else pixels // 2))
        surface = options.surface_samples if options.surface_samples >= 0 else default
        edge = options.edge_samples if options.edge_samples >= 0 else int(growth * pixels) // 8
        needs["samples"] = request.cameras * (SURFACE_BYTES * surface + CURVE_BYTES * edge)
    return memory.room("render with a shader", needs, lambda: _lower(request))


def _lower(request: Request) -> str:
    samples = f"the samples per pixel ({request.image.spp}), with which those of the gradient grow"
    return f"{lower(request)}, {samples}, or what the shader keeps of a point"


def size_of_values(request: Request) -> Any:
    """Return pass_size(), also under transforms of torch.func."""
    found: list[Any] = []

    def keep(packed: Sequence[Any]) -> Sequence[Tensor]:
        found.append(pass_size(Request.unpack(packed)))
        return (torch.zeros(0),)

    apply_to_values(request.pack(), keep)
    return found[0]


def _tensors_of(flat: Flat | None) -> list[Tensor]:
    return [part for part in flat or () if isinstance(part, Tensor)]


def _with_tensors(flat: Flat, tensors: Sequence[Tensor]) -> Flat:
    """Return a flat scene with these tensors in place of its own."""
    values = iter(tensors)
    found: list[Any] = [next(values) if isinstance(part, Tensor) else part for part in flat]
    return Flat(*found)


class Sampler:
    """The samples of one camera of a request."""

    def __init__(self, request: Request, camera: int, least: float) -> None:
        """`least`: the smallest barycentric of points on curves."""
        self._request, self._camera, self._least = request, camera, least
        self.transparent: Tensor | None = None  # (F,) bool: faces that hide no curve, for one sees through them
        self._kept: tuple[list[Any], Flat, Any] | None = None
        height, width, faces = request.camera.height, request.camera.width, len(request.scene.faces)
        dtype = request.scene.colors.dtype
        self._hits = HitBuffers(
            torch.empty((1, height, width), dtype=dtype),
            torch.empty((1, height, width), dtype=torch.float32),
            torch.empty((1, height, width, 2), dtype=torch.int32),
            torch.zeros((1, faces), dtype=torch.uint8),
        )

    @property
    def coverage(self) -> Tensor:
        """Return the coverage (H, W) of pixels, once all pixel hits were taken."""
        return self._hits.coverage[0]

    @property
    def grad_seed(self) -> int:
        return camera_seed(int(self._request.gradient.grad_seed), self._camera)

    @property
    def _transparent(self) -> np.ndarray | None:
        return None if self.transparent is None else self.transparent.cpu().to(torch.uint8).numpy()

    def _scene(self, flat: Flat) -> Any:
        """Return the kernel's scene, checked once: most calls have the same arrays."""
        key = [part.data_ptr() if isinstance(part, Tensor) else part for part in flat]
        if self._kept is None or self._kept[0] != key:
            self._kept = key, flat, kernel_scene(flat)  # `flat` too: else other tensors might get the same addresses
        return self._kept[2]

    def _compute(self, request: Request, compute: Callable[..., Sequence[Tensor]], *more: Tensor) -> tuple[Tensor, ...]:
        """Return compute(request, the kernel's camera, *more), with the values of tensors."""
        by_distortion = moves(request.camera.distortion)

        def with_request(values: list[Any], *more: Tensor) -> Sequence[Tensor]:
            values_of = Request.unpack(values)
            return compute(values_of, kernel_camera(values_of.camera, self._camera, by_distortion), *more)

        return apply_to_values(request.pack(), with_request, *more)

    def pixel_hits(
        self, at_once: int, most: int = 1, only: Tensor | None = None
    ) -> Iterator[tuple[range, PixelRecords]]:
        """Yield ranges of pixels, row by row, and their hits, about `at_once` together.

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
                return record_from(PixelRecords, found)

            yield range(first * width, end * width), PixelRecords(*self._compute(self._request, compute, *places))

    def _image(self, request: Request, camera: Any) -> dict[str, Any]:
        """Return the kernel's arguments for the image."""
        return {
            "camera": camera,
            "image": request.image.for_kernel(self._camera),
            "threads": threads(),
            "hits": kernel_hits(self._hits),
        }

    def lit_image(self, compute: Callable[..., Sequence[Tensor]], *tables: Tensor) -> tuple[Tensor, ...]:
        """Return compute(the kernel's scene, its faces, its arguments for the image, *tables), in place of pixel_hits()."""

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
        discontinuities: bool = False,
        lit: Scene | None = None,
        indirect: bool = False,
        importance: Tensor | None = None,
    ) -> tuple[SurfaceRecords, CurveRecords]:
        """Return samples of the gradient; call it after pixel_hits(). The scene of `request` has colours that differ at creases.

        lit         the scene whose lights shade them
        indirect    whether its surfaces light each other
        importance  (H, W), above zero: how much they are to look at each pixel; None: the same everywhere
        """
        of_pixels = () if importance is None else (importance.to(self._hits.coverage.dtype),)

        def compute(request: Request, camera: Any, *importance: Tensor) -> Sequence[Tensor]:
            flat, options = request.scene, request.gradient
            surface, curves = self._scene(flat).samples(
                camera=camera,
                image=request.image.for_kernel(),
                options=core.GradientOptions(
                    seed=self.grad_seed,
                    surface_samples=options.surface_samples,
                    edge_samples=options.edge_samples,
                    interior_geometry=interior,
                    boundary=boundary,
                    intrinsics=intrinsics,
                    discontinuities=discontinuities,
                    discontinuity_spacing=options.discontinuity_spacing,
                    lit=lit is not None,
                    indirect=indirect,
                ),
                least=self._least,
                threads=threads(),
                hits=kernel_hits(self._hits),
                detailed=faces_with_textures(lit),
                transparent=self._transparent,
                importance=importance[0].cpu().contiguous().numpy() if importance else None,
            )
            return (*record_from(SurfaceRecords, surface), *record_from(CurveRecords, curves))

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
        """Return samples on the boundaries of a light's shadows; call it after pixel_hits().

        samples   how many, −1: the default
        one       with only the point in the light
        casters   the faces that shadow rays meet, where they differ from what the camera sees
        seen      by the camera; else so many on surfaces, seen or not, with velocities by world coordinates and no places x
        """
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
            return record_from(CurveRecords, found)

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
        """Return samples on secondary edges, each with its shading point alone, and the other results of compute(the kernel's
        scene, that of `casters`, the faces, its arguments for curves, *tables). See shadow_samples()."""
        parts, count = _tensors_of(casters), len(tables)

        def with_request(request: Request, camera: Any, *tensors: Tensor) -> Sequence[Tensor]:
            scene = self._scene(request.scene)
            casting = scene if casters is None else kernel_scene(_with_tensors(casters, tensors[count:]))
            arguments = self._of_curves(request, camera, seed, samples, intrinsics)
            found, *more = compute(scene, casting, request.scene.faces, arguments, *tensors[:count])
            return *record_from(CurveRecords, found), *map(torch.from_numpy, more)

        *fields, jump, origin = self._compute(self._request, with_request, *tables, *parts)
        return CurveRecords(*fields), jump, origin

    def _of_curves(self, request: Request, camera: Any, seed: int, samples: int, intrinsics: bool) -> dict[str, Any]:
        """Return the kernel's arguments for samples on curves."""
        return {
            "camera": camera,
            "image": request.image.for_kernel(),
            "options": core.GradientOptions(seed=seed, intrinsics=intrinsics),
            "samples": samples,
            "least": self._least,
            "threads": threads(),
            "hits": kernel_hits(self._hits),
            "transparent": self._transparent,
        }

    def hits_at(self, x: Tensor) -> ImagePointRecords:
        """Return what is seen at places (N, 2) in the image."""

        def compute(request: Request, camera: Any, x: Tensor) -> ImagePointRecords:
            found = self._scene(request.scene).hits_at(camera=camera, x=double_array(x), threads=threads())
            return record_from(ImagePointRecords, found)

        return ImagePointRecords(*self._compute(self._request, compute, x))

    def rays_at(self, x: Tensor, intrinsics: bool = True) -> RayRecords:
        """Return the rays to places (N, 2) in the image, with their derivatives by the intrinsics."""

        def compute(request: Request, camera: Any, x: Tensor) -> RayRecords:
            found = core.rays_at(camera=camera, x=double_array(x), intrinsics=intrinsics, threads=threads())
            return record_from(RayRecords, found)

        return RayRecords(*(part.to(x.device) for part in self._compute(self._request, compute, x)))
