"""The operators as functions with derivatives, in reverse and in forward mode, also under the transforms of torch.func."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from . import operators  # noqa: F401  defines the operators
from .derivatives import check_compiled
from .request import POSITIONS, SLOTS, Request, join, others_of, tensors_of

FIRST_ORDER = (
    "second derivatives of a rendered image are not available (its gradient is an estimate whose own derivative is not "
    "computed); for curvature use Gauss-Newton, JᵀJ from backward passes over the image, as edgegrad.fit.fit_pose does"
)


def render_image(request: Request, batched: bool) -> Tensor:
    """Return the image (B, H, W, C), or (H, W, C) unless `batched`, as a function of the request's tensors."""
    packed = request.pack()
    check_compiled()
    if not torch.compiler.is_compiling():
        image, *_ = _RenderEager.apply(batched, *packed)
    elif any(tensor.requires_grad for tensor in tensors_of(packed)):
        image, *_ = _Render.apply(batched, *packed)
    else:  # torch.compile of torch 2.9 and before calls the function wrongly
        image, *_ = _Render.forward(batched, *packed)
    return image


def _known_signature(function: Callable[..., Any]) -> Callable[..., Any]:
    """torch inspects the signature of forward() at every call, for a tenth of a millisecond unless it is written down."""
    setattr(function, "__signature__", inspect.signature(function))  # noqa: B010  no attribute that type checkers know
    return function


class _Render(torch.autograd.Function):
    """edgegrad::render, differentiated by edgegrad::render_backward. The image of a single camera loses its batch axis."""

    @staticmethod
    @_known_signature
    def forward(batched: bool, *args: Any) -> tuple[Tensor, ...]:
        image, *hits = torch.ops.edgegrad.render(*args)
        return image if batched else image.squeeze(0), *hits

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        _, *hits = output
        ctx.batched, *packed = inputs
        ctx.mark_non_differentiable(*hits)
        ctx.save_for_backward(*hits, *tensors_of(packed))
        ctx.save_for_forward(*hits, *tensors_of(packed))
        ctx.others = others_of(packed)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        coverage, depth, hit, seen, *tensors = ctx.saved_tensors
        needed = ctx.needs_input_grad  # torch builds it at each access
        wanted = [needed[1 + i] for i in POSITIONS]
        packed = join(tensors, ctx.others)
        arguments = (grad_outputs[0], coverage, depth, hit, seen, *packed)
        if torch.compiler.is_compiling():  # which refuses second derivatives itself
            grads = torch.ops.edgegrad.render_backward(*arguments, wanted)
        else:
            grads = _RenderBackward.apply(*arguments, *wanted)
        out: list[Tensor | None] = [None] * (1 + len(packed))
        for i, want, grad in zip(POSITIONS, wanted, grads, strict=True):
            if want:
                out[1 + i] = grad
        return tuple(out)


class _RenderEager(_Render):
    """_Render with what torch.compile does not trace: inference tensors, and the transforms of torch.func."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        # A tensor that was made in torch.inference_mode() cannot be kept for later, but a copy of it can.
        later = not torch.is_inference_mode_enabled()
        kept = (a.clone() if later and isinstance(a, Tensor) and a.is_inference() else a for a in inputs)
        _Render.setup_context(ctx, tuple(kept), output)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        return _one_by_one(_RenderEager, info.batch_size, in_dims, args)

    @staticmethod
    def jvp(ctx: Any, batched: Any, *tangents: Any) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        coverage, depth, hit, seen, *tensors = ctx.saved_tensors
        given = [tangents[i] for i in POSITIONS]
        packed = join(tensors, ctx.others)
        image_dot = _RenderJvp.apply(coverage, depth, hit, seen, *packed, *given)
        return image_dot if ctx.batched else image_dot.squeeze(0), None, None, None, None


class _RenderJvp(torch.autograd.Function):
    """edgegrad::render_jvp in one direction; torch.vmap over tangents takes all of theirs in one pass."""

    @staticmethod
    @_known_signature
    def forward(*args: Any) -> Tensor:
        *rest, tangents = _with_tangents(args)
        tangents = [None if t is None else t[None] for t in tangents]
        return torch.ops.edgegrad.render_jvp(*rest, tangents, 1)[0]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        raise RuntimeError(FIRST_ORDER)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Tensor, int]:
        *rest, tangents = _with_tangents(args)
        dims = in_dims[len(rest) :]
        if any(isinstance(dim, int) for dim in in_dims[: len(rest)]):  # scenes of their own
            return _one_by_one(_RenderJvp, info.batch_size, in_dims, args)
        tangents = [
            None if t is None else t.expand(info.batch_size, *t.shape) if dim is None else t.movedim(dim, 0)
            for t, dim in zip(tangents, dims, strict=True)
        ]
        return torch.ops.edgegrad.render_jvp(*rest, tangents, info.batch_size), 0

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise RuntimeError(FIRST_ORDER)


def faces_at_centers(request: Request, batched: bool) -> Tensor:
    """Return the face seen through the centre of each pixel, as the flat scene counts them: (B, H, W) int32, −1: none."""
    return _FacesAtCenters.apply(batched, *request.pack())  # pyright: ignore[reportReturnType]


class _FacesAtCenters(torch.autograd.Function):
    """edgegrad::faces_at_centers, which has no derivative."""

    @staticmethod
    @_known_signature
    def forward(batched: bool, *args: Any) -> Tensor:
        faces = torch.ops.edgegrad.faces_at_centers(*args)
        return faces if batched else faces.squeeze(0)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.mark_non_differentiable(output)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Tensor, int]:
        return _one_by_one(_FacesAtCenters, info.batch_size, in_dims, args)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> None:
        return None


def _with_tangents(args: Sequence[Any]) -> list[Any]:
    """Return the last arguments, a tangent for each slot, as one list."""
    return [*args[: -len(SLOTS)], list(args[-len(SLOTS) :])]


class _RenderBackward(torch.autograd.Function):
    """edgegrad::render_backward. A function of its own, so that whoever asks for its derivative hears that there is none:
    once_differentiable takes it for zero where the adjoint is a constant, as it is for a loss linear in the image."""

    @staticmethod
    @_known_signature
    def forward(*args: Any) -> tuple[Tensor, ...]:
        many = len(SLOTS)
        return torch.ops.edgegrad.render_backward(*args[:-many], list(args[-many:]))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        raise RuntimeError(FIRST_ORDER)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        return _one_by_one(_RenderBackward, info.batch_size, in_dims, args)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise RuntimeError(FIRST_ORDER)


def _one_by_one(
    function: type[torch.autograd.Function], count: int, in_dims: tuple[int | None, ...], args: tuple[Any, ...]
) -> Any:
    """torch.vmap of a function, call by call. What is no tensor has no batch axis."""
    results = [
        function.apply(*(a.select(dim, i) if isinstance(dim, int) else a for a, dim in zip(args, in_dims, strict=True)))
        for i in range(count)
    ]
    if isinstance(results[0], Tensor):
        return torch.stack(results), 0
    outputs = tuple(torch.stack(parts) for parts in zip(*results, strict=True))
    return outputs, (0,) * len(outputs)
