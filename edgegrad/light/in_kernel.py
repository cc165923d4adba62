"""Radiance of lit surfaces by the kernel (csrc/shading/lit), with derivatives by all tensors of the scene, in reverse and in
forward mode; radiance.py computes the same in PyTorch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..kernel.derivatives import moves
from ..kernel.first_order import apply, array, without_derivatives
from ..kernel.request import derived_seed
from ..library import core
from ..points.footprints import pyramid_of
from ..points.frame import Frame
from ..points.hits import Hits
from ..points.records import CurveRecords, values_of
from ..points.seeds import mixed_bits
from ..points.surfaces import Surfaces, View
from ..scene.environment import Environment
from ..scene.lights import DirectionalLight, Light, LightPoints, PointLight, SphericalHarmonics, SpotLight
from ..scene.material import WRAPS, Parameter, Texture
from ..scene.mesh import FILTERS, Mesh
from ..scene.mesh_light import MeshLight
from ..scene.scene import Scene
from .at_points import AtPoints, Indirect, Options, Points, Shading
from .companions import COMPANIONS, MOST_FOURS
from .lamp_trees import hides, least_brightness, tree_of
from .resampled import DARK

_64_BITS = 2**64 - 1


def is_fused(scene: Scene) -> bool:
    """Whether the kernel can shade a scene: no texture is nearest where one sees through surfaces, for the kernel declares no
    steps."""
    if scene.channels > core.MOST_LIT_CHANNELS:
        return False
    return not scene.blends or "nearest" not in _filters(scene)


def _filters(scene: Scene) -> set[str]:
    """Those of all textures."""
    textures = [t for m in scene.meshes if m.material is not None for t in m.material.textures.values()]
    return {*(mesh.filter for mesh in scene.meshes if mesh.texture is not None), *(t.filter for t in textures)}


def nearest_textures(mesh: Mesh) -> list[Texture]:
    """Those of a mesh that give the nearest texel, in the order in which shading looks them up."""
    found = [] if mesh.texture is None else [Texture(mesh.texture, wrap=mesh.wrap, filter=mesh.filter)]
    if mesh.material is not None:
        m = mesh.material
        given = (m.base_color, m.normal_map, m.metallic, m.roughness, m.emission)
        found += [texture for texture in given if isinstance(texture, Texture)]
    return [texture for texture in found if texture.filter == "nearest"]


def radiance(hits: Hits, shadows: bool, samples: int) -> Tensor:
    """(N, C) the radiance of meshes by their materials and the scene's lights; of meshes without a material their colours. Zeros
    with the same derivatives, if the hits need no values. Which lights are seen is noted in the hits."""
    surfaces = hits._surfaces
    at, tensors = _at(hits)
    only = at.forced if hits._only_light else -1
    samples = samples if only < 0 else 1
    # Without values nothing is computed now; but once it must be, to note the lights whose shadows are asked for.
    known = not shadows or len(surfaces.shadowing) == len(surfaces.scene.casting)
    values = hits._needs_values or not known
    options = Options(shadows=shadows, samples=samples, only=only, in_fours=not hits._needs_values)
    found, *kept = apply(Shading(at, options, values), tensors)
    if not values:
        return found.to(surfaces.verts)
    (seen,) = kept
    column = 0
    for light, casting in enumerate(surfaces.scene.casting):
        if only not in (-1, light):
            continue
        own = seen[:, column]
        if shadows and bool((own >= 0).any()):
            surfaces.shadowing.add(light)
            if casting.punctual:
                hits._note_visibility(light, own)
        fours = options.in_fours and isinstance(casting, Environment) and surfaces.scene.is_glossy
        column += 1 if casting.punctual else samples * (MOST_FOURS * COMPANIONS if fours else 1)
    return found.to(surfaces.verts)


def indirect(hits: Hits, shadows: bool, bounces: int) -> Tensor:
    """(N, C) what is to be added of light that is scattered more than once, `bounces` times at most. Zeros with the same
    derivatives, if the hits need no values."""
    at, tensors = _at(hits)
    options = Options(shadows=shadows, samples=1, bounces=bounces)
    return apply(Indirect(at, options, hits._needs_values), tensors)[0].to(hits._surfaces.verts)


def _at(hits: Hits) -> tuple[AtPoints, list[Tensor | None]]:
    surfaces, view = hits._surfaces, hits._view
    assert isinstance(view, View)
    layout, tables = _layout(surfaces, view)
    forced, casters = hits._forced, surfaces.casters
    known = (None,) * 4 if forced is None else _forced(forced.points, forced.lit)
    points = Points(hits._face.cpu(), hits._seed.cpu(), *known)
    spread = hits._spread.cpu() if "mipmap" in _filters(surfaces.scene) else None
    number = -1 if forced is None else forced.light
    at = AtPoints(layout, len(tables), number, surfaces.verts.dtype, casters.cutoffs, casters.spacing)
    arrays = (part for part in casters if isinstance(part, Tensor))
    return at, [hits._exact.cpu(), spread, *points, *tables, *arrays]


def image(frame: Frame, options: Options, points: int) -> Tensor:
    """(H · W, C) the scene's surfaces before black, without derivatives, with `points` of each face in a pixel shaded."""
    layout, tables = _layout(frame.fixed, frame.fixed_view)
    seed, again = (int(frame.seeds(kind, 1)) & _64_BITS for kind in ("image", "image again"))

    def compute(kernel: Any, faces: Tensor, arguments: dict[str, Any], *tables: Tensor) -> Sequence[Tensor]:
        found, asked = kernel.lit_image(
            lit=layout.kernel(tables, faces),
            options=options._replace(dark=0.0).kernel,
            points=points,
            seed=seed,
            again=again,
            **arguments,
        )
        return torch.from_numpy(found), torch.from_numpy(asked)

    found, asked = frame.sampler.lit_image(compute, *tables)
    if options.shadows:
        lights = range(len(frame.surfaces.scene.casting))
        frame.surfaces.shadowing.update(light for light in lights if asked[light, 0])
    return frame.here(found)


def bounce_samples(frame: Frame, options: Options, further: int) -> tuple[CurveRecords, Tensor, Tensor]:
    """Samples on the borders of what surfaces of paths see of one another, and (S, C) float64 by how much the image jumps there,
    times what a sample stands for. Where light goes `further` steps after that: what has come to the first point of each, and
    (S, 3) from which unit directions (csrc/boundary/bounces.h)."""
    layout, tables = _layout(frame.fixed, frame.fixed_view)

    def compute(
        kernel: Any, casters: Any, faces: Tensor, arguments: dict[str, Any], *tables: Tensor
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
        return kernel.bounce_samples(
            casters, layout.kernel(tables, faces), options.kernel, further=further, **arguments
        )

    count, seed = frame.request.gradient.edge_samples, derived_seed(frame.sampler.grad_seed, -further)
    casters = frame.fixed.casters if frame.surfaces.scene.blends else None
    return frame.sampler.bounce_samples(compute, tables, seed, count, moves(frame.intrinsics), casters)


def towards_camera(frame: Frame, arrivals: Sequence[Tensor], steps: tuple[int, int]) -> list[Tensor]:
    """What comes to the image of light that has come to points, without derivatives: which point it is of (M,) int64, the places
    in the image (M, 2), and the radiance times px² (M, C). See csrc/shading/lit/towards_camera.h.

    arrivals  faces (N,), barycentrics (N, 3), seeds (N,), unit directions (N, 3) where the light came from, and how much (N, C)
    steps     the first and the last after which it goes to the camera
    """
    layout, tables = _layout(frame.fixed, frame.fixed_view)

    def compute(kernel: Any, faces: Tensor, arguments: dict[str, Any], *tensors: Tensor) -> Sequence[Tensor]:
        names, given = ("face", "b", "seed", "origin", "carried"), len(tensors) - len(tables)
        del arguments["hits"]
        found = kernel.towards_camera(
            layout.kernel(tensors[given:], faces),
            first=steps[0],
            last=steps[1],
            **{name: array(t) for name, t in zip(names, tensors, strict=False)},
            **arguments,
        )
        return [torch.from_numpy(part) for part in found]

    return list(frame.sampler.lit_image(compute, *(t.cpu() for t in arrivals), *tables))


def light_points(hits: Hits, light: Light, samples: int) -> list[LightPoints]:
    """`samples` points of a light for each of the hits, as radiance() draws them; where nothing arrives their density is
    infinite."""
    surfaces, view = hits._surfaces, hits._view
    assert isinstance(view, View)
    layout, tables = _layout(surfaces, view)
    filtered = "mipmap" in _filters(surfaces.scene)

    def compute(b: Tensor, face: Tensor, seed: Tensor, faces: Tensor, *others: Tensor) -> Sequence[Tensor]:
        spread, tables = (array(others[0]), others[1:]) if filtered else (None, others)
        points = core.LitPoints(face=array(face), b=array(b), seed=array(seed), spread=spread)
        options = core.LitOptions(shadows=False, samples=samples, only=-1, in_fours=False, dark=DARK)
        lit = layout.kernel(tables, faces)
        found = core.light_points(lit, points, options, hits._index(light), torch.get_num_threads())
        return [torch.from_numpy(x) for x in found]

    given = [hits._exact.cpu(), hits._face.cpu(), hits._seed.cpu(), surfaces.bare.faces]
    given += [*([hits._spread.cpu()] if filtered else ()), *tables]
    index, uv, density = (x.to(hits._face.device) for x in without_derivatives(compute, *given))
    density = torch.where(density > 0, density, math.inf)
    return [LightPoints(index[:, k], uv[:, k], density[:, k]) for k in range(samples)]


def light_on_faces(
    verts: Tensor, faces: Tensor, view: View, infinite: list[bool], place: Tensor, power: Tensor
) -> Tensor:
    """(F, 3, L) float64: E max(0, n·l) at the corners of flat faces, divided by its maximum (csrc/shading/lit/flat_light.h).

    place   (L, 3) positions of point lights, or directions to infinite ones
    power   (L,) in W/sr, or in W/m² of infinite ones
    """

    def compute(*tensors: Tensor) -> Sequence[Tensor]:
        verts, faces, eye, place, power = map(array, tensors)
        threads = torch.get_num_threads()
        found = core.light_on_faces(verts, faces, eye, view.perspective, place, infinite, power.tolist(), threads)
        return (torch.from_numpy(found),)

    tensors = (verts.double(), faces.int(), view.eye.double(), place.double(), power.double())
    return without_derivatives(compute, *tensors)[0].to(verts.device)


def _forced(points: Any, lit: Tensor) -> tuple[Tensor, ...]:
    return points.index.cpu(), points.uv.cpu().double(), points.density.cpu().double(), lit.cpu().to(torch.uint8)


class _Tables:
    """Tensors of a scene as tables on the CPU."""

    def __init__(self) -> None:
        self.tensors: list[Tensor] = []

    def add(self, tensor: Tensor | float | None, width: int) -> int:
        """The number of the table with rows of this width; −1 where there is no tensor."""
        if tensor is None:
            return -1
        tensor = torch.as_tensor(tensor).cpu()
        if tensor.dtype not in (torch.float32, torch.float64):
            tensor = tensor.double()
        self.tensors.append(tensor.reshape(-1, width))
        return len(self.tensors) - 1

    def add_numbers(self, tensor: Tensor | float | None) -> int:
        """A table of one row."""
        return -1 if tensor is None else self.add(tensor, torch.as_tensor(tensor).numel())


class _Layout(NamedTuple):
    """How a scene is made of tables: which table holds what."""

    meshes: list[Any]
    lamps: list[Any]
    verts: int
    eye: int
    perspective: bool
    channels: int
    ball: list[float]

    @classmethod
    def of(cls, surfaces: Surfaces, view: View, tables: _Tables) -> _Layout:
        scene = surfaces.scene
        verts, seen_from = tables.add(surfaces.bare.verts, 3), tables.add(view.eye, 3)
        firsts = np.cumsum([0, *(len(mesh.verts) for mesh in scene.meshes)])
        meshes = [_mesh(surfaces, index, int(vertex), tables) for index, vertex in enumerate(firsts[:-1])]
        eps = torch.finfo(surfaces.verts.dtype).eps
        still = (light for light in scene.lights if isinstance(light, SphericalHarmonics))
        lamps = [_lamp(scene, light, k, eps, tables) for k, light in enumerate((*scene.casting, *still))]
        center, radius = surfaces.ball
        ball = [*map(float, values_of(center)[0]), radius]
        return cls(meshes, lamps, verts, seen_from, view.perspective, scene.channels, ball)

    def kernel(self, tables: Sequence[Tensor], faces: Tensor) -> Any:
        parts = self._asdict()
        return core.Lit(tables=[array(t) for t in tables], faces=array(faces), **parts)


def _layout(surfaces: Surfaces, view: View) -> tuple[_Layout, list[Tensor]]:
    """The layout of surfaces and a view, and its tables; kept for points that have no derivatives."""
    if surfaces.layout is None or surfaces.layout[0] is not view:
        tables = _Tables()
        found = view, _Layout.of(surfaces, view, tables), tables.tensors
        if surfaces.has_derivatives:
            return found[1:]
        surfaces.layout = found
    return surfaces.layout[1:]


def _mesh(surfaces: Surfaces, index: int, first_vertex: int, tables: _Tables) -> Any:
    mesh, tangents = surfaces.scene.meshes[index], surfaces.tangents(index)
    none, material = core.LitSource("constant"), mesh.material

    def source(parameter: Parameter | float | None) -> Any:
        return none if parameter is None else _source(surfaces, mesh, parameter, tables)

    color = none
    if mesh.texture is not None:
        color = _texture(surfaces, mesh, Texture(mesh.texture, wrap=mesh.wrap, filter=mesh.filter), tables)
    elif mesh.colors is not None:
        color = core.LitSource("vertex", tables.add(mesh.colors, mesh.colors.shape[1]))
    elif mesh.face_colors is not None:
        color = core.LitSource("face", tables.add(mesh.face_colors, mesh.face_colors.shape[1]))
    elif mesh.corner_colors is not None:
        color = core.LitSource("corner", tables.add(mesh.corner_colors, mesh.corner_colors.shape[2]))
    normal_rows = mesh.faces if mesh.normal_faces is None else mesh.normal_faces
    map_ = None if material is None else material.normal_map
    return core.LitMesh(
        first_face=surfaces.first_faces[index],
        faces=len(mesh.faces),
        first_vertex=first_vertex,
        has_material=material is not None,
        two_sided=material is None or material.two_sided,
        lambertian=material is None or not material.is_glossy,
        color=color,
        base_color=source(None if material is None else material.base_color),
        metallic=source(None if material is None else material.metallic),
        roughness=source(None if material is None else material.roughness),
        emission=source(None if material is None else material.emission),
        normal_map=source(map_),
        normal_scale=-1 if map_ is None or material is None else tables.add(material.normal_scale, 1),
        tangents=none if tangents is None else core.LitSource("corner", tables.add(tangents, 4)),
        normals=tables.add(mesh.normals, 3),
        normal_faces=None if mesh.normals is None else _rows(normal_rows),
    )


def _source(surfaces: Surfaces, mesh: Mesh, parameter: Parameter | float, tables: _Tables) -> Any:
    if isinstance(parameter, Texture):
        return _texture(surfaces, mesh, parameter, tables)
    value = torch.as_tensor(parameter)
    if value.dim() == 2:
        return core.LitSource("vertex", tables.add(value, value.shape[1]))
    return core.LitSource("constant", tables.add_numbers(value))


def _texture(surfaces: Surfaces, mesh: Mesh, texture: Texture, tables: _Tables) -> Any:
    uvs, uv_faces = (mesh.uvs, mesh.uv_faces) if texture.uvs is None else (texture.uvs, texture.uv_faces)
    assert uvs is not None and uv_faces is not None
    height, width, channels = texture.image.shape
    texels, levels, filter = texture.image, 1, texture.filter
    if filter == "mipmap":
        pyramid = pyramid_of(surfaces, texture.image)
        texels, levels, filter = pyramid.texels, len(pyramid.first), "linear"
    return core.LitSource(
        "texture",
        tables.add(texels, channels),
        tables.add_numbers(texture.factor),
        tables.add(uvs, 2),
        _rows(uv_faces),
        height,
        width,
        [*(WRAPS.index(wrap) for wrap in texture.wraps), FILTERS.index(filter)],
        levels,
    )


def _lamp(scene: Scene, light: Light, number: int, eps: float, tables: _Tables) -> Any:
    stream = [mixed_bits(number * 0x10001 + k) for k in range(3)]

    def lamp(kind: str, **fields: Any) -> Any:
        return core.Lamp(kind, stream=stream, **{"eps": eps, **fields})

    if isinstance(light, MeshLight):
        mesh = next(i for i, mesh in enumerate(scene.meshes) if mesh is light.mesh)
        running, density = values_of(*light._table)
        glossy = any(m.material is not None and m.material.is_glossy for m in scene.meshes)
        # Where a ray meets a thin face, its rounding error is many times the spacing of doubles: a lamp must not hide itself.
        return lamp(
            "mesh",
            mesh=mesh,
            running=running,
            density=density,
            brightness=np.array([least_brightness(light)]),
            tree=tree_of(light) if glossy else None,
            hides=hides(light),
            eps=max(eps, 2.0**-40),
        )
    if isinstance(light, Environment):
        running, density, brightness, cosines = values_of(*light._table, light._brightness, light._cosines)
        height, width = light._size
        return lamp(
            "environment",
            radiance=tables.add(light.radiance, light.radiance.shape[-1]),
            rotation=tables.add_numbers(light.rotation),
            height=height,
            width=width,
            is_image=light.radiance.dim() == 3,
            running=running,
            density=density,
            brightness=brightness,
            cosines=cosines,
        )
    if isinstance(light, SphericalHarmonics):
        coefficients = tables.add(light.coefficients, light.coefficients.shape[1])
        return lamp("spherical harmonics", radiance=coefficients, rotation=tables.add_numbers(light.rotation))
    assert isinstance(light, (DirectionalLight, PointLight, SpotLight))
    power = {"intensity": tables.add(light.intensity, 1), "color": tables.add_numbers(light.color)}
    if isinstance(light, DirectionalLight):
        return lamp("directional", direction=tables.add(light.direction, 3), **power)
    if isinstance(light, PointLight):
        return lamp("point", position=tables.add(light.position, 3), **power)
    return lamp(
        "spot",
        position=tables.add(light.position, 3),
        direction=tables.add(light.direction, 3),
        inner_angle=tables.add(light.inner_angle, 1),
        outer_angle=tables.add(light.outer_angle, 1),
        **power,
    )


def _rows(index: Tensor) -> np.ndarray:
    return values_of(index)[0].astype(np.int32)
