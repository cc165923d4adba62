"""Terms of samples on the discontinuities that a shader declares:

    δI = Σ k(x − c) [L₊ − L₋] δs / |∇ₓs| · weight

over where lines cross the steps s = 0 (discontinuities.py). L₊ and L₋ are the shader's values
with the discontinuity forced to either side.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ..check import values_visible
from ..kernel.counts import Watch
from ..kernel.derivatives import transformed
from .discontinuities import Crossings, Discontinuities, ImagePoints, find_crossings
from .hits import Hits
from .image_context import ImageContext
from .records import RayRecords
from .splat import SplatTerm, boundary

# By which a pixel's filter reaches out of the image, in px.
MARGIN = {"box": 0.0, "tent": 0.5, "gaussian": 1.0}


class DiscontinuityTerms(NamedTuple):
    """The discontinuities of one image, and who declares them."""

    context: ImageContext
    kinds: list[str]
    shade: Callable[[Hits], Tensor]  # (N, C)
    declare: Callable[[Hits], object]  # calls hits.where() and hits.floor(); what it returns is not used
    at_once: int  # points that are shaded together
    spacing: float  # px between the lines along which discontinuities are looked for
    # How far from a discontinuity its sides are shaded, in units of its function: more than 0 for shaders that may look
    # for themselves on which side they are.
    margin: float = 0.0
    shadings: int = 1  # of each crossing, of which the mean counts

    def found(self, watch: Watch) -> list[SplatTerm]:
        crossings = self._crossings()
        watch.count("step_samples", len(crossings.x))
        rays = self.context.rays_at(crossings.x)
        jump, weight = self._jumps(crossings, rays)
        s = self._values_of_scene(crossings, rays)
        return boundary(crossings.x, weight * (s - s.detach()), jump, None, None)

    def _crossings(self) -> Crossings:
        context = self.context

        def at(x: Tensor) -> ImagePoints:
            starts = range(0, max(len(x), 1), self.at_once)
            places = [context.sampler.hits_at(x[k : k + self.at_once]) for k in starts]
            face, part, b = (torch.cat(field) for field in zip(*places, strict=True))
            values = torch.full((len(x), len(self.kinds)), torch.nan, dtype=torch.float64)
            there = (face >= 0).nonzero()[:, 0]
            for some in there.split(self.at_once):
                found = self._values(context.fixed_hits(face[some], b[some], x[some])).detach()
                if not values_visible(found):
                    raise RuntimeError(
                        "torch.vmap: expected declared discontinuities that are the same for all of a batch, for where they lie "
                        "is looked for once; render one by one where s of hits.where() or t of hits.floor() differs"
                    )
                values[some] = found.cpu()
            return ImagePoints(x, face, part, b, values)

        with torch.no_grad():
            size, margin = (context.height, context.width), MARGIN[context.request.image.filter]
            return find_crossings(at, self.kinds, size, margin, self.spacing, context.sampler.grad_seed)

    def _jumps(self, found: Crossings, rays: RayRecords) -> tuple[Tensor, Tensor]:
        """Return L₊ − L₋ (M, C) and the weight over |∇ₓs| (M,), without derivatives."""
        context = self.context
        seeds = context.seeds("discontinuities", self.shadings * len(found.x)).reshape(-1, self.shadings)
        gradient = torch.cat([self._by_place(found, rays, part) for part in self._parts(found)])
        with torch.no_grad():
            jumps = []
            for part in self._parts(found):
                face, b, x = found.face[part], found.b[part], found.x[part]
                aside = self._aside(found, rays, part, gradient[part]) if self.margin else torch.zeros_like(b)
                sums = []
                for seed in seeds[part].unbind(1):
                    before, after = (
                        self.shade(context.fixed_hits(face, b + shift, x, seed, Discontinuities(states[part])))
                        for states, shift in ((found.before, -aside), (found.after, aside))
                    )
                    sums.append((after - before).detach())
                jumps.append(torch.stack(sums).mean(0) if len(sums) > 1 else sums[0])
            jump = torch.cat(jumps) * torch.where(context.here(found.rises), 1.0, -1.0).to(context.dtype)[:, None]
            # |n_x| / |∇s|, and none where s has no direction.
            length = gradient.norm(dim=1)
            across = gradient.gather(1, context.here(found.axis)[:, None])[:, 0].abs()
            weight = context.here(found.weight) * torch.where(length > 0, across / length**2, 0.0)
        return jump, torch.nan_to_num(weight, nan=0.0, posinf=0.0)

    def _aside(self, found: Crossings, rays: RayRecords, part: slice, gradient: Tensor) -> Tensor:
        """Return the change of barycentrics (M, 2) from a discontinuity to the side after it, where its gradient is ∇ₓs."""
        context = self.context
        face, along, by_x = (context.here(t[part]) for t in (found.face, rays.along, rays.along_by_x))
        _, b_by_x = context.fixed_view.barycentrics_by(context.fixed, face, along, by_x)
        squared = (gradient * gradient).sum(1, keepdim=True)
        rises = torch.where(context.here(found.rises), self.margin, -self.margin)[:, None]
        x = torch.where(squared > 0, rises[part] * gradient / squared, 0.0)
        return (b_by_x * x[:, None]).sum(-1)[:, 1:].to(found.b)

    def _values_of_scene(self, found: Crossings, rays: RayRecords) -> Tensor:
        """Return the function (M,) of each crossing's discontinuity, with a graph of vertices and camera."""
        context = self.context
        number = context.here(found.number)[:, None]
        values = []
        for part in self._parts(found):

            def of_scene(part: slice = part) -> Tensor:
                here = RayRecords(*(field[part] for field in rays))
                hits = context.moving_hits(found.face[part], here, found.x[part])
                return self._values(hits).gather(1, number[part])[:, 0]

            many = len(found.x) > self.at_once and not transformed()
            s = checkpoint(of_scene, use_reentrant=False) if many else of_scene()
            assert isinstance(s, Tensor)
            values.append(s)
        return torch.cat(values)

    def _by_place(self, found: Crossings, rays: RayRecords, part: slice) -> Tensor:
        """Return ∇ₓs (M, 2) of each crossing's discontinuity, without derivatives of its own."""
        context = self.context
        number = context.here(found.number[part])[:, None]
        face, along, by_x = (context.here(t[part]) for t in (found.face, rays.along, rays.along_by_x))

        here, b_by_x = context.fixed_view.barycentrics_by(context.fixed, face, along, by_x)

        def sum_of_steps(x: Tensor) -> Tensor:
            b = here + (b_by_x * x[:, None]).sum(-1)
            hits = Hits(
                context.fixed, context.fixed_view, face, b, context.here(found.x[part]) + x, context.sampler.rays_at
            )
            return self._values(hits).gather(1, number).sum()

        zero = along.new_zeros((len(along), 2))
        if transformed():
            return torch.func.grad(sum_of_steps)(zero).detach()
        with torch.enable_grad():
            zero.requires_grad_()
            return torch.autograd.grad(sum_of_steps(zero), zero, materialize_grads=True)[0].detach()

    def _values(self, hits: Hits) -> Tensor:
        """Return the functions (N, K) of all discontinuities."""
        self.declare(hits)
        return torch.stack([values.double() for values in hits._discontinuities.values], 1)

    def _parts(self, found: Crossings) -> list[slice]:
        return [slice(first, first + self.at_once) for first in range(0, max(len(found.x), 1), self.at_once)]
