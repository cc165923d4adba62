"""Borders of what surfaces of paths of light see of one another (csrc/boundary/bounce_source.h): an edge on the line between a
point that sends light and one that receives it.

Where the camera sees the one that receives, the border is a curve in the image. From where it need not, light is followed on to
the camera, by so many steps more:

    δI = Σ_k k(x_k − c) B_k δF        over samples

of borders F = 0, with the light B_k that comes to the place x_k of the image (csrc/shading/lit/towards_camera.h).
"""

from __future__ import annotations

import torch

from ..kernel.derivatives import moves
from ..points.blend import let_through
from ..points.frame import Frame
from ..points.moving import Form, velocity
from ..points.samples import EdgeSamples
from ..points.splat import Term, boundary
from . import in_kernel
from .at_points import Options

AT_ONCE = 1 << 17  # samples whose light is followed together


def bounce_edges(frame: Frame, options: Options) -> list[Term]:
    """What samples on these borders give to the image."""
    if not moves(frame.surfaces.verts, frame.view.world_to_camera, frame.intrinsics):
        return []
    terms = _seen(frame, options)
    if moves(frame.surfaces.verts):  # as the camera moves these stay
        for further in range(1, options.bounces - 1):
            terms += _passed_on(frame, options, further)
    return terms


def _seen(frame: Frame, options: Options) -> list[Term]:
    records, jump, _ = in_kernel.bounce_samples(frame, options, 0)
    if not len(records.x):
        return []
    samples = EdgeSamples(frame, records)
    jump = frame.here(jump).to(frame.dtype)
    if frame.surfaces.scene.blends:
        with torch.no_grad():
            jump = let_through(frame, records)[:, None].to(jump) * jump
    return boundary(samples.x, samples.velocity, jump, None, None)


def _passed_on(frame: Frame, options: Options, further: int) -> list[Term]:
    """By light that is scattered so many times more after the point that receives it."""
    records, carried, origin = in_kernel.bounce_samples(frame, options, further)
    count = len(records.x)
    if not count:
        return []
    moved = velocity(count, [(Form(records.row_of, records.vertex, records.by_q), frame.surfaces.verts)])
    seed = frame.seeds("bounce edges", count).cpu()
    terms = []
    for first in range(0, count, AT_ONCE):
        some = slice(first, first + AT_ONCE)
        arrivals = [part[some] for part in (records.hit_face, records.hit_b, seed, origin, carried)]
        with torch.no_grad():
            found = in_kernel.towards_camera(frame, arrivals, (further, further))
            sample, x, radiance = (frame.here(part) for part in found)
        own = moved.index_select(0, sample + first).to(frame.dtype)
        terms.append(Term(x, own[:, None] * radiance.to(frame.dtype)))
    return terms
