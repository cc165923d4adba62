"""Secondary edges, seen from points of paths of light (csrc/secondary/edge_line_source.h): an edge, or an alpha edge,
on the line between a point that sends light and one that receives it. And curves at which surfaces of paths begin
to send light (csrc/secondary/surface_edges.cpp): where faces pass through each other, and alpha edges as textures move.

Where the camera sees the point that receives, the first are curves in the image. From where it need not, light is followed on to
the camera, by so many steps more:

    δI = Σ_k k(x_k − c) B_k δF        over samples

of borders F = 0, with the light B_k that comes to the place x_k of the image (csrc/shading/lit/light_tracing.h).
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..kernel.derivatives import moves
from ..points.blend import let_through
from ..points.image_context import ImageContext
from ..points.moving import Form, velocity
from ..points.records import CurveRecords, has_intersections
from ..points.samples import EdgeSamples
from ..points.splat import SplatTerm, boundary
from . import in_kernel
from .at_points import LitOptions

SAMPLES_AT_ONCE = 1 << 17  # samples whose light is followed together


def secondary_edges(context: ImageContext, options: LitOptions) -> list[SplatTerm]:
    """Return the terms of samples on secondary edges."""
    surfaces = context.surfaces
    flat = surfaces.casters
    alpha_edges = bool(len(flat.alpha_masks)) and moves(flat.alphas, flat.uvs)
    on_surfaces = moves(surfaces.verts) or alpha_edges  # as the camera moves these stay
    if not (on_surfaces or moves(context.view.world_to_camera, context.intrinsics)):
        return []
    terms = _seen(context, options)
    if on_surfaces:
        for further in range(1, options.bounces - 1):
            terms += _passed_on(
                context, in_kernel.secondary_edge_samples(context, options, further), "secondary edges", further
            )
    crossings = moves(surfaces.verts) and has_intersections(context.request.scene)
    if crossings or alpha_edges:
        for further in range(options.bounces - 1):
            found = in_kernel.surface_edge_samples(context, options, further, crossings, alpha_edges)
            terms += _passed_on(context, found, "surface edges", further)
    return terms


def world_velocity(context: ImageContext, records: CurveRecords) -> list[tuple[Form, Tensor]]:
    """Return how F of samples without a place in the image moves, by vertices in the world and by the textures of alpha."""
    flat = context.surfaces.casters
    return [
        (Form(records.row_of, records.vertex, records.by_q), context.surfaces.verts),
        (Form(records.uv_row_of, records.uv, records.by_uv), flat.uvs),
        (Form(records.alpha_row_of, records.alpha, records.by_alpha[:, None]), flat.alphas[:, :1]),
    ]


def _seen(context: ImageContext, options: LitOptions) -> list[SplatTerm]:
    records, jump, _ = in_kernel.secondary_edge_samples(context, options, 0)
    if not len(records.x):
        return []
    samples = EdgeSamples(context, records)
    jump = context.here(jump).to(context.dtype)
    if context.surfaces.scene.blends:
        with torch.no_grad():
            jump = let_through(context, records)[:, None].to(jump) * jump
    return boundary(samples.x, samples.velocity, jump, None, None)


def _passed_on(
    context: ImageContext, found: tuple[CurveRecords, Tensor, Tensor], kind: str, further: int
) -> list[SplatTerm]:
    """Return the terms by light that is scattered `further` times more after the shading point."""
    records, carried, origin = found
    count = len(records.x)
    if not count:
        return []
    moved = velocity(count, world_velocity(context, records))
    seed = context.seeds(kind, count).cpu()
    terms = []
    for first in range(0, count, SAMPLES_AT_ONCE):
        some = slice(first, first + SAMPLES_AT_ONCE)
        arrivals = [part[some] for part in (records.hit_face, records.hit_b, seed, origin, carried)]
        with torch.no_grad():
            image = in_kernel.towards_camera(context, arrivals, (further, further))
            sample, x, radiance = (context.here(part) for part in image)
        own = context.here(moved).index_select(0, sample + first).to(context.dtype)
        terms.append(SplatTerm(x, own[:, None] * radiance.to(context.dtype)))
    return terms
