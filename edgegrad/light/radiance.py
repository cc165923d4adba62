"""Radiance of surfaces by their materials and the scene's lights, as a shader of Hits:

    L(y, v) = emission + Σ f(y, v, l) max(0, n·l) V(y, l) E(y) + irradiance of spherical harmonics · diffuse / π

with one point, or a few, of each light that has an extent. Spherical harmonics cast no shadows.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ..camera.camera import Camera
from ..check import all_finite, check_positive_int, values_visible
from ..kernel.first_order import unreached
from ..kernel.flat import image_dtype
from ..kernel.request import Request
from ..points.frame import Frame
from ..points.hits import Hits
from ..points.surfaces import Rays, Surfaces, View
from ..scene.appearance import OnMesh, jumps
from ..scene.environment import Environment
from ..scene.lights import Light, LightPoints, SphericalHarmonics
from ..scene.scene import Scene
from ..scene.tree import tensors_in
from ..shader import Effort, render_shaded, shaded_points
from ..warnings import warn
from . import in_kernel
from .bsdf import Scattering, dot, terminator
from .in_kernel import is_fused

FEWEST_IN_PENUMBRA = 4  # with extended lights, points of a face in a pixel that are shaded: at least these, or spp / 4


class Lighting(NamedTuple):
    """The options of render() for lit scenes."""

    shadows: bool
    samples: int  # points of each light with an extent, for each point that is shaded

    @classmethod
    def of(cls, shadows: object, light_samples: object) -> Lighting:
        """Raises TypeError or ValueError."""
        if not isinstance(shadows, bool):
            raise TypeError(f"shadows: expected True or False, got {type(shadows).__name__} ({shadows!r})")
        return cls(shadows, check_positive_int("light_samples", light_samples, most=1 << 16))

    def image(self, scene: Scene, camera: Camera, request: Request, creases: bool | str = "auto") -> Tensor:
        """(H, W, C), or (B, H, W, C) for a batch of cameras. Raises RuntimeError for a batch of torch.vmap."""
        if not torch.compiler.is_compiling() and not values_visible(*tensors_in(scene)):
            raise RuntimeError(
                "render: expected tensors with values where a scene is lit or has mipmaps, got those of torch.vmap or "
                "torch.compile; render a batch one by one, and leave render() out of what is compiled"
            )
        if scene.is_lit and not (scene.lights or scene.casting):
            warn(
                "no light",
                "scene: no light falls on its materials, so they are black; give it lights=[…], such as "
                "eg.Environment(torch.ones(3)), or leave the materials out: colours are then radiance",
            )
        # Each shaded point draws points of its own on extended lights.
        extended = any(not light.punctual for light in scene.casting)
        spp = request.image.spp
        points = max(FEWEST_IN_PENUMBRA, spp // 4) if extended else shaded_points(spp)
        fused = is_fused(scene)
        additive = not scene.blends
        effort = Effort(
            points=points,
            kernel_image=(lambda frame: _kernel_image(frame, self, points)) if fused and additive else None,
            blended=scene.blends,
            lit=True,
            keeps_little=fused,
            gives_derivatives=fused and additive,
            additive=additive,
        )
        image = render_shaded(scene, camera, self, request, creases, False, effort)
        if not scene.is_lit:  # as the kernel has it where there are no mipmaps
            image = image.to(image_dtype(scene))
        # A graph from all tensors, whatever is in view and whatever is lit.
        for tensor in unreached(image, tensors_in((scene, camera))):
            image = image + tensor.reshape(-1)[:0].sum().to(image)
        return image

    def __call__(self, hits: Hits) -> Tensor:
        return radiance(hits, *self)


def _kernel_image(frame: Frame, lighting: Lighting, points: int) -> Tensor | None:
    """(H · W, C) the surfaces before black, with `points` of each face in a pixel shaded. None where it is not finite: then
    points are shaded in PyTorch, which names the first that is not."""
    _note_jumps(frame.no_hits)
    found = in_kernel.image(frame, lighting.shadows, lighting.samples, points)
    return found if all_finite(found) else None


class _Surface(NamedTuple):
    """Points that are shaded."""

    position: Tensor  # (N, 3)
    v: Tensor  # (N, 3) unit directions to the viewer
    g: Tensor  # (N, 3) unit normals of the faces, on the viewer's side
    n: Tensor  # (N, 3) unit shading normals
    scattering: Scattering
    flat: bool  # whether n is g

    def select(self, rows: Tensor) -> _Surface:
        position, v, g, n = (part[rows] for part in (self.position, self.v, self.g, self.n))
        return _Surface(position, v, g, n, self.scattering.select(rows), self.flat)


def radiance(hits: Hits, shadows: bool = True, light_samples: int = 1) -> Tensor:
    """(N, C): the radiance of meshes by their materials and the scene's lights; of meshes without a material their colours."""
    _note_jumps(hits)
    if isinstance(hits._view, View) and is_fused(hits._surfaces.scene):
        return in_kernel.radiance(hits, shadows, light_samples)
    return reference(hits, shadows, light_samples)


def reference(hits: Hits, shadows: bool = True, light_samples: int = 1) -> Tensor:
    """The same in PyTorch."""
    surfaces = hits._surfaces
    meshes, C = surfaces.scene.meshes, surfaces.scene.channels
    total = hits._barycentrics.new_zeros((len(hits), C))
    if len(meshes) == 1:
        return _of_mesh(hits, 0, Lighting(shadows, light_samples)).expand(len(hits), C)
    for index in range(len(meshes)):
        rows = (surfaces.mesh_of_face[hits._face] == index).nonzero()[:, 0]
        of_mesh = _of_mesh(hits.select(rows), index, Lighting(shadows, light_samples))
        total = total.index_copy(0, rows, of_mesh.expand(len(rows), C))
    return total


def _of_mesh(hits: Hits, index: int, lighting: Lighting) -> Tensor:
    """(N, C) or (N, 1)."""
    surfaces = hits._surfaces
    scene, mesh = surfaces.scene, surfaces.scene.meshes[index]
    at = OnMesh(mesh, hits._face - surfaces.first_faces[index], hits._barycentrics, hits._look_up)
    base, material = at.base_color(), mesh.material
    if material is None:
        return torch.zeros_like(base) if hits._only_light else base
    g, v = surfaces.face_normals(hits._face), hits.view
    front = dot(g.detach(), v.detach()) >= 0
    side = torch.where(front, 1.0, -1.0).to(g)
    n = at.shading_normal(g)
    lambertian = material.metallic is None and material.roughness is None
    metallic, roughness = (
        None if lambertian else g.new_full((1, 1), default) if given is None else at.value(given)
        for given, default in ((material.metallic, 0.0), (material.roughness, 1.0))
    )
    flat = mesh.normals is None and material.normal_map is None
    surface = _Surface(hits.position, v, side * g, side * n, Scattering(base, metallic, roughness), flat)
    total = g.new_zeros((len(hits), 1))
    if material.emission is not None and not hits._only_light:
        total = total + at.value(material.emission)
    for light in scene.lights:
        if isinstance(light, SphericalHarmonics) and not hits._only_light:
            total = total + surface.scattering.diffuse / math.pi * light.irradiance(surface.n)
    for light in scene.casting:
        if hits._only_light and not hits._knows_light(light):
            continue
        count = 1 if light.punctual or hits._only_light else lighting.samples
        for sample in range(count):
            total = total + _light_sample(hits, light, (sample, count), surface, lighting.shadows) / count
    return total if material.two_sided else torch.where(front, total, 0.0)


def _light_sample(hits: Hits, light: Light, sample: tuple[int, int], surface: _Surface, shadows: bool) -> Tensor:
    """(N, C): f max(0, n·l) V E of one point of a light, `sample` = (number, count)."""
    points = hits.light_points(light, *sample)
    if isinstance(light, Environment) and not hits._knows_light(light):
        points = light.above(points, surface.g)
    with torch.no_grad():
        l = _towards(light, points, surface.position)
        facing = ((dot(surface.n, l) > 0) & (dot(surface.g, l) > 0))[:, 0]
    rows = facing.nonzero()[:, 0]
    C = hits._surfaces.scene.channels
    total = surface.position.new_zeros((len(hits), C))
    if len(rows) == 0:
        return total
    surface, points = surface.select(rows), points.select(rows)
    l = _towards(light, points, surface.position)
    arriving = light.arriving(points, surface.position) * dot(surface.n, l)
    if not surface.flat:
        arriving = arriving * terminator(surface.g, surface.n, l)
    if shadows:
        arriving = arriving * hits._subset(rows).visible_from(light, points)[:, None]
    scattered = surface.scattering.evaluate(surface.v, surface.n, l) * arriving
    return total.index_copy(0, rows, scattered.expand(len(rows), C))


def _towards(light: Light, points: LightPoints, position: Tensor) -> Tensor:
    """(N, 3) unit directions."""
    place = light.place(points).to(position)
    return place if light.infinite else normalize(place - position, dim=-1)


# -- creases: edges at which radiance may jump --------------------------------------------------------------------------


def _note_jumps(hits: Hits) -> None:
    surfaces = hits._surfaces
    scene = surfaces.scene
    if len(scene.meshes) > 1:
        hits._note_jump("mesh", lambda: surfaces.mesh_of_face[:, None, None].expand(-1, 3, 1))
    for index, mesh in enumerate(scene.meshes):
        hits._note_jump(("appearance", index), _of_scene(surfaces, index, lambda mesh=mesh: jumps(mesh)))
        if mesh.material is None or not (scene.lights or scene.casting):
            continue
        if mesh.normals is None:
            seen_by = hits._view
            hits._note_jump(
                ("g", index), _of_scene(surfaces, index, lambda i=index, v=seen_by: _flat_radiance(surfaces, i, v))
            )
            continue
        if mesh.normal_faces is not None:
            normals, rows = mesh.normals, mesh.normal_faces
            hits._note_jump(("n", index), _of_scene(surfaces, index, lambda n=normals, r=rows: n[r.long()]))
        if scene.casting:
            hits._note_jump(
                ("lit", index), _of_scene(surfaces, index, lambda i=index: _shadow_terminators(surfaces, i))
            )


def _of_scene(surfaces: Surfaces, index: int, of_mesh: Callable[[], Tensor]) -> Callable[[], Tensor]:
    """(F, 3, K) of all faces from that of one mesh's; zero elsewhere."""

    def corners() -> Tensor:
        own = of_mesh().detach()
        if len(own) == len(surfaces.faces):
            return own
        first = surfaces.first_faces[index]
        after = len(surfaces.faces) - first - len(own)
        before, behind = (own.new_zeros((count, *own.shape[1:])) for count in (first, after))
        return torch.cat([before, own, behind])  # pad() of torch 2.4 refuses what has no columns

    return corners


def _faces_of(surfaces: Surfaces, index: int) -> Tensor:
    first = surfaces.first_faces[index]
    return torch.arange(first, first + len(surfaces.scene.meshes[index].faces), device=surfaces.verts.device)


def _face_normals(surfaces: Surfaces, index: int) -> Tensor:
    return surfaces.face_normals(_faces_of(surfaces, index))[:, None].expand(-1, 3, -1)


def _flat_radiance(surfaces: Surfaces, index: int, view: View | Rays) -> Tensor:
    """(F, 3, K) of a mesh without shading normals: what may jump at its edges, besides colours.

    That is the face's normal on the viewer's side; if all lights are punctual, only of faces that one of them lights. Of
    Lambertian faces it is E max(0, n·l) of each light: if both faces agree at the ends of an edge, they agree all along it, for
    n·l |l| is the light's distance from the face's plane. The cone of a spot light may end between the ends, and is left out.
    """
    scene, mesh = surfaces.scene, surfaces.scene.meshes[index]
    material = mesh.material
    assert material is not None
    harmonics = any(isinstance(light, SphericalHarmonics) for light in scene.lights)
    points_alone = not harmonics and all(light.punctual for light in scene.casting)
    if not points_alone or material.normal_map is not None or not isinstance(view, View):
        return _face_normals(surfaces, index)
    verts = mesh.verts.detach().double()
    places = [light.place(light.draw(verts[:1])).detach().to(verts) for light in scene.casting]
    power = [light._power(verts).detach().abs().mean() for light in scene.casting]
    infinite = [light.infinite for light in scene.casting]
    found = in_kernel.light_on_faces(verts, mesh.faces, view, infinite, torch.cat(places), torch.stack(power))
    if material.metallic is None and material.roughness is None:
        return found
    g = _face_normals(surfaces, index)
    away = dot(g[:, 0], view.to_viewer(verts[mesh.faces[:, 0].long()])) < 0
    return torch.where(away[:, None], -g, g) * (found != 0).any(-1, keepdim=True)


def _shadow_terminators(surfaces: Surfaces, index: int) -> Tensor:
    """(F, 3, K): n·l times the shadow terminator at corners, with interpolated normals n, for each light.

    The face's normal g enters through the terminator alone, which is 1 where g·l ≥ (g·n)(n·l). So of a fine mesh only edges near
    the terminator are creases. An extended light has a terminator for each of its points: then g itself is compared.
    """
    mesh, lights = surfaces.scene.meshes[index], surfaces.scene.casting
    assert mesh.normals is not None
    of_faces = _face_normals(surfaces, index)
    found = [] if all(light.punctual for light in lights) else [of_faces]
    g = of_faces.reshape(-1, 3)
    rows = mesh.faces if mesh.normal_faces is None else mesh.normal_faces
    n = normalize(mesh.normals.detach().to(g), dim=-1)[rows.long()].reshape(-1, 3)
    n = torch.where(dot(n, g) < 0, -n, n)
    position = mesh.verts.detach().to(g)
    for light in lights:
        if light.punctual:
            l = _towards(light, light.draw(position), position).detach()
            l = l.expand(len(position), 3)[mesh.faces.long()].reshape(-1, 3)
            side = torch.where(dot(n, l) < 0, -1.0, 1.0).to(g)
            found.append((dot(n, l) * terminator(side * g, side * n, l)).reshape(-1, 3, 1))
    return torch.cat(found, -1)


def check_unlit(function: str, scene: Scene, instead: str) -> None:
    """Raises ValueError."""
    if scene.is_lit:
        raise ValueError(f"{function}: expected a scene without materials and lights, got one that has them; {instead}")
    if scene.is_shaded:
        raise ValueError(
            f'{function}: expected textures with filter "linear" or "nearest", got "mipmap", of which the kernel knows nothing; '
            'replace(filter="linear")'
        )
