"""Whether derivatives may be asked for, in any of torch's ways, and values of which only first ones can be taken."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ._autograd import FIRST_ORDER


def transformed() -> bool:
    """Whether a transform of torch.func is under way."""
    functorch: Any = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    return functorch.peek_interpreter_stack() is not None


def plain() -> bool:
    """Whether tensors are what they seem: neither a transform of torch.func, nor forward mode, nor torch.compile is under way."""
    return not (transformed() or torch.autograd.forward_ad._current_level >= 0 or torch.compiler.is_compiling())


def differentiates() -> bool:
    return torch.is_grad_enabled() or transformed() or torch.autograd.forward_ad._current_level >= 0


def moves(*tensors: Tensor) -> bool:
    """Whether a derivative by one of them may be asked for."""
    if transformed():
        return True
    if torch.is_grad_enabled() and any(t.requires_grad for t in tensors):
        return True
    dual = torch.autograd.forward_ad
    return dual._current_level >= 0 and any(dual.unpack_dual(t).tangent is not None for t in tensors)


def once(value: Tensor) -> Tensor:
    """The same, of which only first derivatives can be taken."""
    return _FirstOrder.apply(value)


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
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Tensor, Any]:
        return _Last.apply(*args), in_dims[0]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        raise RuntimeError(FIRST_ORDER)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise RuntimeError(FIRST_ORDER)
