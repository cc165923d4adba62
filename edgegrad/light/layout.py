"""A scene's lit surfaces as the kernel takes them (csrc/python/lit_arrays.h): tables of numbers, and meshes and lights that refer
to their numbers in it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..kernel.first_order import array
from ..library import core
from ..points.footprints import pyramid_of
from ..points.records import values_of
from ..points.seeds import mixed_bits
from ..points.surfaces import CameraView, Surfaces
from ..scene.environment import Environment
from ..scene.lights import DirectionalLight, Light, PointLight, SphericalHarmonics, SpotLight
from ..scene.material import WRAPS, Parameter, Texture
from ..scene.mesh import FILTERS, Mesh
from ..scene.mesh_light import MeshLight
from ..scene.scene import Scene
from .sampling import hides, least_brightness, tree_of


class _Tables:
    """Tensors of a scene as tables on the CPU, of colours with more channels than the kernel takes some channels alone."""

    def __init__(self, channels: slice) -> None:
        self.tensors: list[Tensor] = []
        self.channels = channels

    def add(self, tensor: Tensor | float | None, width: int) -> int:
        """Return the number of a new table with rows of this width, or −1 where there is no tensor."""
        if tensor is None:
            return -1
        tensor = torch.as_tensor(tensor).cpu()
        if tensor.dtype not in (torch.float32, torch.float64):
            tensor = tensor.double()
        tensor = tensor.reshape(-1, width)
        self.tensors.append(tensor[:, self.channels] if width > core.MOST_LIT_CHANNELS else tensor)
        return len(self.tensors) - 1

    def add_numbers(self, tensor: Tensor | float | None) -> int:
        """Return the number of a new table of one row, or −1."""
        return -1 if tensor is None else self.add(tensor, torch.as_tensor(tensor).numel())


class Layout(NamedTuple):
    """The tables of a scene: which holds what."""

    meshes: list[Any]
    lights: list[Any]
    verts: int
    eye: int
    perspective: bool
    channels: int
    ball: list[float]

    @classmethod
    def from_surfaces(cls, surfaces: Surfaces, view: CameraView, tables: _Tables) -> Layout:
        scene = surfaces.scene
        verts, seen_from = tables.add(surfaces.geometry.verts, 3), tables.add(view.eye, 3)
        firsts = np.cumsum([0, *(len(mesh.verts) for mesh in scene.meshes)])
        meshes = [_mesh(surfaces, index, int(vertex), tables) for index, vertex in enumerate(firsts[:-1])]
        eps = torch.finfo(surfaces.verts.dtype).eps
        still = (light for light in scene.lights if isinstance(light, SphericalHarmonics))
        lights = [_kernel_light(scene, light, k, eps, tables) for k, light in enumerate((*scene.casting, *still))]
        center, radius = surfaces.ball
        ball = [*map(float, values_of(center)[0]), radius]
        channels = len(range(scene.channels)[tables.channels])
        return cls(meshes, lights, verts, seen_from, view.perspective, channels, ball)

    def kernel(self, tables: Sequence[Tensor], faces: Tensor) -> Any:
        parts = self._asdict()
        return core.Lit(tables=[array(t) for t in tables], faces=array(faces), **parts)


def channel_groups(scene: Scene) -> list[slice]:
    """Return the channels of a scene in groups that the kernel shades at once, of about equal sizes."""
    C = scene.channels
    count = -(-C // core.MOST_LIT_CHANNELS)
    return [slice(None)] if count == 1 else [slice(C * k // count, C * (k + 1) // count) for k in range(count)]


def layout_of(surfaces: Surfaces, view: CameraView, channels: slice = slice(None)) -> tuple[Layout, list[Tensor]]:
    """Return the layout of surfaces and a view, and its tables; they are kept for points that have no derivatives."""
    if surfaces.layout is None or surfaces.layout[0] is not view or surfaces.layout[1] != channels:
        tables = _Tables(channels)
        found = view, channels, Layout.from_surfaces(surfaces, view, tables), tables.tensors
        if surfaces.has_derivatives:
            return found[2:]
        surfaces.layout = found
    return surfaces.layout[2:]


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


def _kernel_light(scene: Scene, light: Light, number: int, eps: float, tables: _Tables) -> Any:
    stream = [mixed_bits(number * 0x10001 + k) for k in range(3)]

    def described(kind: str, **fields: Any) -> Any:
        return core.Light(kind, stream=stream, **{"eps": eps, **fields})

    if isinstance(light, MeshLight):
        mesh = next(i for i, mesh in enumerate(scene.meshes) if mesh is light.mesh)
        running, density = values_of(*light._table)
        glossy = any(m.material is not None and m.material.is_glossy for m in scene.meshes)
        # Where a ray meets a thin face, its rounding error is many times the spacing of doubles: a light must not hide itself.
        return described(
            "mesh",
            mesh=mesh,
            running=running,
            pdf=density,
            brightness=np.array([least_brightness(light)]),
            tree=tree_of(light) if glossy else None,
            hides=hides(light),
            eps=max(eps, 2.0**-40),
        )
    if isinstance(light, Environment):
        running, density, brightness, cosines = values_of(*light._table, light._brightness, light._cosines)
        height, width = light._size
        return described(
            "environment",
            radiance=tables.add(light.radiance, light.radiance.shape[-1]),
            rotation=tables.add_numbers(light.rotation),
            height=height,
            width=width,
            is_image=light.radiance.dim() == 3,
            running=running,
            pdf=density,
            brightness=brightness,
            cosines=cosines,
        )
    if isinstance(light, SphericalHarmonics):
        coefficients = tables.add(light.coefficients, light.coefficients.shape[1])
        return described("spherical harmonics", radiance=coefficients, rotation=tables.add_numbers(light.rotation))
    if not isinstance(light, (DirectionalLight, PointLight, SpotLight)):
        raise TypeError(
            f"lights: expected lights that edgegrad shades with, got {type(light).__name__}; shade with it in a shader= of "
            "your own, by hits.light_points()"
        )
    power = {"intensity": tables.add(light.intensity, 1), "color": tables.add_numbers(light.color)}
    if isinstance(light, DirectionalLight):
        return described("directional", direction=tables.add(light.direction, 3), **power)
    if isinstance(light, PointLight):
        return described("point", position=tables.add(light.position, 3), **power)
    return described(
        "spot",
        position=tables.add(light.position, 3),
        direction=tables.add(light.direction, 3),
        inner_angle=tables.add(light.inner_angle, 1),
        outer_angle=tables.add(light.outer_angle, 1),
        **power,
    )


def _rows(index: Tensor) -> np.ndarray:
    return values_of(index)[0].astype(np.int32)
