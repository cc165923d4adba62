"""The flat arrays of a scene that the kernel reads."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..check import all_below, values_visible
from ..scene.material import WRAPS
from ..scene.mesh import DEFAULT_RADIANCE, FILTERS, Mesh
from ..scene.scene import Scene


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
    alpha_masks: Tensor  # (M, 6) int64: first of its alphas, height, width, wrap of u and v, filter
    face_alpha_mask: Tensor  # (F,) int32: row of alpha_masks, −1 for none; (0,) when the scene has none
    background: Tensor  # (C,) or (H, W, C)
    cutoffs: list[float]  # the least alpha that is shown, of each alpha mask
    # Relative spacing of the numbers in which vertices were given: pairs of a vertex and the spacing from there on.
    spacing: list[float]

    @property
    def has_discontinuities(self) -> bool:
        """Return whether something jumps within a face: it is cut out, or its texels are."""
        if len(self.alpha_masks) > 0 or len(self.textures) == 0:
            return len(self.alpha_masks) > 0
        return bool((self.textures[:, 5] == FILTERS.index("nearest")).any())


def _rows(index: Tensor, count: int, offset: int, alone: bool) -> Tensor:
    """Return indices into `count` rows as indices into all rows, int32. What is out of range stays so, for the kernel to
    refuse: it must not wrap around, nor reach into the rows of another mesh, so unless the mesh is alone it becomes −1."""
    index = index.cpu()
    if alone:
        # Comparing the extremes costs less than a copy of a million indices.
        if index.dtype == torch.int64 and (not values_visible(index) or not all_below(index, 2**31)):
            index = index.clamp(-(2**31), 2**31 - 1)
    else:
        index = index.long()  # in fewer bits the sum could wrap around too
        index = torch.where((index >= 0) & (index < count), index + offset, -1)
    return index.to(torch.int32)


def _vertex_spacing(scene: Scene) -> list[float]:
    """Return the relative spacing of the numbers in which the vertices were given, by which copies of a point may differ: pairs
    of the number of a vertex in the flat arrays and the spacing from there on."""
    pairs: list[float] = []
    n_verts = 0
    for mesh in scene.meshes:
        spacing = torch.finfo(mesh.verts.dtype).eps
        if not pairs or pairs[-1] != spacing:
            pairs += [float(n_verts), spacing]
        n_verts += mesh.verts.shape[0]
    return pairs


def image_dtype(scene: Scene) -> torch.dtype:
    """Return the dtype of the colours, or of the vertices if there are none: float32 or float64."""
    floats = [t for m in scene.meshes for t in (m.colors, m.face_colors, m.corner_colors, m.texture) if t is not None]
    floats += [scene.background] if scene.background is not None else []
    floats = floats or [scene.meshes[0].verts]
    return torch.float64 if any(t.dtype == torch.float64 for t in floats) else torch.float32


def _sampler(mesh: Mesh) -> list[int]:
    """Return how the images of a mesh are looked up: the wrap of u and of v, and the filter, as the kernel counts them. It
    knows no mipmaps: their levels are of the texture, which it is not given where there are some."""
    u, v = mesh.wraps
    filter = "linear" if mesh.filter == "mipmap" else mesh.filter
    return [WRAPS.index(u), WRAPS.index(v), FILTERS.index(filter)]


def flatten(scene: Scene, all_uvs: bool = False, blended: bool = True) -> Flat:
    """Return the arrays of a scene; every step is a differentiable torch operation, so gradients find their way back.

    all_uvs   also texture coordinates that neither a texture nor an alpha mask needs
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

    any_alpha_mask = any(map(is_cut, scene.meshes))

    def has_uvs(mesh: Mesh) -> bool:
        return mesh.texture is not None or is_cut(mesh) or (all_uvs and mesh.uvs is not None)

    own_uvs = any_alpha_mask or any(has_uvs(mesh) and mesh.texture is None for mesh in scene.meshes)
    verts, faces, corners, colors, uvs, texels, textures, face_texture = ([] for _ in range(8))
    uv_corners, alphas, alpha_masks, face_alpha_mask, cutoffs = ([] for _ in range(5))
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
        if any_alpha_mask:
            face_alpha_mask.append(
                torch.full((F,), len(alpha_masks) if is_cut(mesh) else -1, dtype=torch.int32, device=cpu)
            )
        if is_cut(mesh):
            assert mesh.alpha is not None
            h, w = mesh.alpha.shape
            alpha_masks.append([n_alphas, h, w, *_sampler(mesh)])
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
                rows = torch.full((1, C), DEFAULT_RADIANCE, dtype=dtype, device=cpu)
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
        torch.tensor(alpha_masks, dtype=torch.int64, device=cpu).reshape(-1, 6),
        join(face_alpha_mask, torch.empty(0, dtype=torch.int32, device=cpu)),
        background,
        cutoffs,
        _vertex_spacing(scene),
    )
