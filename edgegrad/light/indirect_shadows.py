"""Borders of lights' shadows on surfaces that light others, whether the camera sees these borders or not: how much light comes
by way of such surfaces changes as the borders move on them.

    δI = Σ_k k(x_k − c) B_k δF        over samples

of a border F = 0 (csrc/secondary/indirect_shadows.cpp), with the light B_k that comes from the surface there to the place x_k of
the image, by so many more steps (csrc/shading/lit/light_tracing.h).
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..kernel.counts import Watch
from ..kernel.derivatives import moves
from ..library import core
from ..points.image_context import ImageContext
from ..points.moving import Form, velocity
from ..points.records import CurveRecords
from ..points.shadows import ShadowLight
from ..points.splat import SplatTerm
from ..sampling import derived_seed
from . import in_kernel
from .bsdf import dot
from .secondary_edges import world_velocity

SAMPLES_AT_ONCE = 1 << 17  # samples whose light is followed together


def indirect_shadows(context: ImageContext, bounces: int, watch: Watch) -> list[SplatTerm]:
    """Return the terms of samples on these boundaries, by light that is scattered `bounces` times at most."""
    request, surfaces, sampler = context.request, context.surfaces, context.sampler
    count = request.gradient.edge_samples
    if count < 0:
        count = core.default_secondary_samples(context.width, context.height, request.image.spp)
    flat = surfaces.casters
    # As the camera moves these boundaries stay.
    moving = moves(surfaces.verts) or (bool(len(flat.alpha_masks)) and moves(flat.alphas, flat.uvs))
    terms: list[SplatTerm] = []
    for index, casting in enumerate(surfaces.scene.casting):
        if moving or ShadowLight.moves(casting):
            seed = derived_seed(sampler.grad_seed, index + 2)
            light = ShadowLight.from_surfaces(surfaces, index, seed)
            records = sampler.shadow_samples(light.parts, seed, count, False, one=True, seen=False)
            watch.count("indirect_shadow_samples", len(records.x))
            terms += _of_light(context, light, records, bounces)
    return terms


def _of_light(context: ImageContext, light: ShadowLight, records: CurveRecords, bounces: int) -> list[SplatTerm]:
    moved = _velocity(context, light, records)
    terms: list[SplatTerm] = []
    for first in range(0, len(records.x), SAMPLES_AT_ONCE):
        with torch.no_grad():
            sample, x, radiance = _towards_camera(
                context, light, records, slice(first, first + SAMPLES_AT_ONCE), bounces
            )
        terms.append(SplatTerm(x, moved.index_select(0, sample).to(radiance.dtype)[:, None] * radiance))
    return terms


def _towards_camera(
    context: ImageContext, light: ShadowLight, records: CurveRecords, some: slice, bounces: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return which samples send light to the camera (M,), to which places of the image (M, 2), and how much (M, C)."""
    face, b = context.here(records.hit_face[some]), context.here(records.hit_b[some])
    seed = context.seeds("indirect shadows", len(records.x))[some]
    hits = context.fixed_hits(face, b, context.here(records.hit_x[some]), seed)
    points, share = light.points(context.here(records.light[some]), context.here(records.light_uv[some]))
    drawn = light.light.shows(points) & points.density.isfinite()
    position = hits.position
    origin = light.light.incident(points, position).expand(len(position), 3)
    # The light that falls on the surface, over the cosine by which the border's measure has been divided.
    cosine = dot(context.fixed.face_normals(face), origin).abs()
    weight = torch.where(drawn, context.here(records.hit_factor[some]) * share * cosine[:, 0].double(), 0.0)
    arriving = light.light.arriving(points, position).expand(len(position), context.fixed.scene.channels)
    carried = torch.where(drawn[:, None], arriving.double() * weight[:, None], 0.0)
    found = in_kernel.towards_camera(context, (face, b, seed, origin.double(), carried), (1, bounces - 1))
    sample, x, radiance = (context.here(part) for part in found)
    return sample + some.start, x, radiance.to(context.dtype)


def _velocity(context: ImageContext, light: ShadowLight, records: CurveRecords) -> Tensor:
    """Return zeros (S,) with the derivatives of F."""
    count, forms = len(records.x), world_velocity(context, records)
    if light.moves(light.light):
        points, _ = light.points(context.here(records.light), context.here(records.light_uv))
        every = torch.arange(count)
        forms.append((Form(every, every, records.by_light), light.light.place(points).double()))
    return context.here(velocity(count, forms))
