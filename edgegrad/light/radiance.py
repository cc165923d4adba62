"""Radiance of surfaces by their materials and the scene's lights, as a shader of Hits:

    L(y, v) = emission + Σ f(y, v, l) max(0, n·l) V(y, l) E(y) + irradiance of spherical harmonics · diffuse / π

with one point, or a few, of each light that has an extent. Spherical harmonics cast no shadows.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from ..camera.camera import Camera
from ..check import all_finite, check_positive_int
from ..kernel.counts import Watch
from ..kernel.derivatives import moves
from ..kernel.first_order import unreached
from ..kernel.flat import image_dtype
from ..kernel.request import Request
from ..library import core
from ..points.hits import Hits
from ..points.image_context import ImageContext
from ..points.splat import SplatTerm
from ..sampling import Sampling
from ..scene.appearance import coordinates
from ..scene.environment import Environment
from ..scene.lights import Light
from ..scene.scene import Scene
from ..scene.tree import tensors_in
from ..shader import Radiance, ShadingTraits, points_of_face, render_shaded
from ..warnings import warn
from . import in_kernel
from .at_points import LitOptions
from .bounces import check_bounces
from .creases import note_jumps
from .emitter_texels import by_texel_edges, moving_emitters
from .in_kernel import is_fused, nearest_textures
from .indirect_shadows import indirect_shadows
from .near_field import NearField, radius
from .secondary_edges import secondary_edges
from .shaded_points import of_each_mesh, on_mesh

FEWEST_IN_PENUMBRA = 4  # with extended lights, points of a face in a pixel that are shaded: at least these, or spp / 4
# Where glossy surfaces end or meet, points of a light for each sample of it: these are few points, and what is wanted of them is
# the difference of both sides.
SAMPLES_FACTOR_AT_CURVES = 4
# By which lines that look for alpha edges and texel edges lie closer where surfaces light each other: these
# have some samples a pixel, and each side of a sample has one path.
CLOSER_STEPS = 8.0
# Distance, in texels, from a texel edge at which both of its sides are shaded: the kernel reads the texel in which a point lies.
NEXT_TO_TEXELS = 1e-4


class Lighting(NamedTuple):
    """The options of render() for lit scenes."""

    shadows: bool
    samples: int  # points of each light with an extent, for each point that is shaded
    bounces: int = 1  # how often light is scattered on its way, at most

    @classmethod
    def from_options(cls, shadows: object, bounces: object, sampling: Sampling) -> Lighting:
        """Raises TypeError or ValueError."""
        if not isinstance(shadows, bool):
            raise TypeError(f"shadows: expected True or False, got {type(shadows).__name__} ({shadows!r})")
        return cls(
            shadows,
            sampling.lights,
            check_positive_int("bounces", bounces, most=core.MOST_BOUNCES),
        )

    def image(
        self,
        scene: Scene,
        camera: Camera,
        request: Request,
        creases: bool | str = "auto",
        watch: Watch = Watch(),  # noqa: B008  it keeps nothing
    ) -> Tensor:
        """Return the image (H, W, C), or (B, H, W, C) for a batch of cameras, of tensors with values; see lit_image()."""
        if scene.is_lit and not (scene.lights or scene.casting):
            warn(
                "no light",
                "scene: no light falls on its materials, so they are black; give it lights=[…], such as "
                "eg.lights.Environment(torch.ones(3)), or leave the materials out: colours are then radiance",
            )
        if self.bounces > 1:
            check_bounces(scene, camera, request)
        # Each shaded point draws points of its own on extended lights; and a path of its own, whose noise falls the faster the
        # more there are in a pixel, for they are spread evenly.
        extended = any(not light.punctual for light in scene.casting)
        spp = request.image.spp
        points = max(FEWEST_IN_PENUMBRA, spp // 4) if extended else points_of_face(spp)
        if self.bounces > 1:
            points = max(FEWEST_IN_PENUMBRA, spp)
        # From each point that the kernel shades for an image go several paths (csrc/shading/lit/path.h).
        several = self.bounces > 1 and self.samples == 1
        in_image = self._in_image(scene, max(FEWEST_IN_PENUMBRA, points // 2) if several else points, spp)
        fused = is_fused(scene)
        additive = not scene.blends
        traits = ShadingTraits(
            points=points,
            blended=scene.blends,
            lit=True,
            indirect=self.bounces > 1,
            glossy=scene.is_glossy,
            keeps_little=fused,
            gives_derivatives=additive,
            additive=additive,
            closer=CLOSER_STEPS if self.bounces > 1 else 1.0,
            noisy=extended or self.bounces > 1,
            discontinuity_margin=NEXT_TO_TEXELS,
        )
        lit = _LitRadiance(
            self,
            in_image if fused and additive else None,
            declares_discontinuities=additive and _has_moving_texel_edges(scene, camera),
            # Comparisons see borders, which visibility=False leaves out; and layers behind others have none.
            near_field=self.bounces > 1 and additive and request.gradient.visibility,
        )
        image = render_shaded(scene, camera, lit, request, creases, traits, watch)
        if not scene.is_lit:  # as the kernel has it where there are no mipmaps
            image = image.to(image_dtype(scene))
        # A graph from all tensors, whatever is in view and whatever is lit.
        for tensor in unreached(image, tensors_in((scene, camera))):
            image = image + tensor.reshape(-1)[:0].sum().to(image)
        return image

    @staticmethod
    def resamples(scene: Scene) -> bool:
        """Return whether points of lights are drawn by how surfaces scatter as well."""
        return scene.is_glossy and any(not light.punctual for light in scene.casting)

    def in_gradient(self, scene: Scene, light: Light) -> int:
        """Return how many points of a light are drawn for each sample of the gradient inside a glossy face."""
        if light.punctual:
            return 1
        sets = scene.is_glossy and isinstance(light, Environment)
        return self.samples * (core.SETS_FOR_ONE * core.SET_SIZE if sets else 1)

    def _in_image(self, scene: Scene, points: int, spp: int) -> tuple[Lighting, int]:
        """Return how an image is lit without derivatives, and how many points of a face in a pixel are shaded.

        Glossy surfaces get more points with fewer light samples each: what is mirrored changes within a pixel as well.
        """
        if not self.resamples(scene):
            return self, points
        more = max(points, min(spp, points * self.samples))
        return self._replace(samples=-(-points * self.samples // more)), more

    def __call__(self, hits: Hits) -> Tensor:
        more = SAMPLES_FACTOR_AT_CURVES if hits._on_curve and self.resamples(hits._surfaces.scene) else 1
        return radiance(hits, *self._replace(samples=more * self.samples))


class _LitRadiance(Radiance):
    """The radiance of a lit scene."""

    def __init__(
        self,
        lighting: Lighting,
        in_image: tuple[Lighting, int] | None,
        declares_discontinuities: bool,
        near_field: bool,
    ) -> None:
        """`in_image`: the lighting, and the points of a face in a pixel, of an image that the kernel shades at once."""
        self._lighting, self._in_image, self.declares_discontinuities, self._near_field = (
            lighting,
            in_image,
            declares_discontinuities,
            near_field,
        )

    def __call__(self, hits: Hits) -> Tensor:
        return self._lighting(hits)

    def image(self, context: ImageContext) -> Tensor | None:
        return None if self._in_image is None else _kernel_image(context, *self._in_image)

    def declare(self, hits: Hits) -> None:
        declare_texel_edges(hits)

    def near_field(self, context: ImageContext, hits: Hits) -> tuple[float, Tensor] | None:
        if not self._near_field:
            return None
        near, scene, shadows, bounces = (
            radius(context),
            context.surfaces.scene,
            self._lighting.shadows,
            self._lighting.bounces,
        )
        declare = declare_texel_edges if any(nearest_textures(mesh) for mesh in scene.meshes) else None
        nearby = NearField(context, hits, lambda there: in_kernel.indirect(there, shadows, bounces, near), declare)
        return near, nearby.term() if near > 0 else hits._exact.new_zeros((len(hits), 1)).to(context.dtype)

    def indirect(self, context: ImageContext, watch: Watch) -> list[SplatTerm]:
        shadows, bounces = self._lighting.shadows, self._lighting.bounces
        terms: list[SplatTerm] = []
        if bounces == 1:
            return terms
        if shadows:
            with watch.part("indirect shadows"):
                terms += indirect_shadows(context, bounces, watch)
        with watch.part("secondary edges"):
            options = LitOptions(shadows, samples=1, dark=0.0, bounces=bounces, near=radius(context))
            terms += secondary_edges(context, options)
        return terms


def _kernel_image(context: ImageContext, lighting: Lighting, points: int) -> Tensor | None:
    """Return the image of surfaces before black (H · W, C), with `points` of each face in a pixel shaded, or None if it is not
    finite. Then points are shaded one by one, and an error names the first that is not."""
    note_jumps(context.no_hits, lighting.bounces > 1)
    options = LitOptions(lighting.shadows, lighting.samples, bounces=lighting.bounces)
    found = in_kernel.image(context, options, points)
    return found if all_finite(found) else None


def radiance(hits: Hits, shadows: bool = True, light_samples: int = 1, bounces: int = 1) -> Tensor:
    """Return the radiance (N, C) of meshes by their materials and the scene's lights; of others, their colours."""
    note_jumps(hits, bounces > 1)
    if not is_fused(hits._surfaces.scene):
        declare_texel_edges(hits)
    L = in_kernel.radiance(hits, shadows, light_samples)
    if bounces > 1 and not hits._only_light:
        L = L + in_kernel.indirect(hits, shadows, bounces)
    lights = moving_emitters(hits)
    return L + by_texel_edges(hits, lights, shadows, light_samples) if lights else L


def _has_moving_texel_edges(scene: Scene, camera: Camera) -> bool:
    """Return whether texel edges may move in the image."""
    found = [(mesh, texture) for mesh in scene.meshes for texture in nearest_textures(mesh)]
    uvs = [coordinates(mesh, texture)[0] for mesh, texture in found]
    return bool(found) and moves(*tensors_in(camera), *uvs, *(mesh.verts for mesh, _ in found))


def declare_texel_edges(hits: Hits) -> None:
    """Declare where textures give the nearest texel, and shade nothing."""
    if not any(nearest_textures(mesh) for mesh in hits._surfaces.scene.meshes):
        return

    def declare(own: Hits, index: int) -> Tensor:
        at = on_mesh(own, index)
        for texture in nearest_textures(at.mesh):
            at.value(texture)
        return own._barycentrics.new_zeros((len(own), 1))

    of_each_mesh(hits, declare)


def check_unlit(function: str, scene: Scene, instead: str) -> None:
    """Raises ValueError."""
    if scene.is_lit:
        raise ValueError(f"{function}: expected a scene without materials and lights, got one that has them; {instead}")
    if scene.is_shaded:
        raise ValueError(
            f'{function}: expected textures with filter "linear" or "nearest", got "mipmap", which it does not average; '
            'replace(filter="linear")'
        )
