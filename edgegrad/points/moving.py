"""Motion at fixed places in the image: barycentrics of hits, and the normal velocity of curves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernel.first_order import Tensors, apply, array, doubles, without_derivatives
from ..kernel.threads import threads
from ..library import core


def barycentrics(
    verts: Tensor, faces: Tensor, face: Tensor, world_to_camera: Tensor, along: Tensor, perspective: bool
) -> Tensor:
    """Return barycentrics (N, 3) float64 where rays meet the planes of faces (N,), rows of faces (F, 3) int32 of verts (V, 3).

    `along` (N, 3) are the directions of rays from the eye in camera coordinates, or, in an orthographic view, points that rays
    along the axis go through. With several rays for each face, one after another, the face is the same for each of them.
    """
    tensors = [verts.cpu().double(), world_to_camera.cpu().double(), along.cpu().double(), faces.cpu(), face.cpu()]
    return apply(_RayPlaneIntersection(perspective), tensors)[0].to(verts.device)


def barycentrics_by(
    verts: Tensor, faces: Tensor, face: Tensor, world_to_camera: Tensor, along: Tensor, by: Tensor, perspective: bool
) -> tuple[Tensor, Tensor]:
    """Return barycentrics() and their derivatives (N, 3, K) where `along` has the derivatives `by` (N, 3, K), without a graph."""
    intersection = _RayPlaneIntersection(perspective)

    def compute(*tensors: Tensor) -> Sequence[Tensor]:
        *moving, by = tensors
        columns = [intersection.jvp((None, None, column), (), moving) for column in by.unbind(-1)]
        return intersection.value(moving)[0], torch.stack(columns, -1)

    tensors = (verts.double(), world_to_camera.double(), along.double(), faces, face, by)
    b, by = without_derivatives(compute, *(t.cpu() for t in tensors))
    return b.to(verts.device), by.to(verts.device)


class _RayPlaneIntersection(NamedTuple):
    """csrc/forward/moving_hits.h"""

    perspective: bool

    @property
    def moving(self) -> Sequence[int]:
        return range(3)

    def _arguments(self, tensors: Tensors) -> dict[str, object]:
        verts, world_to_camera, along, faces, face = map(array, tensors)  # pyright: ignore[reportArgumentType]
        return {
            "hits": core.MovingHits(faces, face, self.perspective),
            "verts": verts,
            "world_to_camera": world_to_camera,
            "along": along,
            "threads": threads(),
        }

    def value(self, tensors: Tensors) -> tuple[Tensor, ...]:
        return (torch.from_numpy(core.barycentrics_of_rays(**self._arguments(tensors))),)

    def vjp(self, bar: Tensor, wanted: Sequence[bool], kept: Tensors, tensors: Tensors) -> Sequence[Tensor]:
        found = core.barycentrics_of_rays_vjp(bar=array(bar), wanted=list(wanted), **self._arguments(tensors))
        return [torch.from_numpy(g) for g in found]

    def jvp(self, tangents: Tensors, kept: Tensors, tensors: Tensors) -> Tensor:
        names = ("verts_dot", "pose_dot", "along_dot")
        given = {name: doubles(tangent) for name, tangent in zip(names, tangents, strict=True)}
        return torch.from_numpy(core.barycentrics_of_rays_jvp(**given, **self._arguments(tensors)))


class Form(NamedTuple):
    """For each sample a linear form of a table (R, K): Σ by · (table − its value)[row] over the entries of the sample."""

    sample: Tensor  # (P,) int64
    row: Tensor  # (P,) int64
    by: Tensor  # (P, K) float64


def velocity(samples: int, forms: Sequence[tuple[Form, Tensor]]) -> Tensor:
    """Return zeros (samples,) float64, whose derivatives are those of the forms by their tables."""
    # One at least, so that an image with nothing in view has a graph too, of zeros.
    forms = [(form, table) for form, table in forms if len(form.sample)] or list(forms[:1])
    tensors: list[Tensor] = [table for _, table in forms]
    for form, table in forms:
        tensors += (part.to(table.device) for part in form)
    return apply(_Velocity(samples, len(forms)), tensors)[0]


class _Velocity(NamedTuple):
    samples: int
    tables: int

    @property
    def moving(self) -> Sequence[int]:
        return range(self.tables)

    def _forms(self, tensors: Tensors) -> list[Form]:
        rest = tensors[self.tables :]
        return [Form(*rest[3 * k : 3 * k + 3]) for k in range(self.tables)]  # pyright: ignore[reportArgumentType]

    def value(self, tensors: Tensors) -> tuple[Tensor, ...]:
        table = tensors[0]
        assert table is not None
        return (torch.zeros(self.samples, dtype=torch.float64, device=table.device),)

    def vjp(self, bar: Tensor, wanted: Sequence[bool], kept: Tensors, tensors: Tensors) -> Sequence[Tensor]:
        grads = []
        for want, form, table in zip(wanted, self._forms(tensors), tensors, strict=False):
            assert table is not None
            if not want:
                grads.append(table.new_zeros(0))
                continue
            parts = (array(form.sample), array(form.row), doubles(form.by), doubles(bar))
            grad = torch.from_numpy(core.form_vjp(*parts, len(table), threads()))
            grads.append(grad.to(table))
        return grads

    def jvp(self, tangents: Tensors, kept: Tensors, tensors: Tensors) -> Tensor:
        (total,) = self.value(tensors)
        for tangent, form in zip(tangents, self._forms(tensors), strict=True):
            if tangent is not None:
                moved = (form.by * tangent.double().index_select(0, form.row)).sum(1)
                total = total.index_add(0, form.sample, moved)
        return total
