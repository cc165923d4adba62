"""Images of shaders written in PyTorch, with gradients of what moves at silhouettes and at declared discontinuities.

The value of the image and its gradient come from different samples. Those of the image are shaded without a graph, several of a
face where discontinuities run through a pixel. Terms are attached to it of which only the derivatives count (points/splat.py):

- samples inside faces, shaded with a graph, at points that move with the scene while their pixel stays;
- samples on curves, shaded without a graph on both sides; the jump multiplies the curve's velocity;
- samples on the discontinuities that the shader declares.

All of it is PyTorch, so whatever the shader uses gets its gradient by itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad
from torch.utils.checkpoint import checkpoint

from .camera.camera import Camera
from .check import all_finite, values_visible
from .kernel.counts import Watch
from .kernel.derivatives import differentiates, moves, transformed
from .kernel.request import Request
from .library import core
from .points.background import environments
from .points.blend import Blended, let_through, transparent
from .points.discontinuities import UNEQUAL
from .points.discontinuity_terms import DiscontinuityTerms
from .points.discontinuous_pixels import DiscontinuousPixels
from .points.hits import Hits
from .points.image_context import ImageContext
from .points.records import PixelRecords, with_attributes
from .points.sampler import shaded_memory
from .points.samples import EdgeSamples, SurfaceSamples
from .points.shadows import ShadowLight
from .points.splat import SplatTerm, boundary
from .points.surfaces import every_face
from .sampling import LEAST_SPACING, derived_seed
from .scene.mesh_light import MeshLight
from .scene.scene import Scene
from .warnings import warn

Shader = Callable[[Hits], Tensor]

# Points that a shader is given at once: with three layers of 64 numbers each takes some kilobytes.
POINTS_AT_ONCE = 1 << 17
# So many samples of a pixel on one face are shaded at one of them: a face once at the usual number, and more often the more
# there are, so that what shading leaves of noise falls with them too.
SAMPLES_A_POINT = 16


def points_of_face(spp: int) -> int:
    """Return how many points of a face are shaded in a pixel with so many samples."""
    return max(1, spp // SAMPLES_A_POINT)


class ShadingTraits(NamedTuple):
    """Properties of a way of shading: how many points it takes, and what the renderer may rely on."""

    points: int = 1  # of a face in a pixel that are shaded
    blended: bool = False  # whether one may see through surfaces
    lit: bool = False  # whether the scene's materials and lights shade them
    indirect: bool = False  # whether surfaces light each other
    # Whether radiance has peaks, as highlights are: samples of the gradient then look where it is bright or changes.
    glossy: bool = False
    keeps_little: bool = False  # whether its graph is small: else it is computed again in the backward pass
    gives_derivatives: bool = False  # whether it leaves out values where Hits._needs_values is False
    # By which lines that look for discontinuities lie closer, for what is shaded next to them is noisy.
    closer: float = 1.0
    noisy: bool = False  # whether points of lights, or paths, are drawn at random
    additive: bool = False  # whether it is a sum over lights, and gives one alone for Hits._only_light
    discontinuity_margin: float = 0.0  # how far from a discontinuity its sides are shaded

    @property
    def at_once(self) -> int:
        """Return points of the image that are shaded together."""
        return 2 * POINTS_AT_ONCE if self.keeps_little else POINTS_AT_ONCE


class Radiance:
    """The radiance at hits, and what else an image may ask of it. A user's shader gives the radiance alone: see UserShader."""

    declares_discontinuities = False  # whether declare() declares its discontinuities; else shading does

    def __call__(self, hits: Hits) -> Tensor:
        """Return the radiance (N, C)."""
        raise NotImplementedError

    def image(self, context: ImageContext) -> Tensor | None:
        """Return the image (H · W, C) before black by one call of the kernel, or None: then points are shaded one by one."""
        return None

    def declare(self, hits: Hits) -> None:
        """Declare the discontinuities without shading."""

    def near_field(self, context: ImageContext, hits: Hits) -> tuple[float, Tensor] | None:
        """Return how near light changes as samples slide on faces, and that change (N, C); see light/near_field.py."""
        return None

    def indirect(self, context: ImageContext, watch: Watch) -> list[SplatTerm]:
        """Return the terms of samples on the borders of light that surfaces scatter to one another."""
        return []


class UserShader(Radiance):
    """A user's function of hits."""

    def __init__(self, shader: Shader) -> None:
        self._shader = shader

    def __call__(self, hits: Hits) -> Tensor:
        return self._shader(hits)


def render_shaded(
    scene: Scene,
    camera: Camera,
    shader: Shader,
    request: Request,
    creases: bool | str,
    traits: ShadingTraits | None = None,
    watch: Watch = Watch(),  # noqa: B008  it keeps nothing
) -> Tensor:
    """Return the image (H, W, C), or (B, H, W, C) for a batch of cameras; see ShadingTraits and Radiance. `watch` is told what it
    takes."""
    if not callable(shader):
        raise TypeError(f"shader: expected a function of Hits, got {type(shader).__name__}")
    if not values_visible(request.image.seed):
        raise RuntimeError(
            "seed: expected one of all elements of a torch.vmap batch where a shader is given, got one of each; give seed=, "
            'or torch.vmap(…, randomness="same")'
        )
    radiance = shader if isinstance(shader, Radiance) else UserShader(shader)
    traits = traits or ShadingTraits(points_of_face(request.image.spp), blended=scene.blends)
    textured = traits.lit and scene.textured_faces is not None
    with shaded_memory(request, textured=textured, indirect=traits.indirect):
        images = [
            _Image(ImageContext(scene, request, k), radiance, creases, traits, watch).render()
            for k in range(request.cameras)
        ]
    return images[0] if camera.batch is None else torch.stack(images)


def _where_bright(image: Tensor) -> Tensor | None:
    """Return (H, W), above zero: how bright the pixels of an image (H, W, C) are over the mean, how much that changes from one
    to the next, for there highlights move, and a little the same for all; None if all are black."""
    size = image.detach().double().abs().mean(2)
    mean = size.mean()
    if not mean > 0:
        return None
    size = size / mean
    near = pad(size[None], (1, 1, 1, 1), mode="replicate")[0]
    across, down = near[1:-1, 2:] - near[1:-1, :-2], near[2:, 1:-1] - near[:-2, 1:-1]
    return size + 0.5 * torch.hypot(across, down) + 0.2


class _Image:
    """The image of one camera of a batch."""

    def __init__(
        self,
        context: ImageContext,
        radiance: Radiance,
        creases: bool | str,
        traits: ShadingTraits,
        watch: Watch = Watch(),  # noqa: B008  it keeps nothing
    ) -> None:
        self._context, self._creases, self._traits, self._watch = context, creases, traits, watch
        self._radiance = radiance
        # (C,) or (H, W, C): the scene's background, or the environments that it shows. Found here, where derivatives are
        # enabled if they are asked for; the values of an image are found without.
        background = context.surfaces.scene.background
        self._behind_all = environments(context) if background is None else background
        self._shader: Shader = radiance
        if traits.blended:
            self._shader = Blended(context, radiance, self._behind_all)
            context.sampler.transparent = transparent(context.surfaces)
        self._channels: int | None = None
        self._kinds: list[str] | None = None  # of the discontinuities that the shader declares
        self.discontinuities_move = radiance.declares_discontinuities  # whether one of their functions has a derivative

    def render(self) -> Tensor:
        watch = self._watch
        with watch.part("image"):
            image = self._values()
        if not differentiates():
            return image
        if self._radiance.declares_discontinuities:
            none = self._context.no_hits
            self._radiance.declare(none)
            self._kinds = list(none._discontinuities.kinds)
        context = self._context
        visibility = context.request.gradient.visibility
        moving = visibility and moves(context.surfaces.verts, context.view.world_to_camera, context.intrinsics)
        flat = context.request.scene
        cut = visibility and flat.has_discontinuities and (moving or moves(flat.uvs, flat.alphas))
        with watch.part("samples"):
            surface, curves = context.sampler.samples(
                self._with_creases(),
                interior=True,
                boundary=moving,
                intrinsics=moves(context.intrinsics),
                discontinuities=cut,
                lit=context.surfaces.scene if self._traits.lit else None,
                indirect=self._traits.indirect,
                importance=_where_bright(image) if self._traits.glossy else None,
            )
        watch.count("surface_samples", len(surface.x))
        with watch.part("surface shading"):
            terms = self._interior(SurfaceSamples(context, surface))
        if moving or cut:
            watch.count("edge_samples", len(curves.x))
            with watch.part("edge shading"):
                terms += self._boundary(EdgeSamples(context, curves))
        if visibility and self._kinds and self.discontinuities_move:
            with watch.part("discontinuities"):
                declare = self._radiance.declare if self._radiance.declares_discontinuities else self._shade
                margin = self._traits.discontinuity_margin
                spacing, shadings = self._grid
                found = DiscontinuityTerms(
                    context, self._kinds, self._shade, declare, POINTS_AT_ONCE, spacing, margin, shadings
                )
                terms += found.found(watch)
        if visibility:
            with watch.part("shadows"):
                terms += self._shadows()
            terms += self._radiance.indirect(context, watch)
        return context.attached(image, terms)

    # -- the image -----------------------------------------------------------------------------------------------------

    def _values(self) -> Tensor:
        """Return the image, without a graph of its surfaces."""
        context = self._context
        with torch.no_grad():
            image = self._radiance.image(context)
            if image is None:
                image = self._point_by_point()
            self._channels = image.shape[1]
        return context.composed(image, self._background)

    def _point_by_point(self) -> Tensor:
        """Return (H · W, C) what surfaces add to the image."""
        context = self._context
        points = self._traits.points
        discontinuous = DiscontinuousPixels((context.height, context.width), points)
        parts: list[Tensor] = []
        for pixels, found in context.sampler.pixel_hits(self._traits.at_once, points):
            seeds = context.seeds_of_pixels("image", found.pixel, points)
            sums, hits = self._shaded(found, pixels, seeds)
            parts.append(sums)
            discontinuous.add(found.pixel, hits)
        image = torch.cat(parts)
        again, most = discontinuous.found() if context.request.image.spp > 1 else (None, 1)
        if again is None or not bool(again.any()):
            return image
        parts = []
        for pixels, found in context.sampler.pixel_hits(self._traits.at_once, most, again):
            seeds = context.seeds_of_pixels("image again", found.pixel, most)
            parts.append(self._shaded(found, pixels, seeds)[0])
        return torch.where(context.here(again).reshape(-1, 1), torch.cat(parts), image)

    def _shaded(self, found: PixelRecords, pixels: range, seeds: Tensor) -> tuple[Tensor, Hits]:
        """Return (pixels, C) what hits add to the image, and the hits."""
        context = self._context
        hits = context.fixed_hits(found.face, found.b, found.x, seeds)
        radiance = self._shade(hits).detach()
        weighted = radiance * context.here(found.weight).to(radiance.dtype)[:, None]
        return context.image(found.pixel, weighted, pixels), hits

    @cached_property
    def _background(self) -> Tensor | None:
        """Return the background, of as many channels as the shader gives."""
        background = self._behind_all
        if background is not None and background.shape[-1] != self._channels:
            raise ValueError(
                f"shader: expected as many channels as the background has, {background.shape[-1]}, got {self._channels}"
            )
        return None if background is None else background.to(self._context.dtype)

    # -- what its derivatives are those of ----------------------------------------------------------------------------

    def _interior(self, samples: SurfaceSamples) -> list[SplatTerm]:
        """Return the terms Σ k(x − c) L px² over samples inside faces."""
        terms: list[SplatTerm] = []
        at_once = self._traits.at_once
        # Once at least, so that an image with nothing in view has a graph too, of zeros.
        for first in range(0, max(len(samples), 1), at_once):
            some = samples.part(first, first + at_once)

            def radiance(first: int = first) -> Tensor:
                # Hits of its own each time, for these keep what was computed from them.
                hits = samples.part(first, first + at_once).hits
                hits._needs_values = not self._traits.gives_derivatives
                if (change := self._radiance.near_field(self._context, hits)) is None:
                    return self._shade(hits)
                hits._near, term = change
                return self._shade(hits) + term

            # So that memory is that of some points, not of all.
            many = len(samples) > at_once and not transformed() and not self._traits.keeps_little
            L = checkpoint(radiance, use_reentrant=False) if many else radiance()
            assert isinstance(L, Tensor)
            terms.append(some._term(L))
        return terms

    def _shadows(self) -> list[SplatTerm]:
        """Return the terms of samples on the boundaries of the shadows that the shader asked for."""
        context = self._context
        terms: list[SplatTerm] = []
        count, flat = context.request.gradient.edge_samples, context.surfaces.casters
        moving = moves(context.surfaces.verts, context.view.world_to_camera, context.intrinsics)
        if len(flat.alpha_masks) and moves(flat.alphas, flat.uvs):
            moving = True
            _warn_of_lights(context)
        for index in sorted(context.surfaces.shadowing):
            seed = derived_seed(context.sampler.grad_seed, index + 2)
            light = ShadowLight.from_surfaces(context.surfaces, index, seed)
            if moving or ShadowLight.moves(light.light):
                one = self._traits.additive
                casters = context.fixed.casters if context.surfaces.scene.blends else None
                records = context.sampler.shadow_samples(
                    light.parts, seed, count, moves(context.intrinsics), one, casters
                )
                self._watch.count("shadow_samples", len(records.x))
                if len(records.x):
                    terms += self._boundary(EdgeSamples(context, records, light, one))
        return terms

    def _boundary(self, samples: EdgeSamples) -> list[SplatTerm]:
        """Σ k(x − c) ΔL v over samples on curves, with the curve's velocity v, whose value is zero."""
        at_once = self._traits.at_once
        parts = [self._context.fixed.verts.new_zeros((0, self._channels or 1))]
        with torch.no_grad():
            for first in range(0, len(samples.hits), at_once):
                points = samples.hits
                if len(points) > at_once:
                    points = points._subset(slice(first, first + at_once))
                parts.append(self._shade(points).detach())
            jump, to_background = samples.sum(torch.cat(parts[1:] or parts)), samples.to_background
            if self._traits.blended:
                through = let_through(self._context, samples._records)
                jump, to_background = through[:, None].to(jump) * jump, through * to_background
        return boundary(samples.x, samples.velocity, jump, to_background, self._background)

    @property
    def _spacing(self) -> float:
        return max(self._context.request.gradient.discontinuity_spacing / self._traits.closer, LEAST_SPACING)

    @property
    def _grid(self) -> tuple[float, int]:
        """Return the spacing of the grid that finds declared discontinuities, and how often each crossing is shaded.

        A grid has as many points as lines squared, so lines come closer by the square root of the growth alone. Where shading
        is noisy, more shadings of each crossing make up for that.
        """
        growth, closer = core.sample_growth(self._context.request.image.spp), self._traits.closer
        lines = max(closer, growth**0.5)
        spacing = max(self._context.request.gradient.discontinuity_spacing / lines, LEAST_SPACING)
        return spacing, math.ceil(growth * closer / lines) if self._traits.noisy else 1

    def _with_creases(self) -> Request:
        """Return the request for samples on curves, with colours that jump where the shader may."""
        context = self._context
        with torch.no_grad():
            if self._creases is True:
                attributes = every_face(len(context.fixed.faces))
            else:
                attributes = context.fixed.crease_attributes().cpu() if self._creases else None
        gradient = context.request.gradient._replace(discontinuity_spacing=self._spacing)
        return context.request._replace(scene=with_attributes(context.request.scene, attributes), gradient=gradient)

    # -- the shader ----------------------------------------------------------------------------------------------------

    def _shade(self, hits: Hits) -> Tensor:
        """Return (N, C), checked."""
        radiance = self._checked(self._shader(hits), hits)
        if not self._radiance.declares_discontinuities and not hits._only_light:  # for one light less may be looked up
            kinds = list(hits._discontinuities.kinds)
            if self._kinds not in (None, kinds):
                raise ValueError(UNEQUAL)
            self._kinds = kinds
            self.discontinuities_move = self.discontinuities_move or moves(*hits._discontinuities.values)
        return radiance

    def _checked(self, radiance: object, hits: Hits) -> Tensor:
        count = len(hits)
        if not isinstance(radiance, Tensor):
            raise TypeError(f"shader: expected a tensor ({count}, C), got {type(radiance).__name__}")
        if radiance.dim() != 2 or radiance.shape[0] != count or radiance.shape[1] < 1:
            raise ValueError(
                f"shader: expected a row for each hit, ({count}, C), got shape {tuple(radiance.shape)}; a single channel is "
                "value[:, None]"
            )
        if not radiance.is_floating_point():
            raise TypeError(f"shader: expected floating-point numbers, got {radiance.dtype}")
        if self._channels not in (None, radiance.shape[1]):
            raise ValueError(f"shader: expected {self._channels} channels as before, got {radiance.shape[1]}")
        self._channels = radiance.shape[1]
        if hits._needs_values and values_visible(radiance) and not all_finite(radiance.detach()):
            row = int((~torch.isfinite(radiance.detach())).any(1).nonzero()[0])
            name, hint = "shader", "divisions by zero and powers of negative numbers"
            if self._traits.lit:
                name, hint = (
                    "radiance",
                    "numbers of textures, colours, materials or lights that are too large for its dtype",
                )
            raise ValueError(
                f"{name}: expected finite numbers, got {radiance.detach()[row].tolist()} at one of {count} hits; look for {hint}"
            )
        return radiance.to(self._context.dtype)


def _warn_of_lights(context: ImageContext) -> None:
    """Warn of emissive meshes of which alpha cuts out some faces or parts, not all or nothing."""
    lights = (light.mesh for light in context.surfaces.scene.casting if isinstance(light, MeshLight))
    for mesh in lights:
        if mesh.alpha is None or mesh.uvs is None or not moves(mesh.alpha, mesh.uvs) or not values_visible(mesh.alpha):
            continue
        there = mesh.alpha.detach() >= (0.5 if mesh.blends else mesh.alpha_cutoff)
        if bool(there.any()) and not bool(there.all()):
            warn(
                "alpha-tested lights",
                "alpha: an alpha edge ends a mesh that emits; how that moves on what is lit has no gradient, by "
                "alpha and uvs; model the light's shape as faces, or paint it as emission",
            )
