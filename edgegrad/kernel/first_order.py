"""Operations of the kernel as functions of tensors with first derivatives, in reverse and in forward mode, also under the
transforms of torch.func."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.autograd.graph import get_gradient_edge

from .autograd import FIRST_ORDER, _one_by_one
from .derivatives import is_eager, transformed

Tensors = Sequence[Tensor | None]


class Operation(Protocol):
    """A function of tensors, with its value, its cotangents and its tangent."""

    @property
    def moving(self) -> Sequence[int]:
        """Return which of the tensors have derivatives."""
        ...

    def value(self, tensors: Tensors) -> tuple[Tensor, ...]:
        """Return the result, and further tensors that the derivatives need and that have none."""
        ...

    def vjp(self, bar: Tensor, wanted: Sequence[bool], kept: Tensors, tensors: Tensors) -> Sequence[Tensor]:
        """Return the cotangents of the moving tensors from that of the result. Those that are not wanted may be anything."""
        ...

    def jvp(self, tangents: Tensors, kept: Tensors, tensors: Tensors) -> Tensor:
        """Return the tangent of the result from those of the moving tensors."""
        ...


def apply(operation: Operation, tensors: Tensors) -> tuple[Tensor, ...]:
    """Return what value() returns, with derivatives."""
    return _Value.apply(operation, *tensors)  # pyright: ignore[reportReturnType]


def without_derivatives(compute: Callable[..., Sequence[Tensor]], *tensors: Tensor) -> tuple[Tensor, ...]:
    """Return compute() of the values of tensors, whatever transforms of torch.func are under way."""
    if is_eager():
        with torch.no_grad():
            return tuple(compute(*(tensor.detach() for tensor in tensors)))
    return _Values.apply(compute, *tensors)  # pyright: ignore[reportReturnType]


def unreached(result: Tensor, tensors: Iterable[Tensor]) -> list[Tensor]:
    """Return the tensors that require a gradient and get none from the result, not even of zeros."""
    wanting = [tensor for tensor in tensors if tensor.requires_grad]
    if transformed() or not result.requires_grad:
        return wanting
    edges: set[Any] = set()
    waiting: list[Any] = [get_gradient_edge(result)[:2]]
    while waiting:
        edge = node, _ = waiting.pop()
        if node is None or edge in edges:
            continue
        edges.add(edge)
        inputs = node.next_functions
        waiting += inputs if not hasattr(node, "of_moving") else [inputs[k] for k in node.of_moving]
    return [tensor for tensor in wanting if get_gradient_edge(tensor)[:2] not in edges]


class _Values(torch.autograd.Function):
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


class _Value(torch.autograd.Function):
    @staticmethod
    def forward(operation: Operation, *tensors: Any) -> tuple[Tensor, ...]:
        return operation.value(tensors)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        operation, *tensors = inputs
        kept = output[1:]
        ctx.mark_non_differentiable(*kept)
        ctx.save_for_backward(*kept, *tensors)
        ctx.save_for_forward(*kept, *tensors)
        ctx.operation, ctx.count, ctx.outputs = operation, len(kept), len(output)
        # Which of the node's edges to inputs are those of moving tensors; what is no tensor has none.
        there = [i for i, tensor in enumerate(tensors) if tensor is not None]
        ctx.of_moving = [k for k, i in enumerate(there) if i in operation.moving]

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        moving = ctx.operation.moving
        wanted = [ctx.needs_input_grad[1 + i] for i in moving]
        grads = _Vjp.apply(ctx.operation, wanted, ctx.count, grad_outputs[0], *ctx.saved_tensors)
        out: list[Tensor | None] = [None] * len(ctx.needs_input_grad)
        for i, want, grad in zip(moving, wanted, grads, strict=True):
            out[1 + i] = grad if want else None
        return tuple(out)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        given = [tangents[1 + i] for i in ctx.operation.moving]
        result = _Jvp.apply(ctx.operation, ctx.count, *given, *ctx.saved_tensors)
        return result, *(None,) * (ctx.outputs - 1)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> Any:
        return _one_by_one(_Value, info.batch_size, in_dims, args)


class _First(torch.autograd.Function):
    """A derivative, which has none of its own."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        raise RuntimeError(FIRST_ORDER)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise RuntimeError(FIRST_ORDER)


class _Vjp(_First):
    @staticmethod
    def forward(operation: Operation, wanted: list[bool], count: int, bar: Tensor, *saved: Any) -> tuple[Tensor, ...]:
        grads = operation.vjp(bar, wanted, saved[:count], saved[count:])
        empty = bar.new_zeros(0)
        return tuple(grad if want else empty for grad, want in zip(grads, wanted, strict=True))

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> Any:
        return _one_by_one(_Vjp, info.batch_size, in_dims, args)


class _Jvp(_First):
    @staticmethod
    def forward(operation: Operation, count: int, *args: Any) -> Tensor:
        moving = len(operation.moving)
        tangents, saved = args[:moving], args[moving:]
        return operation.jvp(tangents, saved[:count], saved[count:])

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> Any:
        return _one_by_one(_Jvp, info.batch_size, in_dims, args)


def array(tensor: Tensor) -> Any:
    """Return a contiguous array of a tensor's values on the CPU."""
    return tensor.detach().cpu().contiguous().numpy()


def doubles(tensor: Tensor | None) -> Any:
    """Return a contiguous array of a tensor's values in double, or None for None."""
    return None if tensor is None else array(tensor.double())
