"""Points of an image seen through the filter of its pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ._kernel import core
from ._operator import Tensors, apply, array, doubles
from ._request import Request


def splat(x: Tensor, values: Tensor, request: Request, zero: bool) -> Tensor:
    """(H · W, C): Σ k(x − c) · value over points x (S, 2) with values (S, C), for pixels with centres c; `zero`: zeros with the
    same derivatives by the values."""
    camera = request.camera
    return apply(_Splat(request.image.filter, camera.width, camera.height, zero), [values, x])[0]


class _Splat(NamedTuple):
    filter: str
    width: int
    height: int
    zero: bool

    @property
    def moving(self) -> Sequence[int]:
        return (0,)

    def value(self, tensors: Tensors) -> tuple[Tensor, ...]:
        values, x = tensors
        assert values is not None
        if self.zero:
            return (values.new_zeros((self.height * self.width, values.shape[1])),)
        return (self._sum(values, x),)

    def _sum(self, values: Tensor, x: Tensor | None) -> Tensor:
        found = core.splat(doubles(x), doubles(values), self.filter, self.width, self.height)
        return torch.from_numpy(found).to(values)

    def vjp(self, bar: Tensor, wanted: Sequence[bool], kept: Tensors, tensors: Tensors) -> Sequence[Tensor]:
        found = core.splat_vjp(
            doubles(tensors[1]), array(bar), self.filter, self.width, self.height, torch.get_num_threads()
        )
        return [torch.from_numpy(found).to(bar)]

    def jvp(self, tangents: Tensors, kept: Tensors, tensors: Tensors) -> Tensor:
        (tangent,) = tangents
        assert tangent is not None
        return self._sum(tangent, tensors[1])
