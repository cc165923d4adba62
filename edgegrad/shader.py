"""Images of shaders written in PyTorch, with gradients of what moves at silhouettes.

The value of the image and its gradient come from different samples. Those of the image are shaded without a graph. To it two
terms are added whose value is exactly zero: samples inside faces, shaded with a graph at points that move with the scene while
their pixel stays; and samples on curves, shaded without one on both sides, whose jump multiplies the curve's velocity. All of
it is PyTorch, so whatever the shader uses gets its gradient by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ._autograd import FIRST_ORDER
from ._check import values_visible
from ._request import Request
from ._samples import CurveSamples, Footprints, Sampler, SurfaceSamples
from .camera import Camera
from .hits import Hits, Surfaces
from .scene import Flat, Scene

Shader = Callable[[Hits], Tensor]

# Points that a shader is given at once: with three layers of 64 numbers each takes some kilobytes.
AT_ONCE = 1 << 17
CREASES = ("auto", True, False)


def render_shaded(
    scene: Scene, camera: Camera, shader: Shader, request: Request, creases: bool | str, check: bool
) -> Tensor:
    """The image (H, W, C), or (B, H, W, C) for a batch of cameras."""
    if not callable(shader):
        raise TypeError(f"shader: expected a function of Hits, got {type(shader).__name__}")
    if creases not in CREASES or not isinstance(creases, (bool, str)):
        raise ValueError(f'creases: expected "auto", True or False, got {creases!r}')
    images = [
        _Image(scene, camera, shader, request, creases, check, index).render() for index in range(request.cameras)
    ]
    return images[0] if camera.batch is None else torch.stack(images)


class _Image:
    """The image of one camera of a batch."""

    def __init__(
        self,
        scene: Scene,
        camera: Camera,
        shader: Shader,
        request: Request,
        creases: bool | str,
        check: bool,
        index: int,
    ) -> None:
        self._scene, self._shader, self._creases, self._check = scene, shader, creases, check
        packed = request.camera
        self._request = request._replace(scene=_with_attributes(request.scene, request.scene.verts.new_zeros(0)))
        self._sampler = Sampler(self._request, index)
        self._surfaces = Surfaces(scene, packed.world_to_camera[index], packed.perspective)
        self._fixed = self._surfaces.detach()
        self._intrinsics = torch.cat([packed.K[index, :2].reshape(6), packed.distortion[index]])
        self._pixels = packed.height * packed.width
        self._channels: int | None = None

    def render(self) -> Tensor:
        image = self._values()
        if not _differentiates():
            return image
        moving = self._request.gradient.visibility and _moves(
            *(mesh.verts for mesh in self._scene.meshes), self._surfaces.world_to_camera, self._intrinsics
        )
        surface, curves = self._sampler.samples(self._with_creases(), interior=True, boundary=moving)
        zero = self._interior(surface)
        if moving:
            zero = zero + self._boundary(curves)
        return image + _FirstOrder.apply(zero.reshape(image.shape))

    # -- the image -----------------------------------------------------------------------------------------------------

    def _values(self) -> Tensor:
        """The image, without a graph."""
        with torch.no_grad():
            image: Any = 0
            for found in self._sampler.pixel_hits(AT_ONCE):
                b = torch.cat([1 - found.b.sum(1, keepdim=True), found.b], 1)
                hits = Hits(self._fixed, self._here(found.face), self._here(b), self._here(found.x))
                radiance = self._shade(hits).detach()
                weighted = radiance * self._here(found.weight).to(radiance.dtype)[:, None]
                if isinstance(image, int):
                    image = radiance.new_zeros((self._pixels, radiance.shape[1]))
                image = image.index_add(0, self._here(found.pixel), weighted)
        height, width = self._request.camera.height, self._request.camera.width
        coverage = self._here(self._sampler.coverage).to(image.dtype)
        return image.reshape(height, width, -1) + (1 - coverage)[:, :, None] * self._background()

    def _background(self) -> Tensor:
        """(C,) or (H, W, C)."""
        assert self._channels is not None
        background = self._scene.background
        if background is None:
            return self._fixed.verts.new_zeros(self._channels)
        if background.shape[-1] != self._channels:
            raise ValueError(
                f"shader: expected as many channels as the background has, {background.shape[-1]}, got {self._channels}"
            )
        return background.to(self._fixed.verts)

    # -- what is added to it, of the value zero -----------------------------------------------------------------------

    def _interior(self, samples: SurfaceSamples) -> Tensor:
        """(H · W, C): Σ k(x − c) L px² over samples inside faces, less its own value."""
        total = self._fixed.verts.new_zeros((self._pixels, self._channels or 1))
        for first in range(0, len(samples.face), AT_ONCE):
            some = SurfaceSamples(*(part[first : first + AT_ONCE] for part in samples))

            def radiance(some: SurfaceSamples = some) -> Tensor:
                moved = self._intrinsics - self._intrinsics.detach()
                along = some.along + (some.along_by_k @ moved if _moves(self._intrinsics) else 0)
                face, along = self._here(some.face), self._here(along)
                b = self._surfaces.barycentrics(face, along)
                return self._shade(Hits(self._surfaces, face, b, self._here(some.x)))

            # So that memory is that of some points, not of all.
            many = len(samples.face) > AT_ONCE and not _transformed()
            L = checkpoint(radiance, use_reentrant=False) if many else radiance()
            assert isinstance(L, Tensor)
            feet = Footprints.of(some.x, self._request)
            weight = self._here(some.weight[feet.point] * feet.weight).to(L.dtype)[:, None]
            total = total.index_add(0, self._here(feet.pixel), weight * L[self._here(feet.point)])
        return total - total.detach()

    def _boundary(self, samples: CurveSamples) -> Tensor:
        """(H · W, C): Σ k(x − c) ΔL v over samples on curves, with the curve's velocity v, whose value is zero."""
        count = len(samples.x)
        known = samples.face >= 0
        sample, which = known.nonzero(as_tuple=True)
        b = samples.b[sample, which]
        b = torch.cat([1 - b.sum(1, keepdim=True), b], 1)
        face, x = samples.face[sample, which], samples.x[sample]
        jump = self._fixed.verts.new_zeros((count, self._channels or 1))
        factor = samples.factor.to(jump.dtype)
        with torch.no_grad():
            for first in range(0, len(face), AT_ONCE):
                part = slice(first, first + AT_ONCE)
                hits = Hits(self._fixed, self._here(face[part]), self._here(b[part]), self._here(x[part]))
                weighted = self._shade(hits).detach() * self._here(factor[sample[part], which[part]])[:, None]
                jump = jump.index_add(0, self._here(sample[part]), weighted)
        q = self._surfaces.in_camera(self._surfaces.verts)
        q = q - q.detach()
        rows = (self._here(samples.by_q) * q[self._here(samples.vertex)]).sum(1)
        moved = self._intrinsics - self._intrinsics.detach()
        velocity = self._here(samples.by_k @ moved).index_add(0, self._here(samples.row_of), rows).to(jump.dtype)
        feet = Footprints.of(samples.x, self._request)
        point, pixel = self._here(feet.point), self._here(feet.pixel)
        background = self._background().detach()
        behind = background.reshape(self._pixels, -1)[pixel] if background.dim() == 3 else background
        to_background = self._here(torch.where(samples.face == -1, factor, 0).sum(1))
        jumps = jump[point] + to_background[point, None] * behind
        weight = self._here(feet.weight).to(jump.dtype)
        values = (weight * velocity[point])[:, None] * jumps
        return torch.zeros_like(jump.sum(0, keepdim=True)).expand(self._pixels, -1).index_add(0, pixel, values)

    def _with_creases(self) -> Request:
        """The request with colours that jump where the shader may."""
        if self._creases is True:
            self._fixed.jumping.clear()
            _ = Hits(self._fixed, *(self._fixed.faces.new_zeros((0, k)) for k in (1, 3, 2))).face
        with torch.no_grad():
            attributes = self._fixed.crease_attributes() if self._creases else self._fixed.verts.new_zeros(0)
        return self._request._replace(scene=_with_attributes(self._request.scene, attributes.cpu()))

    # -- the shader ----------------------------------------------------------------------------------------------------

    def _shade(self, hits: Hits) -> Tensor:
        """(N, C), checked."""
        radiance = self._checked(self._shader(hits), len(hits))
        if self._check and len(hits) > 1:
            order = torch.randperm(len(hits), generator=torch.Generator().manual_seed(0)).to(radiance.device)
            order = order[: (len(hits) + 1) // 2]
            with torch.no_grad():
                again = self._shader(hits.select(order)).to(radiance.dtype)
            if not torch.allclose(
                again, radiance.detach()[order], rtol=1e-4, atol=1e-5 * float(radiance.detach().abs().max())
            ):
                raise ValueError(
                    "shader: expected a function of each point by itself, got other values for half of the points in "
                    "another order; leave out what mixes points (batch norm, means, sorting) and what is drawn at random"
                )
        return radiance

    def _checked(self, radiance: object, count: int) -> Tensor:
        if not isinstance(radiance, Tensor):
            raise TypeError(f"shader: expected a tensor ({count}, C), got {type(radiance).__name__}")
        if radiance.dim() != 2 or radiance.shape[0] != count or radiance.shape[1] < 1:
            raise ValueError(
                f"shader: expected a row for each hit, ({count}, C), got shape {tuple(radiance.shape)}; a single channel is "
                "value[:, None]"
            )
        if not radiance.is_floating_point():
            raise TypeError(f"shader: expected floating-point numbers, got {radiance.dtype}")
        if self._channels not in (None, radiance.shape[1]):
            raise ValueError(f"shader: expected {self._channels} channels as before, got {radiance.shape[1]}")
        self._channels = radiance.shape[1]
        if values_visible(radiance) and not bool(torch.isfinite(radiance.detach()).all()):
            row = int((~torch.isfinite(radiance.detach())).any(1).nonzero()[0])
            raise ValueError(
                f"shader: expected finite numbers, got {radiance.detach()[row].tolist()} at one of {count} hits; look for "
                "divisions by zero and powers of negative numbers"
            )
        return radiance.to(self._fixed.verts.dtype)

    def _here(self, tensor: Tensor) -> Tensor:
        """On the device of the scene."""
        return tensor.to(self._fixed.verts.device)


def _with_attributes(flat: Flat, attributes: Tensor) -> Flat:
    """The geometry of a scene with these numbers (F, 3, K) for colours."""
    F = len(flat.faces)
    if attributes.numel():
        colors = attributes.reshape(3 * F, -1).to(flat.colors.dtype).contiguous()
        corners = torch.arange(3 * F, dtype=torch.int32).reshape(F, 3)
    else:
        colors, corners = torch.zeros((1, 1), dtype=flat.colors.dtype), torch.zeros((F, 3), dtype=torch.int32)
    return flat._replace(
        corners=corners,
        colors=colors,
        uvs=flat.uvs.new_zeros((0, 2)),
        texels=colors.new_zeros((0, colors.shape[1])),
        textures=flat.textures.new_zeros((0, 3)),
        face_texture=flat.face_texture.new_zeros(0),
        background=colors.new_zeros(colors.shape[1]),
    )


def _transformed() -> bool:
    """Whether a transform of torch.func is under way."""
    functorch: Any = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    return functorch.peek_interpreter_stack() is not None


def _differentiates() -> bool:
    return torch.is_grad_enabled() or _transformed() or torch.autograd.forward_ad._current_level >= 0


def _moves(*tensors: Tensor) -> bool:
    """Whether a derivative by one of them may be asked for."""
    if _transformed():
        return True
    if torch.is_grad_enabled() and any(t.requires_grad for t in tensors):
        return True
    dual = torch.autograd.forward_ad
    return dual._current_level >= 0 and any(dual.unpack_dual(t).tangent is not None for t in tensors)


class _FirstOrder(torch.autograd.Function):
    """The identity, whose derivative has none: that of the samples' places and of their visibility is not known."""

    @staticmethod
    def forward(value: Tensor) -> Tensor:
        return value.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        # With the value, so that a derivative of the gradient by what the image depends on comes by here.
        return _Last.apply(*grad_outputs, *ctx.saved_tensors)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Tensor, Any]:
        return _FirstOrder.apply(*args), in_dims[0]

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        return tangents[0].clone()


class _Last(torch.autograd.Function):
    """The first of its arguments, which has no derivative."""

    @staticmethod
    def forward(grad: Tensor, value: Tensor) -> Tensor:
        return grad.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        raise RuntimeError(FIRST_ORDER)
