"""Scenes: meshes before a background, and the flat arrays that the kernel reads."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ._check import (
    MOST_ROWS,
    all_below,
    as_tensor,
    check_fields,
    check_finite,
    check_float,
    check_shape,
    values_visible,
)
from ._mesh_light import MeshLight
from ._tree import map_tensors, moved
from .lights import Light
from .material import WRAPS
from .mesh import FILTERS, PLAIN, Mesh


@dataclass(frozen=True, eq=False)
class Scene:
    """Meshes that hide one another, before a background.

    meshes      a sequence of Mesh (or one), all with the same number of channels C
    background  (C,) or (H, W, C) float, linear radiance where nothing is hit; black when None. An image is laid behind
                the pixels: I = Σ samples that hit + (1 − coverage) · background
    lights      a sequence of lights; meshes whose materials have emission are lights too, and those among `lights` join the
                meshes. All with one channel or C

    With a light, or a mesh with a material, the scene is lit: meshes with a material are shaded, those without keep their
    colours for radiance. Raises TypeError or ValueError.
    """

    meshes: Sequence[Mesh]
    background: Tensor | None = None
    lights: Sequence[Light | Mesh] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.meshes, (Mesh, Sequence)):
            raise TypeError(f"meshes: expected a Mesh or a sequence of them, got {type(self.meshes).__name__}")
        meshes = (self.meshes,) if isinstance(self.meshes, Mesh) else tuple(self.meshes)
        meshes = self._check_lights(meshes)
        object.__setattr__(self, "meshes", meshes)
        if not meshes:
            raise ValueError("meshes: expected at least one Mesh, got none")
        for i, mesh in enumerate(meshes):
            if not isinstance(mesh, Mesh):
                raise TypeError(f"meshes[{i}]: expected a Mesh, got {type(mesh).__name__}")
        known = {mesh.channels for mesh in meshes if mesh.channels is not None}
        if len(known) > 1:
            first = next(i for i, m in enumerate(meshes) if m.channels is not None)
            C = meshes[first].channels
            i = next(i for i, m in enumerate(meshes) if m.channels not in (None, C))
            raise ValueError(
                f"meshes[{i}]: expected {C} channels like meshes[{first}], got {meshes[i].channels}; "
                "give all colours and textures the same number of channels"
            )
        for i, light in enumerate(self._lights):
            if light.channels is not None and known and light.channels not in known:
                raise ValueError(
                    f"lights[{i}]: expected {next(iter(known))} channels, or one, like the meshes and lights before it, got "
                    f"{light.channels}; give it a colour for each channel"
                )
            known |= set() if light.channels is None else {light.channels}
        corners = 3 * sum(mesh.faces.shape[0] for mesh in meshes)
        rows = max(
            corners, *(sum(len(t) for m in meshes if (t := getattr(m, n)) is not None) for n in ("verts", "uvs"))
        )
        if rows > MOST_ROWS:
            raise ValueError(
                f"meshes: expected at most {MOST_ROWS} vertices, texture coordinates and corners of faces in all, got {rows}; "
                "render them in parts"
            )
        devices = {mesh.verts.device for mesh in meshes}
        if len(devices) > 1:
            raise ValueError(f"meshes: expected one device, got {sorted(map(str, devices))}; move them with mesh.to(…)")
        if self.background is not None:
            background = as_tensor("background", self.background, like=meshes[0].verts)
            object.__setattr__(self, "background", background)
            C = next(iter(known)) if known else "C"
            check_float("background", background)
            fix = (
                "as many channels as the colours of the meshes; for a shader of others leave these away"
                if known
                else ""
            )
            check_shape("background", background, (C,), ("H", "W", C), fix=fix)
            check_finite("background", background)

    def _check_lights(self, meshes: tuple[Mesh, ...]) -> tuple[Mesh, ...]:
        """The meshes, with those among the lights. Raises TypeError or ValueError."""
        given = (self.lights,) if isinstance(self.lights, (Light, Mesh)) else self.lights
        if not isinstance(given, Sequence):
            raise TypeError(f"lights: expected a sequence of lights, got {type(given).__name__}")
        own = []
        for i, light in enumerate(given):
            if isinstance(light, Mesh):
                if light.material is None or light.material.emission is None:
                    raise ValueError(
                        f"lights[{i}]: expected a light, got a Mesh without emission; give it material=eg.Material(emission=…)"
                    )
                meshes = (*meshes, light)
            elif isinstance(light, Light) and not isinstance(light, MeshLight):
                own.append(light)
            else:
                raise TypeError(
                    f"lights[{i}]: expected a light such as eg.PointLight, or a Mesh that emits, got {type(light).__name__}"
                )
        object.__setattr__(self, "lights", tuple(own))
        return meshes

    @property
    def _lights(self) -> tuple[Light, ...]:
        return self.lights  # pyright: ignore[reportReturnType]: those that are meshes joined the meshes

    @property
    def is_lit(self) -> bool:
        """Whether meshes are shaded: one has a material, or there is a light."""
        return bool(self.lights) or any(mesh.material is not None for mesh in self.meshes)

    @property
    def is_shaded(self) -> bool:
        """Whether more than the kernel's own colours is to be seen: light, or mipmaps."""
        return self.is_lit or any(mesh.texture is not None and mesh.filter == "mipmap" for mesh in self.meshes)

    @property
    def textured_faces(self) -> Tensor | None:
        """(F,) uint8 on the CPU: the faces whose colours or materials have textures; None: none have."""
        if not any(mesh.has_textures for mesh in self.meshes):
            return None
        return torch.cat([torch.full((len(m.faces),), m.has_textures, dtype=torch.uint8) for m in self.meshes])

    @property
    def blends(self) -> bool:
        """Whether one sees through a mesh."""
        return any(mesh.blends for mesh in self.meshes)

    @cached_property
    def casting(self) -> tuple[Light, ...]:
        """The lights that cast shadows, in a fixed order: those of `lights`, then the meshes that emit."""
        emitting = [m for m in self.meshes if m.material is not None and m.material.emission is not None]
        return (*(light for light in self._lights if light.casts), *map(MeshLight, emitting))

    @property
    def channels(self) -> int:
        """Number of channels C; 3 for a plain scene on black."""
        for part in (*self.meshes, *self._lights):
            if part.channels is not None:
                return part.channels
        return 3 if self.background is None else self.background.shape[-1]

    def replace(self, **fields: Any) -> Scene:
        """This scene with some fields replaced."""
        check_fields(self, fields)
        return dataclasses.replace(self, **fields)

    def transformed(self, R: Tensor | None = None, t: Tensor | None = None, scale: Tensor | float = 1.0) -> Scene:
        """All meshes and lights moved together; see Mesh.transformed. Surfaces stay as bright: the intensities of points
        and spots, which fall off with distance, grow as areas do. Of lights from all around R must be a rotation."""
        return self.replace(
            meshes=[mesh.transformed(R, t, scale) for mesh in self.meshes],
            lights=[light.transformed(R, t, scale) for light in self._lights],
        )

    def to(self, *args: Any, **kwargs: Any) -> Scene:
        """All tensors moved to a device or dtype, as `torch.Tensor.to`."""
        return moved(self, *args, **kwargs)

    def detach(self) -> Scene:
        """The same scene, cut from the autograd graph."""
        return map_tensors(self, Tensor.detach)

    def __repr__(self) -> str:
        back = "black" if self.background is None else f"background {tuple(self.background.shape)}"
        lights = "".join(f", {type(light).__name__}" for light in self.lights)
        return f"Scene({', '.join(map(repr, self.meshes))}; {back}{lights})"

    def _repr_png_(self) -> bytes | None:
        """What notebooks show; None where it cannot be drawn."""
        from ._preview import thumbnail

        try:
            return thumbnail(self)
        except (ImportError, MemoryError, OSError, TypeError, ValueError):
            return None


class Flat(NamedTuple):
    """A scene as the kernel reads it: the meshes laid end to end, on the CPU. A corner of a face refers to a row of
    `colors`, or, where the face is textured, to a row of `uvs`; colours of vertices, faces and corners differ only in that index.
    """

    verts: Tensor  # (V, 3) float64
    faces: Tensor  # (F, 3) int32, rows of verts
    corners: Tensor  # (F, 3) int32, rows of colors or of uvs
    colors: Tensor  # (A, C) float32 or float64
    uvs: Tensor  # (T, 2) float64
    texels: Tensor  # (X, C), the textures end to end, row by row
    textures: Tensor  # (N, 6) int64: first texel, height, width, wrap of u and v, filter
    face_texture: Tensor  # (F,) int32: texture of the face, −1 for none; (0,) when the scene has no texture
    uv_corners: Tensor  # (F, 3) int32, rows of uvs, −1 for none; (0, 3) when corners say as much
    alphas: Tensor  # (Y, 1), alpha textures end to end, row by row
    cut_outs: Tensor  # (M, 6) int64: first of its alphas, height, width, wrap of u and v, filter
    face_cut_out: Tensor  # (F,) int32: cut-out of the face, −1 for none; (0,) when the scene has none
    background: Tensor  # (C,) or (H, W, C)
    cutoffs: list[float]  # of the cut-outs
    spacing: list[
        float
    ]  # of the numbers in which the vertices were given: pairs of a vertex and the spacing from there on

    @property
    def has_steps(self) -> bool:
        """Whether something jumps within a face: it is cut out, or its texels are."""
        return len(self.cut_outs) > 0 or bool((self.textures[:, 5] == FILTERS.index("nearest")).any())


def _rows(index: Tensor, count: int, offset: int, alone: bool) -> Tensor:
    """Indices into `count` rows as indices into all rows, int32. What is out of range stays so, for the kernel to refuse: it
    must not wrap around, nor reach into the rows of another mesh, so unless the mesh is alone it becomes −1."""
    index = index.cpu()
    if alone:
        # A look at the extremes costs less than a copy of a million indices.
        if index.dtype == torch.int64 and (not values_visible(index) or not all_below(index, 2**31)):
            index = index.clamp(-(2**31), 2**31 - 1)
    else:
        index = index.long()  # in fewer bits the sum could wrap around too
        index = torch.where((index >= 0) & (index < count), index + offset, -1)
    return index.to(torch.int32)


def _vertex_spacing(scene: Scene) -> list[float]:
    """The relative spacing of the numbers in which the vertices were given, by which copies of a point may differ: pairs of
    the number of a vertex in the flat arrays and the spacing from there on."""
    pairs: list[float] = []
    n_verts = 0
    for mesh in scene.meshes:
        spacing = torch.finfo(mesh.verts.dtype).eps
        if not pairs or pairs[-1] != spacing:
            pairs += [float(n_verts), spacing]
        n_verts += mesh.verts.shape[0]
    return pairs


def image_dtype(scene: Scene) -> torch.dtype:
    """That of the colours, or, if there are none, of the vertices; float32 or float64."""
    floats = [t for m in scene.meshes for t in (m.colors, m.face_colors, m.corner_colors, m.texture) if t is not None]
    floats += [scene.background] if scene.background is not None else []
    floats = floats or [scene.meshes[0].verts]
    return torch.float64 if any(t.dtype == torch.float64 for t in floats) else torch.float32


def _sampler(mesh: Mesh) -> list[int]:
    """How the images of a mesh are looked up: the wrap of u and of v, and the filter, as the kernel counts them. It knows no
    mipmaps: their levels are of the texture, which it is not given where there are some."""
    u, v = mesh.wraps
    filter = "linear" if mesh.filter == "mipmap" else mesh.filter
    return [WRAPS.index(u), WRAPS.index(v), FILTERS.index(filter)]


def flatten(scene: Scene, all_uvs: bool = False, blended: bool = True) -> Flat:
    """The arrays of a scene; every step is a differentiable torch operation, so gradients find their way back.

    all_uvs   also texture coordinates that neither a texture nor a cut-out needs
    blended   whether meshes that blend are there as a whole; else they are cut out where their alpha is below ½
    """
    C = scene.channels
    cpu = torch.device("cpu")  # said everywhere, for a user may have set another default device
    dtype = image_dtype(scene)
    any_texture = any(mesh.texture is not None for mesh in scene.meshes)

    def empty(width: int, kind: torch.dtype) -> Tensor:
        return torch.empty((0, width), dtype=kind, device=cpu)

    def is_cut(mesh: Mesh) -> bool:
        return mesh.alpha is not None and not (blended and mesh.blends)

    any_cut_out = any(map(is_cut, scene.meshes))

    def has_uvs(mesh: Mesh) -> bool:
        return mesh.texture is not None or is_cut(mesh) or (all_uvs and mesh.uvs is not None)

    own_uvs = any_cut_out or any(has_uvs(mesh) and mesh.texture is None for mesh in scene.meshes)
    verts, faces, corners, colors, uvs, texels, textures, face_texture = ([] for _ in range(8))
    uv_corners, alphas, cut_outs, face_cut_out, cutoffs = ([] for _ in range(5))
    n_verts = n_colors = n_uvs = n_texels = n_alphas = 0
    alone = len(scene.meshes) == 1
    # Colours of vertices are indexed by the faces. That it is one tensor tells the kernel that neighbours agree at their edge.
    by_vertex = all(mesh.texture is None and mesh.colors is not None for mesh in scene.meshes)
    for mesh in scene.meshes:
        V, F = mesh.verts.shape[0], mesh.faces.shape[0]
        mesh_faces = _rows(mesh.faces, V, n_verts, alone)
        verts.append(mesh.verts.cpu().double())
        faces.append(mesh_faces)
        uv_rows = torch.full((F, 3), -1, dtype=torch.int32, device=cpu) if own_uvs else None
        if has_uvs(mesh):
            assert mesh.uvs is not None and mesh.uv_faces is not None
            uvs.append(mesh.uvs.cpu().double())
            uv_rows = _rows(mesh.uv_faces, mesh.uvs.shape[0], n_uvs, alone)
            n_uvs += mesh.uvs.shape[0]
        if own_uvs:
            uv_corners.append(uv_rows)
        if any_cut_out:
            face_cut_out.append(torch.full((F,), len(cut_outs) if is_cut(mesh) else -1, dtype=torch.int32, device=cpu))
        if is_cut(mesh):
            assert mesh.alpha is not None
            h, w = mesh.alpha.shape
            cut_outs.append([n_alphas, h, w, *_sampler(mesh)])
            cutoffs.append(0.5 if mesh.blends else mesh.alpha_cutoff)
            alphas.append(mesh.alpha.cpu().to(dtype).reshape(h * w, 1))
            n_alphas += h * w
        if mesh.texture is not None:
            assert uv_rows is not None
            h, w = mesh.texture.shape[:2]
            face_texture.append(torch.full((F,), len(textures), dtype=torch.int32, device=cpu))
            textures.append([n_texels, h, w, *_sampler(mesh)])
            texels.append(mesh.texture.cpu().to(dtype).reshape(h * w, C))
            corners.append(uv_rows)
            n_texels += h * w
        else:
            if mesh.colors is not None:
                rows, index = mesh.colors, mesh_faces if by_vertex or not n_verts else mesh_faces - n_verts
            elif mesh.corner_colors is not None:
                rows = mesh.corner_colors.reshape(3 * F, C)
                index = torch.arange(3 * F, dtype=torch.int32, device=cpu).reshape(F, 3)
            elif mesh.face_colors is not None:
                rows = mesh.face_colors
                index = torch.arange(F, dtype=torch.int32, device=cpu)[:, None].expand(F, 3)
            else:
                rows = torch.full((1, C), PLAIN, dtype=dtype, device=cpu)
                index = torch.zeros((F, 3), dtype=torch.int32, device=cpu)
            colors.append(rows.cpu().to(dtype))
            if not by_vertex:
                corners.append(index + n_colors if n_colors else index)
            n_colors += rows.shape[0]
            if any_texture:
                face_texture.append(torch.full((F,), -1, dtype=torch.int32, device=cpu))
        n_verts += V

    def join(parts: list[Tensor], otherwise: Tensor) -> Tensor:
        return (parts[0] if len(parts) == 1 else torch.cat(parts) if parts else otherwise).contiguous()

    if scene.background is None:
        background = torch.zeros(C, dtype=dtype, device=cpu)
    else:
        background = scene.background.cpu().to(dtype).contiguous()
    all_faces = join(faces, empty(3, torch.int32))
    return Flat(
        join(verts, empty(3, torch.float64)),
        all_faces,
        all_faces if by_vertex else join(corners, empty(3, torch.int32)),
        join(colors, empty(C, dtype)),
        join(uvs, empty(2, torch.float64)),
        join(texels, empty(C, dtype)),
        torch.tensor(textures, dtype=torch.int64, device=cpu).reshape(-1, 6),
        join(face_texture, torch.empty(0, dtype=torch.int32, device=cpu)),
        join(uv_corners, empty(3, torch.int32)),
        join(alphas, empty(1, dtype)),
        torch.tensor(cut_outs, dtype=torch.int64, device=cpu).reshape(-1, 6),
        join(face_cut_out, torch.empty(0, dtype=torch.int32, device=cpu)),
        background,
        cutoffs,
        _vertex_spacing(scene),
    )
