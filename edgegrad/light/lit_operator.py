"""Images of lit scenes as one function of all tensors of scene and camera, where these show no values: to torch.compile, which
sees one operator, and under torch.vmap, which goes through a batch one by one, for each element has samples of its own number.

Else the graph of an image is that of its samples. Here it is not kept: the derivatives render once more."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..camera.camera import Camera
from ..check import values_visible
from ..kernel.derivatives import check_compiled
from ..kernel.first_order import Tensors, apply
from ..kernel.flat import image_dtype
from ..kernel.request import Request, make_request
from ..sampling import Sampling
from ..scene.scene import CLASSES, Scene
from ..scene.tree import from_text, tensors_in, to_text
from .radiance import Lighting

_CLASSES = (*CLASSES, Camera)


def lit_image(
    lighting: Lighting, scene: Scene, camera: Camera, request: Request, creases: bool | str = "auto"
) -> Tensor:
    """Return the image (H, W, C), or (B, H, W, C) for a batch of cameras, also of tensors without values."""
    image, gradient = request.image, request.gradient
    if values_visible(image.seed, gradient.grad_seed, *tensors_in((scene, camera))):
        return lighting.image(scene, camera, request, creases)
    tensors: list[Tensor] = []
    seeds = image.seed, gradient.grad_seed
    options = image.filter, gradient.visibility, gradient.discontinuity_spacing, creases, lighting.shadows
    recipe = to_text((scene, camera, seeds, options), tensors)
    numbers = image.spp, gradient.surface_samples, gradient.edge_samples, lighting.samples, lighting.bounces
    if not torch.compiler.is_compiling():
        moving = tuple(k for k, tensor in enumerate(tensors) if tensor.is_floating_point())
        return apply(_LitImageOperation(recipe, numbers, moving), tensors)[0]
    check_compiled()
    size = (*(() if camera.batch is None else (request.cameras,)), *camera.size, scene.channels)
    return torch.ops.edgegrad.lit(tensors, recipe, numbers, size, _dtype(scene))


def _dtype(scene: Scene) -> torch.dtype:
    """Return the dtype of the image."""
    if not scene.is_lit:
        return image_dtype(scene)
    return torch.float64 if any(mesh.verts.dtype == torch.float64 for mesh in scene.meshes) else torch.float32


class _LitImageOperation(NamedTuple):
    """The operation (kernel/first_order.py) that renders `tensors`."""

    recipe: str  # what else the scene, the camera and the options are
    numbers: Sequence[int]  # spp, surface samples and edge samples or −1, light samples, bounces
    moving: Sequence[int]

    def image(self, tensors: Sequence[Tensor]) -> Tensor:
        scene, camera, (seed, grad_seed), options = from_text(self.recipe, tensors, _CLASSES)
        filter, visibility, spacing, creases, shadows = options
        spp, *counts, lights, bounces = self.numbers
        surface, edges = (None if count < 0 else count for count in counts)
        sampling = Sampling(surface, edges, lights, spacing, creases, int(grad_seed))
        request = make_request(scene, camera, spp, int(seed), filter=filter, visibility=visibility, sampling=sampling)
        return Lighting(shadows, lights, bounces).image(scene, camera, request, creases)

    def value(self, tensors: Tensors) -> tuple[Tensor, ...]:
        with torch.no_grad():
            return (self.image(_known(tensors)),)

    def vjp(self, bar: Tensor, wanted: Sequence[bool], kept: Tensors, tensors: Tensors) -> Sequence[Tensor]:
        own = [tensor.detach() for tensor in _known(tensors)]
        leaves = [own[k].requires_grad_() for k, want in zip(self.moving, wanted, strict=True) if want]
        with torch.enable_grad():
            found = iter(torch.autograd.grad(self.image(own), leaves, bar))
        return [next(found) if want else bar.new_zeros(0) for want in wanted]

    def jvp(self, tangents: Tensors, kept: Tensors, tensors: Tensors) -> Tensor:
        own = [tensor.detach() for tensor in _known(tensors)]
        given = [(k, tangent) for k, tangent in zip(self.moving, tangents, strict=True) if tangent is not None]

        def image(*moved: Tensor) -> Tensor:
            there = list(own)
            for (k, _), tensor in zip(given, moved, strict=True):
                there[k] = tensor
            return self.image(there)

        return torch.func.jvp(image, tuple(own[k] for k, _ in given), tuple(tangent for _, tangent in given))[1]


def _known(tensors: Tensors) -> list[Tensor]:
    return [tensor for tensor in tensors if tensor is not None]


# -- the operator of torch.compile ----------------------------------------------------------------------------------------

_ARGUMENTS = "Tensor[] tensors, str recipe, SymInt[] numbers"
torch.library.define("edgegrad::lit", f"({_ARGUMENTS}, SymInt[] size, ScalarType dtype) -> Tensor")
torch.library.define("edgegrad::lit_backward", f"(Tensor adjoint, {_ARGUMENTS}, int[] moving) -> Tensor[]")


@torch.library.impl("edgegrad::lit", "CompositeExplicitAutograd")
def _lit(tensors: list[Tensor], recipe: str, numbers: list[int], size: list[int], dtype: torch.dtype) -> Tensor:
    return _LitImageOperation(recipe, numbers, ()).value(tensors)[0].to(dtype)


@torch.library.register_fake("edgegrad::lit")
def _lit_fake(tensors: list[Tensor], recipe: str, numbers: list[int], size: list[int], dtype: torch.dtype) -> Tensor:
    return tensors[0].new_empty(size, dtype=dtype)


@torch.library.impl("edgegrad::lit_backward", "CompositeExplicitAutograd")
def _lit_backward(
    adjoint: Tensor, tensors: list[Tensor], recipe: str, numbers: list[int], moving: list[int]
) -> list[Tensor]:
    return list(_LitImageOperation(recipe, numbers, moving).vjp(adjoint, [True] * len(moving), (), tensors))


@torch.library.register_fake("edgegrad::lit_backward")
def _lit_backward_fake(
    adjoint: Tensor, tensors: list[Tensor], recipe: str, numbers: list[int], moving: list[int]
) -> list[Tensor]:
    return [torch.empty_like(tensors[k]) for k in moving]


def _keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    tensors, ctx.recipe, ctx.numbers, *_ = inputs
    ctx.save_for_backward(*tensors)


def _differentiate(ctx: Any, adjoint: Tensor) -> tuple[list[Tensor | None], None, None, None, None]:
    tensors = list(ctx.saved_tensors)
    moving = [k for k, want in enumerate(ctx.needs_input_grad[0]) if want]
    found = torch.ops.edgegrad.lit_backward(adjoint, tensors, ctx.recipe, ctx.numbers, moving)
    gradients: list[Tensor | None] = [None] * len(tensors)
    for k, gradient in zip(moving, found, strict=True):
        gradients[k] = gradient
    return gradients, None, None, None, None


torch.library.register_autograd("edgegrad::lit", _differentiate, setup_context=_keep)
