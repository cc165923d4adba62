"""Images of several scenes, rendered and differentiated in parallel."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from .autograd import FIRST_ORDER
from .operators import HitBuffers, backward_kernel, forward_kernel
from .request import IS_TENSOR, POSITIONS, SLOTS, Request, join, others_of, tensors_of
from .threads import parallel_map

WIDTH = len(IS_TENSOR)  # arguments of a packed request


def render_images(requests: Iterable[Request], count: int) -> list[Tensor]:
    """Return the image (H, W, C) of each of `count` requests, as functions of their tensors. Requests are rendered while others
    are made. The bits, also of gradients, are those of one image after another."""
    made: list[Request] = []

    def remembered() -> Iterator[Request]:
        for request in requests:
            made.append(request)
            yield request

    found = parallel_map(forward_kernel, remembered(), count)
    # Backward passes of single images run from the last to the first, and so are sums over them of what scenes share.
    packed = [value for request in reversed(made) for value in request.pack()]
    return list(reversed(_RenderBatch.apply(found[::-1], *packed)))  # pyright: ignore[reportArgumentType, reportCallIssue]


class _RenderBatch(torch.autograd.Function):
    """Images of forward_kernel() as functions of requests, which are packed one after the other."""

    @staticmethod
    def forward(ctx: Any, found: list[Any], *packed: Any) -> tuple[Tensor, ...]:
        parts = [packed[k : k + WIDTH] for k in range(0, len(packed), WIDTH)]
        kept = [[*hits, *tensors_of(part)] for (_, hits, _), part in zip(found, parts, strict=True)]
        ctx.save_for_backward(*(tensor for group in kept for tensor in group))
        ctx.sizes, ctx.others = [len(group) for group in kept], [others_of(part) for part in parts]
        ctx.set_materialize_grads(False)
        return tuple(image[0] for image, _, _ in found)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        if torch.is_grad_enabled():
            raise RuntimeError(FIRST_ORDER)
        groups = _split(ctx.saved_tensors, ctx.sizes)
        needed = ctx.needs_input_grad[1:]
        wanted = [[i for i in POSITIONS if needed[k * WIDTH + i]] for k in range(len(groups))]

        def gradients(k: int) -> dict[int, Tensor]:
            bar = grad_outputs[k]
            if bar is None or not wanted[k]:
                return {}
            coverage, depth, hit, seen, *tensors = groups[k]
            request = Request.unpack(join(tensors, ctx.others[k]))
            names = {i: name for i, name in zip(POSITIONS, SLOTS, strict=True) if i in wanted[k]}
            found, _ = backward_kernel(bar[None], HitBuffers(coverage, depth, hit, seen), request, list(names.values()))
            return {i: found[name].to(request.slot(name).dtype) for i, name in names.items()}

        out: list[Tensor | None] = [None] * (WIDTH * len(groups))
        for k, found in enumerate(parallel_map(gradients, range(len(groups)), len(groups))):
            for i, grad in found.items():
                out[k * WIDTH + i] = grad
        return None, *out


def _split(tensors: Sequence[Tensor], sizes: Sequence[int]) -> list[Sequence[Tensor]]:
    out, first = [], 0
    for size in sizes:
        out.append(tensors[first : first + size])
        first += size
    return out
