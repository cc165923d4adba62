"""The surfaces of a scene, and views of them by a camera or along rays: hits are computed from both."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ..kernel.derivatives import transformed
from ..kernel.flat import Flat
from ..scene.appearance import coordinates
from ..scene.mikktspace import Fans
from ..scene.rows import areas, columns, dot, rows_of, scaled, unit
from ..scene.scene import Scene
from .moving import barycentrics, barycentrics_by
from .pyramid import Pyramid
from .records import geometry, values_of


class Surfaces:
    """Meshes laid end to end.

    It also notes what a shader asks for: properties that may differ on the two sides of an edge, and shadows.
    """

    def __init__(self, scene: Scene, geometry: Flat | None = None) -> None:
        """`geometry`: of geometry(), if it was made before."""
        meshes = scene.meshes
        first = [sum(len(m.verts) for m in meshes[:k]) for k in range(len(meshes))]
        dtype = max((m.verts.dtype for m in meshes), key=lambda t: torch.finfo(t).bits)
        self.verts = torch.cat([m.verts.to(dtype) for m in meshes])
        self.faces = torch.cat([m.faces.long() + k for m, k in zip(meshes, first, strict=True)])
        counts = torch.tensor([len(m.faces) for m in meshes])
        self.mesh_of_face = torch.repeat_interleave(torch.arange(len(meshes)), counts).to(self.verts.device)
        self.scene = scene
        self._geometry = geometry
        self.jumping: dict[Any, Callable[[], Tensor]] = {}  # values (F, 3, K) at corners, of properties that may jump
        self.shadowing: set[int] = set()  # lights, by their place in scene.casting, whose shadows a shader asks for
        self.pyramids: dict[int, tuple[Tensor, Pyramid]] = {}  # of textures, by their ids
        self._tangents: dict[int, Tensor] = {}  # of meshes
        self._moving: Surfaces | None = None  # the surfaces of which detach() made these
        self.layout: Any = None  # of light/layout.py, kept where nothing has derivatives
        self.has_derivatives = True

    def detach(self) -> Surfaces:
        """Return the surfaces without derivatives. Both share their notes."""
        other = Surfaces.__new__(Surfaces)
        other.__dict__.update(self.__dict__)
        for name in ("geometry", "casters", "corner_uvs", "vertex_normals"):  # made of tensors that have derivatives
            other.__dict__.pop(name, None)
        if self._geometry is not None:
            parts = self._geometry._asdict().items()
            other._geometry = self._geometry._replace(**{k: v.detach() for k, v in parts if isinstance(v, Tensor)})
        other.verts, other.scene, other.pyramids, other._tangents = self.verts.detach(), self.scene.detach(), {}, {}
        other.layout, other.has_derivatives, other._moving = None, False, self
        return other

    @cached_property
    def first_faces(self) -> list[int]:
        """Return the first face of each mesh."""
        return [sum(len(m.faces) for m in self.scene.meshes[:k]) for k in range(len(self.scene.meshes))]

    @cached_property
    def geometry(self) -> Flat:
        """For the kernel, without colours."""
        return geometry(self.scene) if self._geometry is None else self._geometry

    @cached_property
    def casters(self) -> Flat:
        """Return the surfaces that shadow rays meet: alpha-blended faces count where their alpha is at least ½."""
        return geometry(self.scene, blended=False) if self.scene.blends else self.geometry

    @cached_property
    def ball(self) -> tuple[Tensor, float]:
        """Return a centre (3,) and a radius of a ball around all vertices, float64."""
        if self._moving is not None:
            return self._moving.ball
        # Contiguous columns make this four times as fast.
        low, high = (bound.double() for bound in torch.aminmax(self.verts.detach().T.contiguous(), dim=1))
        return (low + high) / 2, float((high - low).norm()) / 2

    @cached_property
    def corner_uvs(self) -> Tensor:
        """Return (F, 3, 2) texture coordinates of corners."""
        parts = []
        for i, mesh in enumerate(self.scene.meshes):
            if mesh.uvs is None or mesh.uv_faces is None:
                raise ValueError(
                    f"hits.uv: meshes[{i}] has no texture coordinates; give it uvs and uv_faces, or choose "
                    "another mesh by hits.mesh"
                )
            parts.append(rows_of(mesh.uvs.to(self.verts.dtype), mesh.uv_faces.long()))
        return torch.cat(parts)

    @cached_property
    def vertex_normals(self) -> Tensor:
        """Return (V, 3) unit normals: means of the normals of the faces at each index, weighted by area."""
        corner = rows_of(self.verts, self.faces)
        area, index = areas(corner), self.faces.reshape(-1)
        total = torch.zeros_like(self.verts, dtype=area.dtype).index_add(0, index, area.repeat_interleave(3, 0))
        return unit(total).to(self.verts.dtype)

    def tangents(self, index: int) -> Tensor | None:
        """Return (F, 3, 4) of a mesh whose normals are interpolated and bent by a map: see Fans."""
        mesh = self.scene.meshes[index]
        if mesh.normals is None or mesh.material is None or mesh.material.normal_map is None:
            return None
        if index not in self._tangents and self._moving is not None:
            tangents = self._moving.tangents(index)
            assert tangents is not None
            self._tangents[index] = tangents.detach()
        elif index not in self._tangents:
            uvs, uv_faces = coordinates(mesh, mesh.material.normal_map)
            normal_faces = mesh.faces if mesh.normal_faces is None else mesh.normal_faces
            given = (mesh.verts, mesh.faces), (mesh.normals, normal_faces), (uvs, uv_faces)
            values = values_of(*(tensor for pair in given for tensor in pair))
            fans = Fans.from_corners(*zip(values[::2], values[1::2], strict=True))
            self._tangents[index] = fans.tangents(*(rows_of(x.to(mesh.verts.device), at.long()) for x, at in given))
        return self._tangents[index]

    def corners(self, face: Tensor) -> Tensor:
        """Return (N, 3, 3) world coordinates of the corners of faces (N,)."""
        return rows_of(self.verts, rows_of(self.faces, face))

    def face_normals(self, face: Tensor) -> Tensor:
        return unit(areas(self.corners(face))).to(self.verts.dtype)

    def crease_attributes(self) -> Tensor:
        """Return (F, 3, K): all properties that may jump and were asked for, each divided by its largest value."""
        parts = [corners().detach().to(self.verts.dtype) for corners in self.jumping.values()]
        attributes = columns([scaled(p) for p in parts if p.shape[-1]], len(self.faces), self.verts)
        return _BatchedAttributes.apply(attributes) if transformed() else attributes


class _BatchedAttributes(torch.autograd.Function):
    """Attributes (F, 3, K). Under torch.vmap, those of all elements side by side: these share the samples of one image."""

    @staticmethod
    def forward(attributes: Tensor) -> Tensor:
        return attributes.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.mark_non_differentiable(output)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> None:
        return None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> None:
        return None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int, ...], *args: Any) -> tuple[Tensor, None]:
        (attributes,), (batch,) = args, in_dims
        return _BatchedAttributes.apply(attributes.movedim(batch, -1).flatten(2)), None


def every_face(count: int) -> Tensor:
    """Return (F, 3, 1): a number for each face, so that neighbours differ: the fractional parts of multiples of the golden
    ratio."""
    return (torch.arange(count).double() * 0.6180339887498949 % 1 + 0.5)[:, None, None].expand(-1, 3, 1)


def intersect_planes(corners: Tensor, origin: Tensor, direction: Tensor) -> Tensor:
    """Return (N, 3) barycentrics where rays meet the planes of faces with corners (N, 3, 3) (Möller and Trumbore 1997)."""
    e1, e2, s = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], origin - corners[:, 0]
    p, q = torch.linalg.cross(direction, e2), torch.linalg.cross(s, e1)
    scale = 1 / dot(e1, p)
    u, v = dot(s, p) * scale, dot(direction, q) * scale
    return torch.stack([1 - u - v, u, v], 1)


class CameraView:
    """A camera's view: points in its coordinates, and where its rays meet faces."""

    def __init__(self, world_to_camera: Tensor, perspective: bool) -> None:
        self.world_to_camera, self.perspective = world_to_camera, perspective  # (4, 4) float64

    def detach(self) -> CameraView:
        return CameraView(self.world_to_camera.detach(), self.perspective)

    def in_camera(self, points: Tensor) -> Tensor:
        """Return world points (..., 3) in camera coordinates, float64."""
        return points.double() @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]

    def turned(self, directions: Tensor) -> Tensor:
        """Return world directions (..., 3) in camera coordinates, float64."""
        return directions.double() @ self.world_to_camera[:3, :3].T

    def barycentrics(self, surfaces: Surfaces, face: Tensor, along: Tensor) -> Tensor:
        """Return (N, 3) where rays meet the planes of faces. `along` (N, 3): the directions of rays from the eye in camera
        coordinates, or, in an orthographic view, points that rays along the axis go through."""
        flat = surfaces.geometry
        return barycentrics(flat.verts, flat.faces, face, self.world_to_camera, along, self.perspective)

    def barycentrics_by(self, surfaces: Surfaces, face: Tensor, along: Tensor, by: Tensor) -> tuple[Tensor, Tensor]:
        """Return barycentrics() and their derivatives (N, 3, K) where `along` has the derivatives `by` (N, 3, K)."""
        flat = surfaces.geometry
        return barycentrics_by(flat.verts, flat.faces, face, self.world_to_camera, along, by, self.perspective)

    def depth(self, points: Tensor) -> Tensor:
        """Return (N,) along the axis."""
        return self.in_camera(points)[:, 2]

    @property
    def eye(self) -> Tensor:
        """Return (3,) world coordinates; in an orthographic view, the unit direction towards it. float64."""
        back = torch.linalg.inv(self.world_to_camera[:3, :3])
        return -back @ self.world_to_camera[:3, 3] if self.perspective else normalize(-back[:, 2], dim=0)

    def to_viewer(self, points: Tensor) -> Tensor:
        """Return (N, 3) unit directions, float64."""
        return unit(self.eye - points.double()) if self.perspective else self.eye.expand(len(points), 3)


class Rays(NamedTuple):
    """The user's rays, one for each point."""

    ray: Tensor  # (N,) int64, that of each point
    origin: Tensor  # (N, 3) world coordinates, float64
    direction: Tensor  # (N, 3)

    def select(self, index: Tensor | slice) -> Rays:
        return Rays(*(part[index] for part in self))

    def barycentrics(self, corners: Tensor, b: Tensor) -> Tensor:
        """Return the barycentrics b (N, 3) of hits, as functions of the corners (N, 3, 3) and the rays."""
        moved = intersect_planes(corners, self.origin, self.direction)
        return b + (moved - moved.detach())

    def depth(self, points: Tensor) -> Tensor:
        """Return (N,) in lengths of the direction."""
        d = self.direction
        return dot(points.double() - self.origin, d) / dot(d, d)

    def to_viewer(self, points: Tensor) -> Tensor:
        return -unit(self.direction)
