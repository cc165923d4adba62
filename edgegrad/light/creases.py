"""Creases of lit scenes: edges at which radiance may jump."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ..points.hits import Hits
from ..points.surfaces import CameraView, Rays, Surfaces
from ..scene.appearance import jumps
from ..scene.lights import SphericalHarmonics
from . import in_kernel
from .bsdf import dot, terminator

ABOVE_HORIZON = 0.01  # the horizon, by which a lobe reaches there


def note_jumps(hits: Hits, indirect: bool = False) -> None:
    """Note what of the radiance of materials may jump. `indirect`: light also comes by way of other surfaces."""
    surfaces = hits._surfaces
    scene = surfaces.scene
    if len(scene.meshes) > 1:
        hits._note_jump("mesh", lambda: surfaces.mesh_of_face[:, None, None].expand(-1, 3, 1))
    for index, mesh in enumerate(scene.meshes):
        hits._note_jump(("appearance", index), _of_scene(surfaces, index, lambda i=index: _appearance(surfaces, i)))
        if mesh.material is None or not (scene.lights or scene.casting):
            continue
        if mesh.normals is None:
            seen_by = hits._view
            hits._note_jump(
                ("g", index),
                _of_scene(surfaces, index, lambda i=index, v=seen_by: _flat_radiance(surfaces, i, v, indirect)),
            )
            continue
        if mesh.normal_faces is not None:
            normals, rows = mesh.normals, mesh.normal_faces
            hits._note_jump(("n", index), _of_scene(surfaces, index, lambda n=normals, r=rows: n[r.long()]))
        if scene.casting:
            seen_by = hits._view
            hits._note_jump(
                ("lit", index),
                _of_scene(surfaces, index, lambda i=index, v=seen_by: _shadow_terminators(surfaces, i, v, indirect)),
            )


def _of_scene(surfaces: Surfaces, index: int, of_mesh: Callable[[], Tensor]) -> Callable[[], Tensor]:
    """Return values (F, 3, K) of all faces from those of one mesh, zero elsewhere."""

    def corners() -> Tensor:
        own = of_mesh().detach()
        if len(own) == len(surfaces.faces):
            return own
        first = surfaces.first_faces[index]
        after = len(surfaces.faces) - first - len(own)
        before, behind = (own.new_zeros((count, *own.shape[1:])) for count in (first, after))
        return torch.cat([before, own, behind])  # pad() of torch 2.4 refuses what has no columns

    return corners


def _appearance(surfaces: Surfaces, index: int) -> Tensor:
    return jumps(surfaces.scene.meshes[index], surfaces.tangents(index))


def _faces_of(surfaces: Surfaces, index: int) -> Tensor:
    first = surfaces.first_faces[index]
    return torch.arange(first, first + len(surfaces.scene.meshes[index].faces), device=surfaces.verts.device)


def _face_normals(surfaces: Surfaces, index: int) -> Tensor:
    return surfaces.face_normals(_faces_of(surfaces, index))[:, None].expand(-1, 3, -1)


def _flat_radiance(surfaces: Surfaces, index: int, view: CameraView | Rays, indirect: bool) -> Tensor:
    """Return what may jump at edges of a mesh without shading normals, besides colours (F, 3, K).

    That is the face's normal on the viewer's side; if all light is that of punctual lights, only of faces that one of them
    lights. Of Lambertian faces it is then E max(0, n·l) of each light: if both faces agree at the ends of an edge, they agree
    all along it, for n·l |l| is the light's distance from the face's plane. The cone of a spot light may end between the ends,
    and is left out.
    """
    scene, mesh = surfaces.scene, surfaces.scene.meshes[index]
    material = mesh.material
    assert material is not None
    harmonics = any(isinstance(light, SphericalHarmonics) for light in scene.lights)
    points_alone = not harmonics and not indirect and all(light.punctual for light in scene.casting)
    if not points_alone or material.normal_map is not None or not isinstance(view, CameraView):
        return _face_normals(surfaces, index)
    verts = mesh.verts.detach().double()
    places = [light.place(light.draw(verts[:1])).detach().to(verts) for light in scene.casting]
    power = [light._power(verts).detach().abs().mean() for light in scene.casting]
    infinite = [light.infinite for light in scene.casting]
    found = in_kernel.light_on_faces(verts, mesh.faces, view, infinite, torch.cat(places), torch.stack(power))
    if not material.is_glossy:
        return found
    g = _face_normals(surfaces, index)
    away = dot(g[:, 0], view.to_viewer(verts[mesh.faces[:, 0].long()])) < 0
    return torch.where(away[:, None], -g, g) * (found != 0).any(-1, keepdim=True)


def _shadow_terminators(surfaces: Surfaces, index: int, view: CameraView | Rays, indirect: bool) -> Tensor:
    """Return n·l times the shadow terminator at corners, with interpolated normals n, for each light (F, 3, K).

    The face's normal g enters through the terminator alone, which is 1 where g·l ≥ (g·n)(n·l). So of a fine mesh only edges near
    the terminator are creases. An extended light, or another surface, has a terminator for each of its points: then g itself is
    compared, and of glossy surfaces the terminator of what a mirror would show, which is where most of the jump is.
    """
    mesh, lights = surfaces.scene.meshes[index], surfaces.scene.casting
    assert mesh.normals is not None
    of_faces = _face_normals(surfaces, index)
    found = [] if all(light.punctual for light in lights) and not indirect else [of_faces]
    g = of_faces.reshape(-1, 3)
    rows = mesh.faces if mesh.normal_faces is None else mesh.normal_faces
    n = normalize(mesh.normals.detach().to(g), dim=-1)[rows.long()].reshape(-1, 3)
    n = torch.where(dot(n, g) < 0, -n, n)
    position = mesh.verts.detach().to(g)
    assert mesh.material is not None
    if found and mesh.material.is_glossy and isinstance(view, CameraView):
        v = view.to_viewer(position).to(g)[mesh.faces.long()].reshape(-1, 3)
        v = torch.where(dot(n, v) < 0, -v, v)
        l = normalize(2 * dot(n, v) * n - v + ABOVE_HORIZON * n, dim=-1)
        found.append(terminator(g, n, l).reshape(-1, 3, 1))
    for light in lights:
        if light.punctual:
            l = light.incident(light.draw(position), position).detach()
            l = l.expand(len(position), 3)[mesh.faces.long()].reshape(-1, 3)
            side = torch.where(dot(n, l) < 0, -1.0, 1.0).to(g)
            found.append((dot(n, l) * terminator(side * g, side * n, l)).reshape(-1, 3, 1))
    return torch.cat(found, -1)
