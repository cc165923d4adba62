"""Appearance of surfaces at points: colours, parameters of materials, texture coordinates, normals."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ..library import core
from .material import Parameter, Texture
from .mesh import DEFAULT_RADIANCE, Mesh
from .mikktspace import tangents
from .rows import columns, rows_of, scaled, unit
from .textures import look_up

# (texture, uv, wraps, filter, uv at the corners of faces) to (N, C)
LookUp = Callable[[Tensor, Tensor, tuple[str, str], str, Tensor], Tensor]


class TangentFrame(NamedTuple):
    """Unit vectors in which normal maps are written, with the normal as the third."""

    tangent: Tensor  # (N, 3), along which u grows
    bitangent: Tensor  # (N, 3), along which v grows
    there: Tensor  # (N, 1) bool: false where texture coordinates give no direction


class OnMesh(NamedTuple):
    """Points of one mesh."""

    mesh: Mesh
    face: Tensor  # (N,) int64, as the mesh counts them
    b: Tensor  # (N, 3), barycentrics
    look_up: LookUp | None = None  # of textures, by footprints of pixels; None: by texture coordinates alone
    tangents: Callable[[], Tensor] | None = None  # (F, 3, 4) at corners, of a normal map where normals are interpolated

    def interpolated(self, rows: Tensor, index: Tensor) -> Tensor:
        """Interpolate rows (R, K) by the corners of faces, index (F, 3), to (N, K)."""
        corners = rows.to(self.b)[index[self.face].long()]
        return (self.b[:, :, None] * corners).sum(1)

    def value(self, parameter: Parameter | float) -> Tensor:
        """Return a parameter (N, K), or (1, K) where it is the same everywhere."""
        if isinstance(parameter, Texture):
            return self._looked_up(parameter)
        value = torch.as_tensor(parameter).to(self.b)
        return self.interpolated(value, self.mesh.faces) if value.dim() == 2 else value.reshape(1, -1)

    def _looked_up(self, texture: Texture) -> Tensor:
        uvs, uv_faces = coordinates(self.mesh, texture)
        uv = self.interpolated(uvs, uv_faces)
        image = texture.image.to(self.b.device)
        if self.look_up is None:
            found = look_up(image, uv, texture.wraps, "nearest" if texture.filter == "nearest" else "linear")
        else:
            corners = uvs.to(self.b)[uv_faces[self.face].long()]
            found = self.look_up(image, uv, texture.wraps, texture.filter, corners)
        found = found.to(self.b)
        return found if texture.factor is None else found * torch.as_tensor(texture.factor).to(self.b)

    def color(self) -> Tensor | None:
        """Return the colour (N, C) of the mesh itself, whatever kind it has."""
        mesh = self.mesh
        if mesh.texture is not None:
            return self._looked_up(Texture(mesh.texture, wrap=mesh.wrap, filter=mesh.filter))
        if mesh.colors is not None:
            return self.interpolated(mesh.colors, mesh.faces)
        if mesh.face_colors is not None:
            return mesh.face_colors.to(self.b)[self.face]
        if mesh.corner_colors is not None:
            return (self.b[:, :, None] * mesh.corner_colors.to(self.b)[self.face]).sum(1)
        return None

    def base_color(self) -> Tensor:
        """Return colours times the material's factor, (N, C), (N, 1) or (1, K); radiance where there is no material."""
        own = self.color()
        of_material = None if self.mesh.material is None else self.mesh.material.base_color
        if of_material is None:
            return self.b.new_full((1, 1), DEFAULT_RADIANCE) if own is None else own
        factor = self.value(of_material)
        return factor if own is None else own * factor

    def shows(self) -> Tensor:
        """Return (N,) bool whether light meets the mesh: not where alpha masks it, nor where it blends below ½."""
        mesh = self.mesh
        if mesh.alpha is None:
            return torch.ones(len(self.face), dtype=torch.bool, device=self.face.device)
        uvs, uv_faces = coordinates(mesh, None)
        alpha = look_up(
            mesh.alpha.detach().to(self.b.device)[..., None],
            self.interpolated(uvs, uv_faces).detach(),
            mesh.wraps,
            mesh.filter,
        )
        return alpha[:, 0] >= (0.5 if mesh.blends else mesh.alpha_cutoff)

    def corners(self) -> Tensor:
        """Return the positions (N, 3, 3) of the corners of the faces."""
        return self.mesh.verts.to(self.b)[self.mesh.faces[self.face].long()]

    def shading_normal(self, g: Tensor) -> Tensor:
        """Return unit normals (N, 3) on the side of the faces' own normals g (N, 3). They are interpolated if there are any,
        and bent by the material's normal map where that has a direction."""
        n = self.smooth_normal(g)
        material = self.mesh.material
        if material is None or material.normal_map is None:
            return n
        bent = 2 * self.value(material.normal_map) - 1
        scale = torch.as_tensor(material.normal_scale).to(bent)
        frame = self.tangent_frame(n, material.normal_map)
        m = scale * (bent[:, 0:1] * frame.tangent + bent[:, 1:2] * frame.bitangent) + bent[:, 2:3] * n
        told = (m.detach() * m.detach()).sum(1, keepdim=True) > core.FAINTEST_NORMAL**2
        m = torch.where(frame.there & told, m, n)
        return normalize(m, dim=-1)

    def smooth_normal(self, g: Tensor) -> Tensor:
        """Return unit normals (N, 3) on the side of the faces' own normals g (N, 3): interpolated if there are any."""
        mesh = self.mesh
        if mesh.normals is None:
            return g
        index = mesh.faces if mesh.normal_faces is None else mesh.normal_faces
        n = self.interpolated(mesh.normals, index)
        n = torch.where((n.detach() * n.detach()).sum(1, keepdim=True) > 0, n, g)
        n = normalize(n, dim=-1)
        return torch.where((n.detach() * g.detach()).sum(1, keepdim=True) < 0, -n, n)

    def tangent_frame(self, n: Tensor, texture: Texture | None) -> TangentFrame:
        """Return the frame of the texture's coordinates, or the mesh's, at right angles to unit normals n (N, 3)."""
        tangent, hand = self._tangent(texture)
        t = tangent - n * (n * tangent).sum(1, keepdim=True)
        there = (t.detach() * t.detach()).sum(1, keepdim=True) > 0
        t = unit(torch.where(there, t, 1.0))
        return TangentFrame(t, hand * torch.linalg.cross(n, t), there)

    def _tangent(self, texture: Texture | None) -> tuple[Tensor, Tensor]:
        """Return the direction (N, 3) in which u grows, of any length, and (N, 1) 1, or −1 where the image is mirrored. They
        are the face's, or interpolated as normals are."""
        if self.mesh.normals is not None:
            assert self.tangents is not None
            corners = rows_of(self.tangents(), self.face).to(self.b)
            found = (self.b[:, :, None] * corners[:, :, :3]).sum(1)
            return found, corners[:, 0, 3:]
        uvs, uv_faces = coordinates(self.mesh, texture)
        return tangents(self.corners(), uvs.to(self.b)[uv_faces[self.face].long()])


def coordinates(mesh: Mesh, texture: Texture | None) -> tuple[Tensor, Tensor]:
    """Return texture coordinates and their indices: those of the texture, or else of the mesh."""
    if texture is not None and texture.uvs is not None and texture.uv_faces is not None:
        return texture.uvs, texture.uv_faces
    assert mesh.uvs is not None and mesh.uv_faces is not None
    return mesh.uvs, mesh.uv_faces


def jumps(mesh: Mesh, of_corners: Tensor | None) -> Tensor:
    """Return values (F, 3, K) at the corners of faces that may jump at edges, apart from normals; each of a size near 1.
    `of_corners` are the tangents (F, 3, 4), if there are some."""
    found: list[Tensor] = []
    if mesh.corner_colors is not None:
        found.append(mesh.corner_colors)
    if mesh.face_colors is not None:
        found.append(mesh.face_colors[:, None].expand(-1, 3, -1))
    textures = [] if mesh.material is None else list(mesh.material.textures.values())
    for texture in [*([None] if mesh.texture is not None else []), *textures]:
        uvs, uv_faces = coordinates(mesh, texture)
        found.append(rows_of(uvs, uv_faces.long()))
    material = mesh.material
    if of_corners is not None:
        found.append(torch.cat([of_corners[..., 3:] * of_corners[..., :3], of_corners[..., 3:]], -1))
    elif material is not None and material.normal_map is not None:
        # Tangents of faces jump at every edge of a curved mesh.
        uvs, uv_faces = coordinates(mesh, material.normal_map)
        tangent, hand = tangents(mesh.verts[mesh.faces.long()], uvs.to(mesh.verts)[uv_faces.long()])
        found.append((hand * unit(tangent.double()))[:, None].expand(-1, 3, -1))
    return columns([scaled(part.detach().to(mesh.verts)) for part in found], len(mesh.faces), mesh.verts)
