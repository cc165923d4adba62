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
from ..points.frame import Frame
from ..points.moving import Form, velocity
from ..points.records import CurveRecords, has_intersections
from ..points.samples import EdgeSamples
from ..points.splat import Term, boundary
from . import in_kernel
from .at_points import Options

AT_ONCE = 1 << 17  # samples whose light is followed together


def secondary_edges(frame: Frame, options: Options) -> list[Term]:
    """Return the terms of samples on secondary edges."""
    surfaces = frame.surfaces
    flat = surfaces.casters
    alpha_edges = bool(len(flat.alpha_masks)) and moves(flat.alphas, flat.uvs)
    on_surfaces = moves(surfaces.verts) or alpha_edges  # as the camera moves these stay
    if not (on_surfaces or moves(frame.view.world_to_camera, frame.intrinsics)):
        return []
    terms = _seen(frame, options)
    if on_surfaces:
        for further in range(1, options.bounces - 1):
            terms += _passed_on(
                frame, in_kernel.secondary_edge_samples(frame, options, further), "secondary edges", further
            )
    crossings = moves(surfaces.verts) and has_intersections(frame.request.scene)
    if crossings or alpha_edges:
        for further in range(options.bounces - 1):
            found = in_kernel.surface_edge_samples(frame, options, further, crossings, alpha_edges)
            terms += _passed_on(frame, found, "surface edges", further)
    return terms


def world_velocity(frame: Frame, records: CurveRecords) -> list[tuple[Form, Tensor]]:
    """Return how F of samples without a place in the image moves, by vertices in the world and by the textures of alpha."""
    flat = frame.surfaces.casters
    return [
        (Form(records.row_of, records.vertex, records.by_q), frame.surfaces.verts),
        (Form(records.uv_row_of, records.uv, records.by_uv), flat.uvs),
        (Form(records.alpha_row_of, records.alpha, records.by_alpha[:, None]), flat.alphas[:, :1]),
    ]


def _seen(frame: Frame, options: Options) -> list[Term]:
    records, jump, _ = in_kernel.secondary_edge_samples(frame, options, 0)
    if not len(records.x):
        return []
    samples = EdgeSamples(frame, records)
    jump = frame.here(jump).to(frame.dtype)
    if frame.surfaces.scene.blends:
        with torch.no_grad():
            jump = let_through(frame, records)[:, None].to(jump) * jump
    return boundary(samples.x, samples.velocity, jump, None, None)


def _passed_on(frame: Frame, found: tuple[CurveRecords, Tensor, Tensor], kind: str, further: int) -> list[Term]:
    """Return the terms by light that is scattered `further` times more after the shading point."""
    records, carried, origin = found
    count = len(records.x)
    if not count:
        return []
    moved = velocity(count, world_velocity(frame, records))
    seed = frame.seeds(kind, count).cpu()
    terms = []
    for first in range(0, count, AT_ONCE):
        some = slice(first, first + AT_ONCE)
        arrivals = [part[some] for part in (records.hit_face, records.hit_b, seed, origin, carried)]
        with torch.no_grad():
            image = in_kernel.towards_camera(frame, arrivals, (further, further))
            sample, x, radiance = (frame.here(part) for part in image)
        own = frame.here(moved).index_select(0, sample + first).to(frame.dtype)
        terms.append(Term(x, own[:, None] * radiance.to(frame.dtype)))
    return terms
