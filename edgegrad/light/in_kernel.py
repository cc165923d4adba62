"""Radiance of lit surfaces by the kernel (csrc/shading/lit), with derivatives by all tensors of the scene, in reverse and in
forward mode. Scenes of more channels than the kernel takes are shaded some channels after the other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..kernel.derivatives import moves
from ..kernel.first_order import apply, array, without_derivatives
from ..kernel.threads import threads
from ..library import core
from ..points.hits import Hits
from ..points.image_context import ImageContext
from ..points.records import CurveRecords
from ..points.surfaces import CameraView
from ..sampling import derived_seed
from ..scene.environment import Environment
from ..scene.lights import Light, LightPoints
from ..scene.material import Texture
from ..scene.mesh import Mesh
from ..scene.scene import Scene
from .at_points import AtPoints, Indirect, LitOptions, PointTensors, Shading
from .layout import channel_groups, layout_of
from .sampling import DARK

_64_BITS = 2**64 - 1


def is_fused(scene: Scene) -> bool:
    """Return whether the kernel can shade a whole image of a scene by itself. Where one sees through surfaces, texels that are
    nearest must be declared as discontinuities at each of them."""
    if scene.channels > core.MOST_LIT_CHANNELS:
        return False
    return not scene.blends or "nearest" not in _filters(scene)


def _filters(scene: Scene) -> set[str]:
    """Return the filters of all textures."""
    textures = [t for m in scene.meshes if m.material is not None for t in m.material.textures.values()]
    return {*(mesh.filter for mesh in scene.meshes if mesh.texture is not None), *(t.filter for t in textures)}


def nearest_textures(mesh: Mesh) -> list[Texture]:
    """Return the textures of a mesh that give the nearest texel, in the order in which shading reads them."""
    found = [] if mesh.texture is None else [Texture(mesh.texture, wrap=mesh.wrap, filter=mesh.filter)]
    if mesh.material is not None:
        m = mesh.material
        given = (m.base_color, m.normal_map, m.metallic, m.roughness, m.emission)
        found += [texture for texture in given if isinstance(texture, Texture)]
    return [texture for texture in found if texture.filter == "nearest"]


def radiance(hits: Hits, shadows: bool, samples: int) -> Tensor:
    """Return the radiance (N, C) of meshes by their materials and the scene's lights; of meshes without a material their colours.
    If the hits need no values, these are zeros with the same derivatives. Which lights are seen is noted in the hits."""
    groups = channel_groups(hits._surfaces.scene)
    found = [_radiance(hits, shadows, samples, channels) for channels in groups]
    return found[0] if len(found) == 1 else torch.cat(found, 1)


def _radiance(hits: Hits, shadows: bool, samples: int, channels: slice) -> Tensor:
    surfaces = hits._surfaces
    at, tensors = _at(hits, channels)
    only = at.forced if hits._only_light else -1
    samples = samples if only < 0 else 1
    # Without values nothing is computed now; but once it must be, to note the lights whose shadows are asked for.
    known = not shadows or len(surfaces.shadowing) == len(surfaces.scene.casting)
    values = hits._needs_values or not known
    options = LitOptions(shadows=shadows, samples=samples, only=only, antithetic=not hits._needs_values)
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
        sets = options.antithetic and isinstance(casting, Environment) and surfaces.scene.is_glossy
        column += 1 if casting.punctual else samples * (core.MOST_SETS_FOR_ONE * core.SET_SIZE if sets else 1)
    return found.to(surfaces.verts)


def indirect(hits: Hits, shadows: bool, bounces: int, only_near_field: float = 0.0) -> Tensor:
    """Return the radiance (N, C) that light adds which is scattered more than once, `bounces` times at most.

    only_near_field : if above 0, only that of light which comes from so near, in world units

    If the hits need no values, these are zeros with the same derivatives.
    """
    at, tensors = _at(hits)
    options = LitOptions(
        shadows, 1, bounces=bounces, near=only_near_field or hits._near, only_near_field=only_near_field > 0
    )
    return apply(Indirect(at, options, hits._needs_values), tensors)[0].to(hits._surfaces.verts)


def _at(hits: Hits, channels: slice = slice(None)) -> tuple[AtPoints, list[Tensor | None]]:
    surfaces, view = hits._surfaces, hits._view
    assert isinstance(view, CameraView)
    layout, tables = layout_of(surfaces, view, channels)
    forced, casters = hits._forced, surfaces.casters
    known = (None,) * 4 if forced is None else _forced(forced.points, forced.lit)
    points = PointTensors(hits._face.cpu(), hits._seed.cpu(), *known)
    spread = hits._spread.cpu() if "mipmap" in _filters(surfaces.scene) else None
    number = -1 if forced is None else forced.light
    at = AtPoints(layout, len(tables), number, surfaces.verts.dtype, casters.cutoffs, casters.spacing)
    arrays = (part for part in casters if isinstance(part, Tensor))
    return at, [hits._exact.cpu(), spread, *points, *tables, *arrays]


def image(context: ImageContext, options: LitOptions, points: int) -> Tensor:
    """Return the image (H · W, C) of surfaces before black, without derivatives; `points` of each face in a pixel are shaded."""
    layout, tables = layout_of(context.fixed, context.fixed_view)
    seed, again = (int(context.seeds(kind, 1)) & _64_BITS for kind in ("image", "image again"))

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

    found, asked = context.sampler.lit_image(compute, *tables)
    if options.shadows:
        lights = range(len(context.surfaces.scene.casting))
        context.surfaces.shadowing.update(light for light in lights if asked[light, 0])
    return context.here(found)


def secondary_edge_samples(
    context: ImageContext, options: LitOptions, further: int
) -> tuple[CurveRecords, Tensor, Tensor]:
    """Return samples on secondary edges, and (S, C) float64 the jump of the image there times what a sample stands for.

    Where light goes `further` steps after that, it is the light that has come to the first point of each sample instead, and
    (S, 3) the unit directions it came from (csrc/secondary/secondary_edges.h).
    """
    own = {"further": further, "seen": further == 0}
    return _samples_of_lines(
        context, options, "secondary_edge_samples", derived_seed(context.sampler.grad_seed, -further), own
    )


def surface_edge_samples(
    context: ImageContext, options: LitOptions, further: int, crossings: bool, alpha_edges: bool
) -> tuple[CurveRecords, Tensor, Tensor]:
    """Return samples on the curves at which emitters or reflectors end: where faces pass through each other, and alpha edges.
    The first point of each gets light from there, that may go `further` steps after that; see secondary_edge_samples()."""
    own = {"further": further, "crossings": crossings, "alpha_edges": alpha_edges}
    seed = derived_seed(context.sampler.grad_seed, -core.MOST_BOUNCES - further)
    return _samples_of_lines(context, options, "surface_edge_samples", seed, own)


def _samples_of_lines(
    context: ImageContext, options: LitOptions, method: str, seed: int, own: dict[str, Any]
) -> tuple[CurveRecords, Tensor, Tensor]:
    layout, tables = layout_of(context.fixed, context.fixed_view)

    def compute(
        kernel: Any, casters: Any, faces: Tensor, arguments: dict[str, Any], *tables: Tensor
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
        return getattr(kernel, method)(casters, layout.kernel(tables, faces), options.kernel, **own, **arguments)

    count = context.request.gradient.edge_samples
    casters = context.fixed.casters if context.surfaces.scene.blends else None
    return context.sampler.secondary_edge_samples(compute, tables, seed, count, moves(context.intrinsics), casters)


def towards_camera(context: ImageContext, arrivals: Sequence[Tensor], steps: tuple[int, int]) -> list[Tensor]:
    """Return what reaches the image of light that has come to points, without derivatives: the point it comes from (M,) int64,
    places in the image (M, 2), and radiance times px² (M, C). See csrc/shading/lit/light_tracing.h.

    arrivals  faces (N,), barycentrics (N, 3), seeds (N,), unit directions (N, 3) where the light came from, and how much (N, C)
    steps     the first and the last after which it goes to the camera
    """
    layout, tables = layout_of(context.fixed, context.fixed_view)

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

    return list(context.sampler.lit_image(compute, *(t.cpu() for t in arrivals), *tables))


def light_points(hits: Hits, light: Light, samples: int) -> list[LightPoints]:
    """Return `samples` points of a light for each of the hits, as radiance() draws them for the first channels that it takes.
    Where nothing arrives their density is infinite."""
    surfaces, view = hits._surfaces, hits._view
    assert isinstance(view, CameraView)
    layout, tables = layout_of(surfaces, view, channel_groups(surfaces.scene)[0])
    filtered = "mipmap" in _filters(surfaces.scene)

    def compute(b: Tensor, face: Tensor, seed: Tensor, faces: Tensor, *others: Tensor) -> Sequence[Tensor]:
        spread, tables = (array(others[0]), others[1:]) if filtered else (None, others)
        points = core.LitPoints(face=array(face), b=array(b), seed=array(seed), spread=spread)
        options = core.LitOptions(shadows=False, samples=samples, only=-1, antithetic=False, dark=DARK)
        lit = layout.kernel(tables, faces)
        found = core.light_points(lit, points, options, hits._index(light), threads())
        return [torch.from_numpy(x) for x in found]

    given = [hits._exact.cpu(), hits._face.cpu(), hits._seed.cpu(), surfaces.geometry.faces]
    given += [*([hits._spread.cpu()] if filtered else ()), *tables]
    index, uv, density = (x.to(hits._face.device) for x in without_derivatives(compute, *given))
    density = torch.where(density > 0, density, math.inf)
    return [LightPoints(index[:, k], uv[:, k], density[:, k]) for k in range(samples)]


def light_on_faces(
    verts: Tensor, faces: Tensor, view: CameraView, infinite: list[bool], place: Tensor, power: Tensor
) -> Tensor:
    """Return E max(0, n·l) at the corners of flat faces (F, 3, L) float64, over its maximum (csrc/shading/lit/flat_light.h).

    place   (L, 3) positions of point lights, or directions to infinite ones
    power   (L,) in W/sr, or in W/m² of infinite ones
    """

    def compute(*tensors: Tensor) -> Sequence[Tensor]:
        verts, faces, eye, place, power = map(array, tensors)
        found = core.light_on_faces(verts, faces, eye, view.perspective, place, infinite, power.tolist(), threads())
        return (torch.from_numpy(found),)

    tensors = (verts.double(), faces.int(), view.eye.double(), place.double(), power.double())
    return without_derivatives(compute, *tensors)[0].to(verts.device)


def _forced(points: Any, lit: Tensor) -> tuple[Tensor, ...]:
    return points.index.cpu(), points.uv.cpu().double(), points.density.cpu().double(), lit.cpu().to(torch.uint8)
