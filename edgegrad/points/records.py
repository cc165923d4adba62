"""Records of the kernel's samples as tensors, and what it finds along any rays. These work under the transforms of torch.func."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..kernel.first_order import without_derivatives
from ..kernel.flat import Flat, flatten
from ..kernel.operators import kernel_scene
from ..kernel.threads import threads
from ..scene.scene import Scene


class PixelRecords(NamedTuple):
    """The image's hits: one, or several, of the samples of a pixel on one face stand for all of these."""

    pixel: Tensor  # (N,) int64, row by row
    face: Tensor  # (N,) int64
    b: Tensor  # (N, 2) float64, the last two barycentrics
    x: Tensor  # (N, 2) float64, pixel positions
    weight: Tensor  # (N,) float64, the share of the pixel's samples


class SurfaceRecords(NamedTuple):
    """Samples inside faces."""

    face: Tensor  # (S,) int64
    x: Tensor  # (S, 2) float64, pixel positions
    along: Tensor  # (S, 3) float64, the ray's direction in camera coordinates; in an orthographic view a point on it
    along_by_k: Tensor  # (S, 3, 14) float64, its derivatives by K in rows and the distortion, at fixed x; empty where these stay
    weight: Tensor  # (S,) float64, px² that a sample stands for


class CurveRecords(NamedTuple):
    """Samples on curves where the image may jump."""

    x: Tensor  # (S, 2) float64, pixel positions
    # N points of surfaces there, at most three a sample. The jump, times what a sample stands for, is Σ factor · radiance.
    hit_sample: Tensor  # (N,) int64, the sample of each point
    hit_face: Tensor  # (N,) int64
    hit_side: Tensor  # (N,) int64, its number among the points of the sample
    hit_b: Tensor  # (N, 3) float64, barycentrics
    hit_x: Tensor  # (N, 2) float64, pixel position
    hit_factor: Tensor  # (N,) float64
    to_background: Tensor  # (S,) float64, the factor of what lies behind all surfaces
    by_k: Tensor  # (S, 14) float64, the curve's velocity by K in rows and the distortion; empty where these stay
    row_of: Tensor  # (R,) int64, the sample of a row
    vertex: Tensor  # (R,) int64
    by_q: Tensor  # (R, 3) float64, the curve's velocity by a vertex in camera coordinates
    uv_row_of: Tensor  # (P,) int64, the sample of a row by texture coordinates, of alpha-tested faces
    uv: Tensor  # (P,) int64
    by_uv: Tensor  # (P, 2) float64
    alpha_row_of: Tensor  # (Q,) int64, the sample of a row by texels of alpha
    alpha: Tensor  # (Q,) int64
    by_alpha: Tensor  # (Q,) float64
    transparent_row_of: Tensor  # (P,) int64, the sample of a row by faces through which it is seen
    transparent: Tensor  # (P,) int64
    transparent_b: Tensor  # (P, 2) float64, the last two barycentrics there
    # For borders of shadows alone: the first point is the one in the light, the second the one in the shadow.
    light: Tensor  # (S,) int64, the part of the light
    light_uv: Tensor  # (S, 2) float64, where on it
    by_light: Tensor  # (S, 3) float64, by place in camera coordinates, or by direction towards a light at infinity


class LightParts(NamedTuple):
    """A light as one point, or as triangles."""

    corner: Tensor  # (L, 3, 3) float64: world coordinates, or, at infinity, directions towards it; a point thrice
    chance: Tensor  # (L,) float64 above zero, the probability that a point of the light is drawn there
    face: Tensor  # (L,) int32, the face of the scene; −1: none
    infinite: bool
    extended: bool
    two_sided: bool


class ImagePointRecords(NamedTuple):
    """Points of surfaces that are seen at places in the image."""

    face: Tensor  # (N,) int64, −1: none
    part: Tensor  # (N,) int64, the connected part of the surface, −1: none
    b: Tensor  # (N, 2) float64


class RayRecords(NamedTuple):
    """Rays to places in the image; see SurfaceRecords."""

    along: Tensor  # (N, 3) float64
    along_by_x: Tensor  # (N, 3, 2) float64, by the place
    along_by_k: Tensor  # (N, 3, 14) float64; empty where they are not wanted


class TraceRecords(NamedTuple):
    """Points of surfaces that rays hit."""

    face: Tensor  # (N,) int64, −1: none
    b: Tensor  # (N, 2) float64


# Bytes of a record, and of the rows of curves: four vertices each.
SURFACE_BYTES, CURVE_BYTES = 8 * (1 + 2 + 3 + 3 * 14 + 1), 8 * (2 + 3 + 6 + 3 + 14 + 4 * (1 + 1 + 3))


def barycentrics(b: Tensor) -> Tensor:
    """Return barycentrics (N, 3) from the last two (N, 2)."""
    u, v = b.unbind(-1)
    return torch.stack([1 - (u + v), u, v], -1)


def record_from(kind: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Return a record of this kind from the arrays of its fields."""
    tensors = (torch.from_numpy(arrays[name]) for name in kind._fields)
    return kind(*(t.long() if t.dtype == torch.int32 else t for t in tensors))


def values_of(*tensors: Tensor) -> list[np.ndarray]:
    """Return the values of tensors, also under transforms of torch.func."""
    found: list[np.ndarray] = []

    def keep(*values: Tensor) -> Sequence[Tensor]:
        found.extend(value.detach().cpu().contiguous().numpy() for value in values)
        return (torch.zeros(0),)

    without_derivatives(keep, *tensors)
    return found


def apply_to_values(
    packed: Sequence[Any], compute: Callable[..., Sequence[Tensor]], *more: Tensor
) -> tuple[Tensor, ...]:
    """Return compute(packed, *more), with the values of tensors in place of these."""
    places = [i for i, value in enumerate(packed) if isinstance(value, Tensor)]

    def with_values(*tensors: Tensor) -> Sequence[Tensor]:
        values = list(packed)
        for i, tensor in zip(places, tensors[: len(places)], strict=True):
            values[i] = tensor.detach()
        return compute(values, *(tensor.detach() for tensor in tensors[len(places) :]))

    return without_derivatives(with_values, *(packed[i] for i in places), *more)


def double_array(tensor: Tensor) -> np.ndarray:
    return tensor.cpu().double().contiguous().numpy()


def geometry(scene: Scene, blended: bool = True) -> Flat:
    """Return the surfaces of a scene alone; see flatten()."""
    return with_attributes(flatten(scene, blended=blended))


def with_attributes(flat: Flat, attributes: Tensor | None = None) -> Flat:
    """Return the geometry of a scene with these numbers (F, 3, K) for colours."""
    F = len(flat.faces)
    if attributes is not None and attributes.numel():
        colors = attributes.reshape(3 * F, -1).to(flat.colors.dtype).contiguous()
        corners = torch.arange(3 * F, dtype=torch.int32).reshape(F, 3)
    else:
        colors, corners = torch.zeros((1, 1), dtype=flat.colors.dtype), torch.zeros((F, 3), dtype=torch.int32)
    return flat._replace(
        corners=corners,
        colors=colors,
        uvs=flat.uvs if len(flat.alpha_masks) else flat.uvs.new_zeros((0, 2)),
        texels=colors.new_zeros((0, colors.shape[1])),
        textures=flat.textures.new_zeros((0, 6)),
        face_texture=flat.face_texture.new_zeros(0),
        background=colors.new_zeros(colors.shape[1]),
    )


# -- any rays -----------------------------------------------------------------------------------------------------------


def trace(flat: Flat, origins: Tensor, directions: Tensor, ignored: Tensor | None = None) -> TraceRecords:
    """Return the nearest hits of rays (N, 3). Each passes through one face, `ignored` (N,); −1: none."""

    def compute(values: list[Any], origins: Tensor, directions: Tensor, *ignored: Tensor) -> Sequence[Tensor]:
        found = kernel_scene(Flat(*values)).trace(
            origins=double_array(origins),
            directions=double_array(directions),
            ignored=ignored[0].cpu().int().contiguous().numpy() if ignored else None,
            threads=threads(),
        )
        return record_from(TraceRecords, found)

    more = () if ignored is None else (ignored,)
    return TraceRecords(*apply_to_values(flat, compute, origins, directions, *more))


def visible(flat: Flat, face: Tensor, b: Tensor, to: Tensor, contact: Tensor) -> Tensor:
    """Return whether nothing lies between points of faces and the points `to` (N, 3), but within `contact` (N,) of either:
    (N,) bool."""

    def compute(values: list[Any], face: Tensor, b: Tensor, to: Tensor, contact: Tensor) -> Sequence[Tensor]:
        found = kernel_scene(Flat(*values)).visible(
            face=face.cpu().int().contiguous().numpy(),
            b=double_array(b),
            to=double_array(to),
            contact=double_array(contact),
            threads=threads(),
        )
        return (torch.from_numpy(found).bool(),)

    return apply_to_values(flat, compute, face, b, to, contact)[0].to(face.device)


def has_intersections(flat: Flat) -> bool:
    """Return whether faces pass through each other anywhere."""
    found: list[bool] = []

    def compute(values: list[Any]) -> Sequence[Tensor]:
        found.append(kernel_scene(Flat(*values)).has_intersections(threads()))
        return (torch.zeros(0),)

    apply_to_values(flat, compute)
    return found[0]
