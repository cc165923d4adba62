"""Radiance of surfaces by their materials and the scene's lights, as a shader of Hits:

    L(y, v) = emission + Σ f(y, v, l) max(0, n·l) V(y, l) E(y) + irradiance of spherical harmonics · diffuse / π

with one point, or a few, of each light that has an extent. Spherical harmonics cast no shadows.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..camera.camera import Camera
from ..check import all_finite, check_positive_int
from ..kernel.counts import Watch
from ..kernel.derivatives import differentiates, moves
from ..kernel.first_order import unreached
from ..kernel.flat import image_dtype
from ..kernel.request import Request
from ..library import core
from ..points.frame import Frame
from ..points.hits import Hits
from ..points.splat import Term
from ..points.surfaces import View
from ..scene.appearance import OnMesh, coordinates
from ..scene.environment import Environment
from ..scene.lights import Light, LightPoints, SphericalHarmonics
from ..scene.material import Material
from ..scene.mesh_light import MeshLight
from ..scene.scene import Scene
from ..scene.texel_borders import TexelBorders
from ..scene.tree import tensors_in
from ..shader import Effort, Radiance, render_shaded, shaded_points
from ..warnings import warn
from . import in_kernel
from .antithetic import SET_SIZE, SETS
from .at_points import Options
from .bounces import check_bounces
from .bsdf import Scattering, dot, terminator
from .creases import note_jumps
from .in_kernel import is_fused, nearest_textures
from .indirect_shadows import indirect_shadows
from .mesh_light_sampling import MeshTowards, tree_of
from .near_field import NearField, radius
from .resampled import Glossy, resampled
from .secondary_edges import secondary_edges

FEWEST_IN_PENUMBRA = 4  # with extended lights, points of a face in a pixel that are shaded: at least these, or spp / 4
# Where glossy surfaces end or meet, points of a light for each sample of it: these are few points, and what is wanted of them is
# the difference of both sides.
AT_CURVES = 4
# By which lines that look for alpha edges and borders of nearest texels lie closer where surfaces light each other: these
# have some samples a pixel, and each side of a sample has one path.
CLOSER_STEPS = 8.0
NEXT_TO_TEXELS = (
    1e-4  # of a texel, from the border of nearest ones, where light that is scattered more than once is asked for
)

LIGHTING = ("shadows", "light_samples", "bounces")  # the options of render() that it is made of


class Lighting(NamedTuple):
    """The options of render() for lit scenes."""

    shadows: bool
    samples: int  # points of each light with an extent, for each point that is shaded
    bounces: int = 1  # how often light is scattered on its way, at most

    @classmethod
    def of(cls, shadows: object = True, light_samples: object = 1, bounces: object = 1) -> Lighting:
        """Raises TypeError or ValueError."""
        if not isinstance(shadows, bool):
            raise TypeError(f"shadows: expected True or False, got {type(shadows).__name__} ({shadows!r})")
        return cls(
            shadows,
            check_positive_int("light_samples", light_samples, most=1 << 16),
            check_positive_int("bounces", bounces, most=core.MOST_BOUNCES),
        )

    @property
    def options(self) -> dict[str, Any]:
        """The arguments of render() that it is made of."""
        return dict(zip(LIGHTING, self, strict=True))

    def image(
        self,
        scene: Scene,
        camera: Camera,
        request: Request,
        creases: bool | str = "auto",
        watch: Watch = Watch(),  # noqa: B008  it keeps nothing
    ) -> Tensor:
        """(H, W, C), or (B, H, W, C) for a batch of cameras, of tensors with values; see lit_image()."""
        if scene.is_lit and not (scene.lights or scene.casting):
            warn(
                "no light",
                "scene: no light falls on its materials, so they are black; give it lights=[…], such as "
                "eg.Environment(torch.ones(3)), or leave the materials out: colours are then radiance",
            )
        if self.bounces > 1:
            check_bounces(scene, camera, request)
        # Each shaded point draws points of its own on extended lights; and a path of its own, whose noise falls the faster the
        # more there are in a pixel, for they are spread evenly.
        extended = any(not light.punctual for light in scene.casting)
        spp = request.image.spp
        points = max(FEWEST_IN_PENUMBRA, spp // 4) if extended else shaded_points(spp)
        if self.bounces > 1:
            points = max(FEWEST_IN_PENUMBRA, spp)
        # From each point that the kernel shades for an image go several paths (csrc/shading/lit/path.h).
        several = self.bounces > 1 and self.samples == 1
        in_image = self._in_image(scene, max(FEWEST_IN_PENUMBRA, points // 2) if several else points, spp)
        fused = is_fused(scene)
        additive = not scene.blends
        effort = Effort(
            points=points,
            blended=scene.blends,
            lit=True,
            glossy=scene.is_glossy,
            keeps_little=fused,
            gives_derivatives=fused and additive,
            additive=additive,
            closer=CLOSER_STEPS if self.bounces > 1 else 1.0,
            # The kernel, which finds light that is scattered more than once, reads its texels by itself.
            step_margin=NEXT_TO_TEXELS if self.bounces > 1 else 0.0,
        )
        lit = _LitRadiance(
            self,
            in_image if fused and additive else None,
            declares_steps=additive and _has_moving_steps(scene, camera),
            # Comparisons see borders, which visibility=False leaves out; and layers behind others have none.
            near_field=self.bounces > 1 and additive and request.gradient.visibility,
        )
        image = render_shaded(scene, camera, lit, request, creases, False, effort, watch)
        if not scene.is_lit:  # as the kernel has it where there are no mipmaps
            image = image.to(image_dtype(scene))
        # A graph from all tensors, whatever is in view and whatever is lit.
        for tensor in unreached(image, tensors_in((scene, camera))):
            image = image + tensor.reshape(-1)[:0].sum().to(image)
        return image

    @staticmethod
    def resamples(scene: Scene) -> bool:
        """Whether points of lights are drawn by how surfaces scatter as well."""
        return scene.is_glossy and any(not light.punctual for light in scene.casting)

    def in_gradient(self, scene: Scene, light: Light) -> int:
        """Points of a light for each sample of the gradient inside a glossy face."""
        if light.punctual:
            return 1
        sets = scene.is_glossy and isinstance(light, Environment)
        return self.samples * (SETS * SET_SIZE if sets else 1)

    def _in_image(self, scene: Scene, points: int, spp: int) -> tuple[Lighting, int]:
        """How an image is lit without derivatives, and how many points of a face in a pixel are shaded. On glossy surfaces
        more points with fewer light samples each: what is mirrored changes within a pixel as well."""
        if not self.resamples(scene):
            return self, points
        more = max(points, min(spp, points * self.samples))
        return self._replace(samples=-(-points * self.samples // more)), more

    def __call__(self, hits: Hits) -> Tensor:
        more = AT_CURVES if hits._on_curve and self.resamples(hits._surfaces.scene) else 1
        return radiance(hits, *self._replace(samples=more * self.samples))


class _LitRadiance(Radiance):
    """The radiance of a lit scene."""

    def __init__(
        self, lighting: Lighting, in_image: tuple[Lighting, int] | None, declares_steps: bool, near_field: bool
    ) -> None:
        """`in_image`: the lighting, and the points of a face in a pixel, of an image that the kernel shades at once."""
        self._lighting, self._in_image, self.declares_steps, self._near_field = (
            lighting,
            in_image,
            declares_steps,
            near_field,
        )

    def __call__(self, hits: Hits) -> Tensor:
        return self._lighting(hits)

    def image(self, frame: Frame) -> Tensor | None:
        return None if self._in_image is None else _kernel_image(frame, *self._in_image)

    def steps(self, hits: Hits) -> None:
        declare_steps(hits)

    def near_field(self, frame: Frame, hits: Hits) -> tuple[float, Tensor] | None:
        if not self._near_field:
            return None
        near, scene, shadows, bounces = (
            radius(frame),
            frame.surfaces.scene,
            self._lighting.shadows,
            self._lighting.bounces,
        )
        declare = declare_steps if any(nearest_textures(mesh) for mesh in scene.meshes) else None
        nearby = NearField(frame, hits, lambda there: in_kernel.indirect(there, shadows, bounces, near), declare)
        return near, nearby.slid() if near > 0 else hits._exact.new_zeros((len(hits), 1)).to(frame.dtype)

    def indirect(self, frame: Frame, watch: Watch) -> list[Term]:
        shadows, bounces = self._lighting.shadows, self._lighting.bounces
        terms: list[Term] = []
        if bounces == 1:
            return terms
        if shadows:
            with watch.part("unseen shadows"):
                terms += indirect_shadows(frame, bounces, watch)
        with watch.part("bounce edges"):
            options = Options(shadows, samples=1, dark=0.0, bounces=bounces, near=radius(frame))
            terms += secondary_edges(frame, options)
        return terms


def _kernel_image(frame: Frame, lighting: Lighting, points: int) -> Tensor | None:
    """(H · W, C) the surfaces before black, with `points` of each face in a pixel shaded. None where it is not finite: then
    points are shaded in PyTorch, which names the first that is not."""
    note_jumps(frame.no_hits, lighting.bounces > 1)
    options = Options(lighting.shadows, lighting.samples, bounces=lighting.bounces)
    found = in_kernel.image(frame, options, points)
    return found if all_finite(found) else None


class _Surface(NamedTuple):
    """Points that are shaded."""

    position: Tensor  # (N, 3)
    v: Tensor  # (N, 3) unit directions to the viewer
    g: Tensor  # (N, 3) unit normals of the faces, on the viewer's side
    n: Tensor  # (N, 3) unit shading normals
    scattering: Scattering
    flat: bool  # whether n is g

    @classmethod
    def of(cls, hits: Hits, at: OnMesh, material: Material) -> _Surface:
        base = at.base_color()
        g, v = hits._surfaces.face_normals(hits._face), hits.view
        side = torch.where(_in_front(g, v), 1.0, -1.0).to(g)
        n = at.shading_normal(g)
        lambertian = not material.is_glossy
        metallic, roughness = (
            None if lambertian else g.new_full((1, 1), default) if given is None else at.value(given)
            for given, default in ((material.metallic, 0.0), (material.roughness, 1.0))
        )
        flat = at.mesh.normals is None and material.normal_map is None
        return cls(hits.position, v, side * g, side * n, Scattering(base, metallic, roughness), flat)

    def select(self, rows: Tensor) -> _Surface:
        position, v, g, n = (part[rows] for part in (self.position, self.v, self.g, self.n))
        return _Surface(position, v, g, n, self.scattering.select(rows), self.flat)


def _in_front(g: Tensor, v: Tensor) -> Tensor:
    """(N, 1): whether points are seen from the front of their faces."""
    return dot(g.detach(), v.detach()) >= 0


def radiance(hits: Hits, shadows: bool = True, light_samples: int = 1, bounces: int = 1) -> Tensor:
    """(N, C) of the scene's meshes by their materials and its lights; of meshes without a material their colours."""
    note_jumps(hits, bounces > 1)
    # Where steps are forced to a side PyTorch shades, for the kernel reads the texel in which a point lies.
    fused = isinstance(hits._view, View) and is_fused(hits._surfaces.scene) and not hits._steps.forced
    L = in_kernel.radiance(hits, shadows, light_samples) if fused else reference(hits, shadows, light_samples)
    if bounces > 1 and not hits._only_light:
        L = L + in_kernel.indirect(hits, shadows, bounces)
    lights = _moving_emitters(hits)
    return L + _of_moving_borders(hits, lights, Lighting(shadows, light_samples)) if lights else L


def reference(hits: Hits, shadows: bool = True, light_samples: int = 1) -> Tensor:
    """The same in PyTorch, but for what borders between texels of lights do elsewhere."""
    lighting = Lighting(shadows, light_samples)
    return _of_each_mesh(hits, lambda own, index: _of_mesh(own, index, lighting))


def _has_moving_steps(scene: Scene, camera: Camera) -> bool:
    """Whether borders of texels may move in the image."""
    found = [(mesh, texture) for mesh in scene.meshes for texture in nearest_textures(mesh)]
    uvs = [coordinates(mesh, texture)[0] for mesh, texture in found]
    return bool(found) and moves(*tensors_in(camera), *uvs, *(mesh.verts for mesh, _ in found))


def declare_steps(hits: Hits) -> None:
    """Declares where textures give the nearest texel: as reference() does, in its order, and shades nothing."""

    def declare(own: Hits, index: int) -> Tensor:
        at = _on_mesh(own, index)
        for texture in nearest_textures(at.mesh):
            at.value(texture)
        return own._barycentrics.new_zeros((len(own), 1))

    _of_each_mesh(hits, declare)


def _of_each_mesh(hits: Hits, of_mesh: Callable[[Hits, int], Tensor]) -> Tensor:
    """(N, C) from what is found for the points of each mesh and its number."""
    surfaces = hits._surfaces
    meshes, C = surfaces.scene.meshes, surfaces.scene.channels
    if len(meshes) == 1:
        return of_mesh(hits, 0).expand(len(hits), C)
    total = hits._barycentrics.new_zeros((len(hits), C))
    for index in range(len(meshes)):
        rows = (surfaces.mesh_of_face[hits._face] == index).nonzero()[:, 0]
        total = total.index_copy(0, rows, of_mesh(hits.select(rows), index).expand(len(rows), C))
    return total


def _on_mesh(hits: Hits, index: int) -> OnMesh:
    surfaces = hits._surfaces
    return OnMesh(
        surfaces.scene.meshes[index],
        hits._face - surfaces.first_faces[index],
        hits._barycentrics,
        hits._look_up,
        lambda: surfaces.tangents(index),  # pyright: ignore[reportArgumentType]: asked for where there are some
    )


def _emission(at: OnMesh, material: Material) -> Tensor | None:
    return None if material.emission is None else at.value(material.emission)


def _of_mesh(hits: Hits, index: int, lighting: Lighting) -> Tensor:
    """(N, C) or (N, 1)."""
    scene, at = hits._surfaces.scene, _on_mesh(hits, index)
    material = at.mesh.material
    if material is None:
        base = at.base_color()
        return torch.zeros_like(base) if hits._only_light else base
    surface = _Surface.of(hits, at, material)
    total = surface.g.new_zeros((len(hits), 1))
    emission = None if hits._only_light else _emission(at, material)
    if emission is not None:
        total = total + emission
    for light in scene.lights:
        if isinstance(light, SphericalHarmonics) and not hits._only_light:
            total = total + surface.scattering.diffuse / math.pi * light.irradiance(surface.n)
    for light in scene.casting:
        if hits._only_light and not hits._knows_light(light):
            continue
        count = 1 if light.punctual or hits._only_light else lighting.samples
        drawn = _points_of(hits, light, count, surface)
        for points in drawn:
            total = total + _light_sample(hits, light, points, surface, lighting.shadows) / len(drawn)
    return _where_seen(hits, material, total)


def _where_seen(hits: Hits, material: Material, total: Tensor) -> Tensor:
    """Backs are black, unless the material is two-sided."""
    front = _in_front(hits._surfaces.face_normals(hits._face), hits.view)
    return total if material.two_sided else torch.where(front, total, 0.0)


def _points_of(hits: Hits, light: Light, count: int, surface: _Surface) -> list[LightPoints]:
    """`count` points of a light for each point of a surface; where only derivatives are wanted, sets of an environment for a
    glossy one."""
    lambertian = surface.scattering.roughness is None
    by_light = lambertian or (isinstance(light, MeshLight) and tree_of(light) is None)
    if hits._knows_light(light) or light.punctual or by_light:
        drawn = [hits.light_points(light, sample, count) for sample in range(count)]
        if lambertian and isinstance(light, Environment) and not hits._knows_light(light):
            return [light.above(points, surface.g) for points in drawn]
        return drawn
    glossy = Glossy.of(surface.v, surface.n, surface.g, surface.scattering, hits._seed)
    index = hits._index(light)
    if isinstance(light, MeshLight):
        first_faces, meshes = hits._surfaces.first_faces, hits._surfaces.scene.meshes
        first = next(first for first, mesh in zip(first_faces, meshes, strict=True) if mesh is light.mesh)
        return resampled(
            light, index, glossy, count, MeshTowards.of(light, surface.position.detach().double(), hits._face - first)
        )
    if hits._needs_values:
        return resampled(light, index, glossy, count)
    return resampled(light, index, glossy, count, antithetic=True)


def _light_sample(hits: Hits, light: Light, points: LightPoints, surface: _Surface, shadows: bool) -> Tensor:
    """(N, C): f max(0, n·l) V E of one point of a light."""
    return _scattered(hits, light, points, surface, shadows, lambda rows, y: light.arriving(points.select(rows), y))


def _scattered(
    hits: Hits,
    light: Light,
    points: LightPoints,
    surface: _Surface,
    shadows: bool,
    arriving: Callable[[Tensor, Tensor], Tensor],
) -> Tensor:
    """(N, C): f max(0, n·l) V E, with E by arriving(rows, places)."""
    with torch.no_grad():
        l = light.incident(points, surface.position)
        facing = ((dot(surface.n, l) > 0) & (dot(surface.g, l) > 0))[:, 0]
        facing &= light.shows(points) & points.density.isfinite()
    rows = facing.nonzero()[:, 0]
    C = hits._surfaces.scene.channels
    total = surface.position.new_zeros((len(hits), C))
    if len(rows) == 0:
        return total
    surface, points = surface.select(rows), points.select(rows)
    l = light.incident(points, surface.position)
    arrived = arriving(rows, surface.position) * dot(surface.n, l)
    if not surface.flat:
        arrived = arrived * terminator(surface.g, surface.n, l)
    if shadows:
        arrived = arrived * hits._subset(rows).visible_from(light, points)[:, None]
    scattered = surface.scattering.evaluate(surface.v, surface.n, l) * arrived
    return total.index_copy(0, rows, scattered.expand(len(rows), C))


def _moving_emitters(hits: Hits) -> list[_MovingEmitter]:
    """The lights whose borders of texels may move. Light samples have no derivative for these."""
    found: list[_MovingEmitter] = []
    scene = hits._surfaces.scene
    if not differentiates() or hits._forced is not None or len(hits) == 0:
        return found
    for number, light in enumerate(scene.casting):
        if not isinstance(light, MeshLight) or not light.has_borders or not moves(light.coordinates):
            continue
        stream = len(scene.casting) + number
        first, second = hits.random(2, stream)[0].tolist()
        borders = light.borders((first, second))
        if borders is not None:
            found.append(_MovingEmitter(light, borders, stream))
    return found


class _MovingEmitter(NamedTuple):
    light: MeshLight
    borders: TexelBorders
    stream: int  # of random numbers


def _of_moving_borders(hits: Hits, lights: list[_MovingEmitter], lighting: Lighting) -> Tensor:
    """(N, C) zeros, with the derivative of what lights give by where their texels end, as many points of borders as of light:

    f max(0, n·l) V cos θ / r² · [E_i − E_{i−1}] δp / |∇p|        (scene/texel_borders.py)
    """

    def of_mesh(own: Hits, index: int) -> Tensor:
        total = own._barycentrics.new_zeros((len(own), 1))
        at = _on_mesh(own, index)
        material = at.mesh.material
        if material is None:
            return total
        with torch.no_grad():
            surface = _Surface.of(own, at, material)
        for light, borders, stream in lights:
            for sample in range(lighting.samples):
                drawn = borders.draw(own.random(2, stream, sample, lighting.samples))
                with torch.no_grad():
                    reaches = _scattered(
                        own,
                        light,
                        LightPoints(drawn.face, drawn.b[:, 1:], torch.ones_like(drawn.b[:, 0])),
                        surface,
                        lighting.shadows,
                        lambda rows, y, drawn=drawn, light=light: (
                            light.facing(drawn.face[rows], drawn.b[rows], y) * drawn.weight[rows]
                        ).to(y),
                    )
                    reaches = _where_seen(own, material, reaches / lighting.samples)
                total = total + reaches * borders.motion(drawn).to(reaches)
        return total

    # Of other hits, which keep nothing that is computed here, and declare no steps.
    return _of_each_mesh(hits._subset(slice(None)), of_mesh)


def check_unlit(function: str, scene: Scene, instead: str) -> None:
    """Raises ValueError."""
    if scene.is_lit:
        raise ValueError(f"{function}: expected a scene without materials and lights, got one that has them; {instead}")
    if scene.is_shaded:
        raise ValueError(
            f'{function}: expected textures with filter "linear" or "nearest", got "mipmap", which it does not average; '
            'replace(filter="linear")'
        )
