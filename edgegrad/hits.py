"""Hits: what shaders written in PyTorch are given, points of surfaces and what is known there."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ._check import as_tensor, check_float, check_shape
from .scene import Scene


class Surfaces:
    """The surfaces of a scene before one camera, meshes laid end to end, as functions of the scene's tensors.

    It also notes which properties that may jump at an edge a shader asks for: there the shader may jump too.
    """

    def __init__(self, scene: Scene, world_to_camera: Tensor, perspective: bool) -> None:
        meshes = scene.meshes
        first = [sum(len(m.verts) for m in meshes[:k]) for k in range(len(meshes))]
        dtype = max((m.verts.dtype for m in meshes), key=lambda t: torch.finfo(t).bits)
        self.verts = torch.cat([m.verts.to(dtype) for m in meshes])
        self.faces = torch.cat([m.faces.long() + k for m, k in zip(meshes, first, strict=True)])
        counts = torch.tensor([len(m.faces) for m in meshes])
        self.mesh_of_face = torch.repeat_interleave(torch.arange(len(meshes)), counts).to(self.verts.device)
        self.world_to_camera = world_to_camera.to(self.verts.device, torch.float64)
        self.perspective = perspective
        self._scene = scene
        self.jumping: dict[Any, Callable[[], Tensor]] = {}  # (F, 3, K) at corners, of what may jump

    def detach(self) -> Surfaces:
        """The same without derivatives; what it notes is noted for both."""
        other = Surfaces.__new__(Surfaces)
        other.__dict__.update(self.__dict__)
        for name in ("corner_uvs", "vertex_normals"):  # made of tensors that have derivatives
            other.__dict__.pop(name, None)
        other.verts, other.world_to_camera = self.verts.detach(), self.world_to_camera.detach()
        other._scene = self._scene.detach()
        return other

    @cached_property
    def corner_uvs(self) -> Tensor:
        """(F, 3, 2) texture coordinates of corners."""
        parts = []
        for i, mesh in enumerate(self._scene.meshes):
            if mesh.uvs is None or mesh.uv_faces is None:
                raise ValueError(
                    f"hits.uv: meshes[{i}] has no texture coordinates; give it a texture with uvs and uv_faces, or choose "
                    "another mesh by hits.mesh"
                )
            parts.append(mesh.uvs.to(self.verts.dtype)[mesh.uv_faces.long()])
        return torch.cat(parts)

    @cached_property
    def vertex_normals(self) -> Tensor:
        """(V, 3) unit normals: the mean of the incident faces' by area, of vertices as they are indexed."""
        corner = self.verts[self.faces]
        area = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        index = self.faces.reshape(-1)
        return normalize(torch.zeros_like(self.verts).index_add(0, index, area.repeat_interleave(3, 0)), dim=-1)

    def face_normals(self, face: Tensor) -> Tensor:
        corner = self.verts[self.faces[face]]
        return normalize(torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), dim=-1)

    def in_camera(self, points: Tensor) -> Tensor:
        """World points (..., 3) in camera coordinates, float64."""
        return points.double() @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]

    def barycentrics(self, face: Tensor, along: Tensor) -> Tensor:
        """(N, 3) where rays meet the planes of faces: differentiable functions of vertices and camera (Möller and Trumbore
        1997). `along` (N, 3): the directions of rays from the eye in camera coordinates, or, in an orthographic view, points
        that rays along the axis go through."""
        q = self.in_camera(self.verts[self.faces[face]])
        if self.perspective:
            origin = -q[:, 0]
        else:
            origin, along = along - q[:, 0], along.new_tensor([0.0, 0.0, 1.0]).expand_as(along)
        e1, e2 = q[:, 1] - q[:, 0], q[:, 2] - q[:, 0]
        p, s = torch.linalg.cross(along, e2), torch.linalg.cross(origin, e1)
        scale = 1 / (e1 * p).sum(-1)
        u, v = (origin * p).sum(-1) * scale, (along * s).sum(-1) * scale
        return torch.stack([1 - u - v, u, v], 1)

    def crease_attributes(self) -> Tensor:
        """(F, 3, K) of all that was asked for and may jump, each scaled to its largest number."""
        parts = [corners().detach().to(self.verts.dtype) for corners in self.jumping.values()]
        parts = [p / p.abs().max().clamp(min=1e-30) for p in parts]
        return torch.cat(parts, -1) if parts else self.verts.new_zeros((len(self.faces), 3, 0))


class Hits:
    """N points of surfaces as a shader sees them. Each property is made when it is asked for.

    Where the renderer differentiates a shader, they are differentiable functions of the vertices and the camera at fixed
    places in the image; elsewhere they have no derivatives. A shader must be a function of each point by itself.
    """

    def __init__(self, surfaces: Surfaces, face: Tensor, barycentrics: Tensor, pixel: Tensor) -> None:
        self._surfaces = surfaces
        self._face, self._barycentrics = face, barycentrics.to(surfaces.verts.dtype)
        self.pixel = pixel.to(surfaces.verts.dtype)  # (N, 2) where in the image, px: x right, y down

    def __len__(self) -> int:
        return len(self._face)

    def select(self, index: Tensor) -> Hits:
        """Some of the points, or all in another order."""
        return Hits(self._surfaces, self._face[index], self._barycentrics[index], self.pixel[index])

    def _note(self, key: Any, corners: Callable[[], Tensor]) -> None:
        self._surfaces.jumping.setdefault(key, corners)

    def _note_faces(self) -> None:
        # Numbers of their own, of which neighbours differ: multiples of the golden ratio, without their whole part.
        count = len(self._surfaces.faces)
        at = self._surfaces.verts.device
        self._note(
            "face",
            lambda: (torch.arange(count, device=at).double() * 0.6180339887498949 % 1 + 0.5)[:, None, None].expand(
                -1, 3, 1
            ),
        )

    @property
    def face(self) -> Tensor:
        """(N,) int64: the face, as the scene counts them, mesh after mesh."""
        self._note_faces()
        return self._face

    @property
    def mesh(self) -> Tensor:
        """(N,) int64: the mesh of the scene."""
        s = self._surfaces
        self._note("mesh", lambda: s.mesh_of_face[:, None, None].expand(-1, 3, 1))
        return s.mesh_of_face[self._face]

    @property
    def barycentrics(self) -> Tensor:
        """(N, 3): the weights of the corners of the face."""
        self._note_faces()
        return self._barycentrics

    @cached_property
    def position(self) -> Tensor:
        """(N, 3) in world coordinates."""
        s = self._surfaces
        return (self._barycentrics[:, :, None] * s.verts[s.faces[self._face]]).sum(1)

    @cached_property
    def depth(self) -> Tensor:
        """(N,) along the camera's axis."""
        return self._surfaces.in_camera(self.position)[:, 2].to(self.position.dtype)

    @cached_property
    def normal(self) -> Tensor:
        """(N, 3) unit normal of the face, to the side from which its vertices run counter-clockwise."""
        s = self._surfaces
        every = torch.arange(len(s.faces), device=s.verts.device)
        self._note("normal", lambda: s.face_normals(every)[:, None].expand(-1, 3, -1))
        return s.face_normals(self._face)

    @cached_property
    def shading_normal(self) -> Tensor:
        """(N, 3) unit normal, interpolated between those of the vertices: means of their faces' by area."""
        s = self._surfaces
        self._note("shading_normal", lambda: s.vertex_normals[s.faces])
        normals = s.vertex_normals[s.faces[self._face]]
        return normalize((self._barycentrics[:, :, None] * normals).sum(1), dim=-1)

    @cached_property
    def uv(self) -> Tensor:
        """(N, 2) texture coordinates, v running up."""
        s = self._surfaces
        self._note("uv", lambda: s.corner_uvs)
        return (self._barycentrics[:, :, None] * s.corner_uvs[self._face]).sum(1)

    @cached_property
    def view(self) -> Tensor:
        """(N, 3) unit direction to the eye."""
        s = self._surfaces
        back = torch.linalg.inv(s.world_to_camera[:3, :3])
        if s.perspective:
            eye = -back @ s.world_to_camera[:3, 3]
            return normalize(eye - self.position.double(), dim=-1).to(self.position.dtype)
        return normalize(-back[:, 2], dim=0).to(self._barycentrics).expand(len(self), 3)

    def interpolate(self, attribute: Tensor, per: str | None = None) -> Tensor:
        """(N, K): an attribute of the scene's vertices (V, K), faces (F, K) or corners of faces (F, 3, K).

        per   "vertex", "face" or "corner", where the shape does not say

        Raises TypeError or ValueError that names the argument.
        """
        s = self._surfaces
        V, F = len(s.verts), len(s.faces)
        attribute = as_tensor("attribute", attribute, floating=True)
        check_float("attribute", attribute)
        check_shape("attribute", attribute, (V, "K"), (F, "K"), (F, 3, "K"))
        if per is None:
            per = "corner" if attribute.dim() == 3 else "vertex" if attribute.shape[0] == V else "face"
            if V == F and attribute.dim() == 2:
                raise ValueError(f'per: expected "vertex" or "face", for the scene has {V} of each; say which')
        rows = {"vertex": (V, 2), "face": (F, 2), "corner": (F, 3)}
        if per not in rows:
            raise ValueError(f'per: expected "vertex", "face" or "corner", got {per!r}')
        if (attribute.shape[0], attribute.dim()) != rows[per]:
            raise ValueError(f"attribute: expected one row a {per}, got shape {tuple(attribute.shape)}")

        def corners() -> Tensor:
            return (
                attribute[s.faces]
                if per == "vertex"
                else attribute
                if per == "corner"
                else attribute[:, None].expand(-1, 3, -1)
            )

        self._note(("attribute", id(attribute)), corners)
        if per == "face":
            return attribute[self._face]
        values = attribute[s.faces[self._face]] if per == "vertex" else attribute[self._face]
        return (self._barycentrics.to(values.dtype)[:, :, None] * values).sum(1)

    def sample(self, texture: Tensor, uv: Tensor | None = None, wrap: str = "repeat") -> Tensor:
        """(N, K): a texture (h, w, K), row 0 on top, at texture coordinates uv (N, 2), v running up; those of the surface when
        None. Bilinear between the centres of texels; beyond the rim `wrap` says "repeat" or "clamp".

        Raises TypeError or ValueError that names the argument.
        """
        texture = as_tensor("texture", texture, floating=True)
        check_float("texture", texture)
        check_shape("texture", texture, ("h", "w", "K"))
        if wrap not in ("repeat", "clamp"):
            raise ValueError(f'wrap: expected "repeat" or "clamp", got {wrap!r}')
        uv = self.uv if uv is None else as_tensor("uv", uv, floating=True)
        check_shape("uv", uv, (len(self), 2))
        h, w = texture.shape[:2]
        x, y = uv[:, 0].double() * w - 0.5, (1 - uv[:, 1].double()) * h - 0.5
        x0, y0 = x.detach().floor(), y.detach().floor()
        fx, fy = (x - x0).to(texture.dtype)[:, None], (y - y0).to(texture.dtype)[:, None]

        def texels(dy: int, dx: int) -> Tensor:
            i, j = (y0 + dy).long(), (x0 + dx).long()
            i, j = (i % h, j % w) if wrap == "repeat" else (i.clamp(0, h - 1), j.clamp(0, w - 1))
            return texture.reshape(h * w, -1)[i * w + j]

        top = (1 - fx) * texels(0, 0) + fx * texels(0, 1)
        bottom = (1 - fx) * texels(1, 0) + fx * texels(1, 1)
        return (1 - fy) * top + fy * bottom
