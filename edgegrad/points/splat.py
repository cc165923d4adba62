"""Splatting: samples at places in the image, weighted by the pixel filter k and summed in pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..check import check_finite
from ..kernel.first_order import Tensors, apply, array, doubles
from ..kernel.request import Request
from ..kernel.threads import threads
from ..library import core


class SplatTerm(NamedTuple):
    """Σ k(x − c) · weight · value over samples, times what is behind, if anything; only its derivatives count."""

    x: Tensor  # (S, 2)
    values: Tensor  # (S, C), or (S, 1) if anything is behind
    weight: Tensor | None = None  # (S,) float64, or else 1
    behind: Tensor | None = None  # (H · W, C) or (1, C)


def splat(x: Tensor, values: Tensor, request: Request) -> Tensor:
    """Return Σ k(x − c) · value (H · W, C) over points x (S, 2) with values (S, C), for pixels with centres c."""
    return apply(_Splat(Film.from_request(request)), [values, x])[0]


def attached(image: Tensor, terms: Sequence[SplatTerm], request: Request) -> Tensor:
    """Return the image (H · W, C), with the derivatives of terms by their values. It has no second derivatives, for how the
    samples' places and visibility change is not known."""
    values = (term.values for term in terms)
    fixed = (part for term in terms for part in (term.x, term.weight, term.behind))
    return apply(_Attached(Film.from_request(request), len(terms)), [image, *values, *fixed])[0]


class Film(NamedTuple):
    filter: str
    width: int
    height: int

    @classmethod
    def from_request(cls, request: Request) -> Film:
        return cls(request.image.filter, request.camera.width, request.camera.height)

    def sum(self, x: Tensor | None, values: Tensor) -> Tensor:
        """Return (H · W, C)"""
        return torch.from_numpy(core.splat(doubles(x), doubles(values), *self)).to(values)

    def adjoint(self, x: Tensor | None, bar: Tensor, weight: Tensor | None = None) -> Tensor:
        """Return (S, C)"""
        found = core.splat_vjp(doubles(x), array(bar), *self, threads(), doubles(weight))
        return torch.from_numpy(found).to(bar.device)


class _Splat(NamedTuple):
    film: Film

    @property
    def moving(self) -> Sequence[int]:
        return (0,)

    def value(self, tensors: Tensors) -> tuple[Tensor, ...]:
        values, x = tensors
        assert values is not None
        return (self.film.sum(x, values),)

    def vjp(self, bar: Tensor, wanted: Sequence[bool], kept: Tensors, tensors: Tensors) -> Sequence[Tensor]:
        return [self.film.adjoint(tensors[1], bar)]

    def jvp(self, tangents: Tensors, kept: Tensors, tensors: Tensors) -> Tensor:
        (tangent,) = tangents
        assert tangent is not None
        return self.film.sum(tensors[1], tangent)


class _Attached(NamedTuple):
    """Its tensors: the image, the values of each term, then x, weight and what is behind of each term."""

    film: Film
    terms: int

    @property
    def moving(self) -> Sequence[int]:
        return range(1 + self.terms)

    def _fixed(self, tensors: Tensors) -> list[tuple[Tensor | None, ...]]:
        """x, the weight and what is behind."""
        rest = tensors[1 + self.terms :]
        return list(zip(rest[::3], rest[1::3], rest[2::3], strict=True))

    def value(self, tensors: Tensors) -> tuple[Tensor, ...]:
        image = tensors[0]
        assert image is not None
        return (image.clone(),)

    def vjp(self, bar: Tensor, wanted: Sequence[bool], kept: Tensors, tensors: Tensors) -> Sequence[Tensor]:
        check_finite("the gradient of the image", bar.reshape(self.film.height, self.film.width, -1))
        none = bar.new_zeros(0)
        found = [bar.clone() if wanted[0] else none]
        for want, (x, weight, behind) in zip(wanted[1:], self._fixed(tensors), strict=True):
            seen = bar if behind is None or not want else (bar * behind).sum(1, keepdim=True)
            found.append(self.film.adjoint(x, seen, weight) if want else none)
        return found

    def jvp(self, tangents: Tensors, kept: Tensors, tensors: Tensors) -> Tensor:
        image = tensors[0]
        assert image is not None
        total = torch.zeros_like(image) if tangents[0] is None else tangents[0].clone()
        for tangent, (x, weight, behind) in zip(tangents[1:], self._fixed(tensors), strict=True):
            if tangent is not None:
                moved = self.film.sum(x, tangent if weight is None else weight[:, None] * tangent)
                total = total + (moved if behind is None else moved * behind).to(total)
        return total


def boundary(
    x: Tensor, velocity: Tensor, jump: Tensor, to_background: Tensor | None, background: Tensor | None
) -> list[SplatTerm]:
    """Σ k(x − c) ΔL v over samples on curves, with the curve's velocity v, whose value is zero."""
    x, velocity = x.detach(), velocity.to(jump.dtype)[:, None]
    terms = [SplatTerm(x, velocity * jump)]
    if background is not None and to_background is not None:
        behind = background.detach().reshape(-1, jump.shape[1]).to(jump)
        terms.append(SplatTerm(x, velocity * to_background.to(jump.dtype)[:, None], behind=behind))
    return terms
