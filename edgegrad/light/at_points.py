"""Operations of the kernel at points of lit surfaces (csrc/shading/lit), with first derivatives (kernel/first_order.py)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..kernel.first_order import Tensors, array, doubles
from ..kernel.flat import Flat
from ..kernel.operators import kernel_scene
from ..kernel.threads import threads
from ..library import core
from .sampling import DARK


class PointTensors(NamedTuple):
    """Tensors of points, but for their barycentrics and the differences of these from pixel to pixel."""

    face: Tensor  # (N,) int64
    seed: Tensor  # (N,) int64
    index: Tensor | None  # pyright: ignore[reportIncompatibleMethodOverride]: points of a light whose shadow is known
    uv: Tensor | None
    pdf: Tensor | None
    lit: Tensor | None  # (N,) uint8


class LitOptions(NamedTuple):
    """csrc/shading/lit/lit_scene.h."""

    shadows: bool
    samples: int  # points of each light with an extent, for each point that is shaded
    only: int = -1  # the light whose radiance alone is wanted, −1: all
    antithetic: bool = False  # on glossy surfaces points of environments come in sets, for derivatives (antithetic.h)
    dark: float = DARK
    bounces: int = 1  # how often light is scattered on its way, at most
    near: float = 0.0  # world units: derivatives by barycentrics leave out light from nearer (near_field.h)
    only_near_field: bool = False  # whether values are those of that light alone

    @property
    def kernel(self) -> Any:
        return core.LitOptions(**self._asdict())


class AtPoints(NamedTuple):
    """Points of a scene, given as tensors (b, spread, *points, *tables, *flat)."""

    layout: Any  # of the tables (layout.py)
    tables: int  # how many
    forced: int  # the light whose visibility is given, −1: none
    dtype: torch.dtype  # of the vertices
    cutoffs: list[float]  # of the flat scene, whose other fields are tensors
    spacing: list[float]

    @property
    def _first(self) -> int:
        """Return the place of the first table among the tensors."""
        return 2 + len(PointTensors._fields)

    @property
    def moving(self) -> Sequence[int]:
        return 0, 1, *range(self._first, self._first + self.tables)

    def _flat(self, tensors: Tensors) -> Flat:
        arrays = tensors[self._first + self.tables :]
        return Flat(*arrays, cutoffs=self.cutoffs, spacing=self.spacing)  # pyright: ignore[reportArgumentType]

    def kernel(self, tensors: Tensors) -> Any:
        """Return the kernel's scene."""
        return kernel_scene(self._flat(tensors))

    def arguments(self, tensors: Tensors, options: LitOptions) -> dict[str, Any]:
        points = PointTensors(*tensors[2 : self._first])  # pyright: ignore[reportArgumentType]
        arrays = {name: None if t is None else array(t) for name, t in points._asdict().items()}
        b, spread = tensors[:2]
        assert b is not None
        arrays["spread"] = None if spread is None else array(spread)
        tables: list[Any] = list(tensors[self._first : self._first + self.tables])
        return {
            "lit": self.layout.kernel(tables, self._flat(tensors).faces),
            "points": core.LitPoints(b=array(b), forced_light=self.forced, **arrays),
            "options": options.kernel,
            "threads": threads(),
        }

    def zeros(self, tensors: Tensors) -> Tensor:
        """Return zeros (N, C) for radiance that is asked for its derivatives alone."""
        b = tensors[0]
        assert b is not None
        return torch.zeros((len(b), self.layout.channels), dtype=self.dtype)


class Shading(NamedTuple):
    """Radiance (N, C) float64 in direct light (lit.h), and which light samples are seen: (N, K) int8, −1 below the surface.
    Without `values`, zeros with the radiance's derivatives."""

    at: AtPoints
    options: LitOptions
    values: bool

    @property
    def moving(self) -> Sequence[int]:
        return self.at.moving

    def _shade(self, tensors: Tensors) -> tuple[Tensor, Tensor]:
        kernel = self.at.kernel(tensors)
        found, seen = kernel.shade(values=self.values, **self.at.arguments(tensors, self.options))
        return torch.from_numpy(found), torch.from_numpy(seen)

    def value(self, tensors: Tensors) -> tuple[Tensor, ...]:
        return self._shade(tensors) if self.values else (self.at.zeros(tensors),)

    def vjp(self, bar: Tensor, wanted: Sequence[bool], kept: Tensors, tensors: Tensors) -> Sequence[Tensor]:
        arguments = {"bar": doubles(bar), "wanted": list(wanted[2:]), **self.at.arguments(tensors, self.options)}
        if kept:
            (seen,) = kept
            assert seen is not None
            found = core.shade_vjp(seen=array(seen), **arguments)
        else:
            found = self.at.kernel(tensors).trace_and_shade_vjp(**arguments)
        return _cotangents(found, bar)

    def jvp(self, tangents: Tensors, kept: Tensors, tensors: Tensors) -> Tensor:
        seen = kept[0] if kept else self._shade(tensors)[1]
        assert seen is not None
        arguments = self.at.arguments(tensors, self.options)
        return torch.from_numpy(core.shade_jvp(seen=array(seen), **_tangents(tangents), **arguments))


class Indirect(NamedTuple):
    """Radiance (N, C) float64 of light that comes by way of other surfaces (indirect.h). Without `values`, zeros with its
    derivatives. The paths are found again for these."""

    at: AtPoints
    options: LitOptions
    values: bool

    @property
    def moving(self) -> Sequence[int]:
        return self.at.moving

    def value(self, tensors: Tensors) -> tuple[Tensor, ...]:
        if not self.values:
            return (self.at.zeros(tensors),)
        return (torch.from_numpy(self.at.kernel(tensors).indirect(**self.at.arguments(tensors, self.options))),)

    def vjp(self, bar: Tensor, wanted: Sequence[bool], kept: Tensors, tensors: Tensors) -> Sequence[Tensor]:
        arguments = self.at.arguments(tensors, self.options)
        found = self.at.kernel(tensors).indirect_vjp(bar=doubles(bar), wanted=list(wanted[2:]), **arguments)
        return _cotangents(found, bar)

    def jvp(self, tangents: Tensors, kept: Tensors, tensors: Tensors) -> Tensor:
        arguments = self.at.arguments(tensors, self.options)
        return torch.from_numpy(self.at.kernel(tensors).indirect_jvp(**_tangents(tangents), **arguments))


def _cotangents(found: Sequence[Any], bar: Tensor) -> list[Tensor]:
    """Return the cotangents of b, its spread and the tables, in the order of the tensors."""
    tables, *places = found
    none = bar.new_zeros(0)
    return [none if g is None else torch.from_numpy(g) for g in (*places, *tables)]


def _tangents(tangents: Tensors) -> dict[str, Any]:
    b_dot, spread_dot, *rest = (doubles(tangent) for tangent in tangents)
    return {"tangents": rest, "b_dot": b_dot, "spread_dot": spread_dot}
