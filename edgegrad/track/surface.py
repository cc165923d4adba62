"""The parts of a mesh that the tracker compares: its shape, points of its texture, and points spread over its surface."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from ..kernel.flat import flatten
from ..kernel.tracking import Shape, SurfacePoints
from ..scene.mesh import Mesh
from ..scene.scene import Scene

CANDIDATES = 20  # points drawn by area for each one that is kept by its texture
POINTS = 2000  # of each kind; some 300 of them are visible and compared in a frame
LEVELS = 7  # of a texture: blurs of 1, 2, 4 … 64 texels
LEAST_CONTRAST = 0.05  # of linear colours over the object's size: a surface with less has no texture


class Samples(NamedTuple):
    """Points on the surface: faces (N,), barycentrics (N, 3), positions and unit normals (N, 3)."""

    face: np.ndarray
    b: np.ndarray
    X: np.ndarray
    normal: np.ndarray


class Colors(NamedTuple):
    """Colours (levels, N, 3) at points, their gradient (N,) per world unit, and texels (N,) per world unit."""

    levels: np.ndarray
    gradient: np.ndarray
    texels: np.ndarray


def shape_of(scene: Scene, scale: float) -> Shape:
    """Return the shape of a scene whose meshes move together, `scale` times as large."""
    flat = flatten(Scene(list(scene.meshes)), all_uvs=True)
    verts, faces = scale * flat.verts.numpy(), flat.faces.numpy()
    used = verts[np.unique(faces)]
    low, high = used.min(0), used.max(0)
    center, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    verts = verts - center
    counts = np.cumsum([0, *(len(mesh.faces) for mesh in scene.meshes)])
    normals = _corner_normals(scene, scale)
    rng = np.random.default_rng(0)
    surface = _drawn(verts, faces, normals, POINTS, rng)
    drawn = _drawn(verts, faces, normals, CANDIDATES * POINTS, rng)
    colors = _colors(scene, drawn, counts, verts, faces)
    chosen = np.zeros(0, np.int64)
    strength = colors.gradient * size
    if strength.size and (strength > LEAST_CONTRAST).sum() >= POINTS // 4:
        p = np.minimum(strength, 30.0 * np.median(strength[strength > 0.0])) + 1e-3 * strength.max()
        chosen = rng.choice(len(p), min(POINTS, len(p)), replace=False, p=p / p.sum())
    textured = SurfacePoints(drawn.X[chosen], drawn.normal[chosen], colors.levels[:, chosen], colors.texels[chosen])
    plain = SurfacePoints(surface.X, surface.normal, np.zeros((0, 0, 3), np.float32), np.zeros(0, np.float32))
    return Shape(verts, faces, flat.spacing, textured, plain, center, size)


def _corner_normals(scene: Scene, scale: float) -> np.ndarray:
    """Return normals (F, 3, 3) of the corners: those of the vertices, where faces are not sharp."""
    parts = []
    for mesh in scene.meshes:
        verts, faces = scale * mesh.verts.detach().cpu().double(), mesh.faces.cpu().long()
        if mesh.normals is not None:
            rows = mesh.normal_faces.cpu().long() if mesh.normal_faces is not None else faces
            smooth = mesh.normals.detach().cpu().double()[rows]
        else:
            smooth = Mesh(verts, faces).vertex_normals().double()[faces]
        flat = torch.linalg.cross(verts[faces[:, 1]] - verts[faces[:, 0]], verts[faces[:, 2]] - verts[faces[:, 0]])
        flat = torch.nn.functional.normalize(flat, dim=-1)[:, None]
        smooth = torch.nn.functional.normalize(smooth, dim=-1)
        # A corner whose normal is more than 45° off belongs to a sharp edge, whose faces are flat.
        along = (smooth * flat).sum(-1, keepdim=True)
        parts.append(torch.where(along > 0.7, smooth, flat.expand_as(smooth)))
    return torch.cat(parts).numpy()


def _drawn(verts: np.ndarray, faces: np.ndarray, normals: np.ndarray, count: int, rng: np.random.Generator) -> Samples:
    """Return points drawn uniformly by area, in no order."""
    corners = verts[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not area.sum() > 0.0:
        raise ValueError("mesh: expected faces with an area, got only faces without; check the file")
    face = rng.choice(len(area), count, p=area / area.sum())
    b = rng.dirichlet((1.0, 1.0, 1.0), count)
    normal = np.einsum("nk,nkd->nd", b, normals[face])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Samples(face, b, np.einsum("nk,nkd->nd", b, corners[face]), normal)


def _colors(scene: Scene, at: Samples, counts: np.ndarray, verts: np.ndarray, faces: np.ndarray) -> Colors:
    """Return the colours of points; their gradient is zero where a mesh has none, or another number of channels than 1 or 3."""
    N = len(at.face)
    out = Colors(np.zeros((LEVELS, N, 3), np.float32), np.zeros(N), np.ones(N, np.float32))
    for k, mesh in enumerate(scene.meshes):
        here = np.flatnonzero((at.face >= counts[k]) & (at.face < counts[k + 1]))
        own, b = at.face[here] - counts[k], at.b[here]
        if mesh.texture is not None:
            found = _of_texture(mesh, own, b, verts[faces[at.face[here]]])
        else:
            found = _of_corners(mesh, own, b, verts[faces[at.face[here]]])
        if found is not None:
            out.levels[:, here], out.gradient[here], out.texels[here] = found
    return out


def _rgb(values: torch.Tensor) -> np.ndarray | None:
    values = values.detach().cpu().double()
    if values.shape[-1] not in (1, 3):
        return None
    return values.expand(*values.shape[:-1], 3).numpy()


def _of_corners(mesh: Mesh, face: np.ndarray, b: np.ndarray, corners: np.ndarray) -> Colors | None:
    """Return colours that are interpolated over faces; they have no blur, and one texel for a face."""
    rows = mesh.colors[mesh.faces.long()] if mesh.colors is not None else mesh.corner_colors
    colors = None if rows is None else _rgb(rows)
    if colors is None:
        return None
    C, e = colors[face], corners[:, 1:] - corners[:, :1]
    # The gradient G of a colour in the face's plane has G · e = the differences along both sides.
    metric = np.einsum("nid,njd->nij", e, e)
    metric += 1e-12 * np.trace(metric, axis1=1, axis2=2)[:, None, None] * np.eye(2)
    differences = C[:, 1:] - C[:, :1]
    square = np.einsum("nic,nij,njc->n", differences, np.linalg.inv(metric), differences)
    area = 0.5 * np.linalg.norm(np.cross(e[:, 0], e[:, 1]), axis=1)
    texels = 1.0 / np.sqrt(np.maximum(area, 1e-30))
    value = np.einsum("nk,nkc->nc", b, C)
    return Colors(np.repeat(value[None], LEVELS, 0), np.sqrt(np.maximum(square, 0.0)), texels)


def _of_texture(mesh: Mesh, face: np.ndarray, b: np.ndarray, corners: np.ndarray) -> Colors | None:
    assert mesh.texture is not None and mesh.uvs is not None and mesh.uv_faces is not None
    texels = _rgb(mesh.texture)
    if texels is None:
        return None
    uv = mesh.uvs.detach().cpu().double().numpy()[mesh.uv_faces.cpu().long().numpy()[face]]
    h, w = texels.shape[:2]
    x = np.einsum("nk,nkd->nd", b, uv) * (1.0, -1.0) + (0.0, 1.0)  # of the image's width and height, from its top
    levels = []
    image = torch.from_numpy(texels).movedim(-1, 0)[None]
    # A mean over 2ᵏ⁺¹ texels, interpolated, has about the deviation of a normal blur of 2ᵏ.
    for k in range(LEVELS):
        smaller = max(1, round(h / 2 ** (k + 1))), max(1, round(w / 2 ** (k + 1)))
        image = torch.nn.functional.interpolate(image, smaller, mode="area")
        levels.append(_sampled(image[0].movedim(0, -1).numpy(), x, mesh.wraps))
    step = 1.5 / np.array([w, h])
    fine = torch.nn.functional.avg_pool2d(
        torch.from_numpy(texels).movedim(-1, 0)[None], 3, 1, 1, count_include_pad=False
    )
    image = fine[0].movedim(0, -1).numpy()
    sides = [_sampled(image, x + s * step * a, mesh.wraps) for a in np.eye(2) for s in (1.0, -1.0)]
    per_texel = np.sqrt(((sides[0] - sides[1]) ** 2 + (sides[2] - sides[3]) ** 2).sum(1)) / 3.0
    e = uv[:, 1:] - uv[:, :1]
    in_texels = np.abs(e[:, 0, 0] * e[:, 1, 1] - e[:, 0, 1] * e[:, 1, 0]) * w * h
    c = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(c[:, 0], c[:, 1]), axis=1)
    density = np.sqrt(np.maximum(in_texels, 1e-12) / np.maximum(area, 1e-30))
    return Colors(np.stack(levels), per_texel * density, density)


def _sampled(image: np.ndarray, x: np.ndarray, wraps: tuple[str, str]) -> np.ndarray:
    """Return bilinear values (N, C) at x, in widths and heights of the image from its left top corner."""
    h, w = image.shape[:2]
    at = x * (w, h) - 0.5
    share = at % 1.0
    low = at - share

    def index(i: np.ndarray, count: int, wrap: str) -> np.ndarray:
        i = i.astype(np.int64)
        if wrap == "repeat":
            return i % count
        if wrap == "mirror":
            return np.where(i % (2 * count) < count, i % (2 * count), 2 * count - 1 - i % (2 * count))
        return i.clip(0, count - 1)

    columns = [index(low[:, 0] + k, w, wraps[0]) for k in (0, 1)]
    rows = [index(low[:, 1] + k, h, wraps[1]) for k in (0, 1)]
    a, b = share[:, :1], share[:, 1:]
    top = image[rows[0], columns[0]] * (1 - a) + image[rows[0], columns[1]] * a
    return top * (1 - b) + (image[rows[1], columns[0]] * (1 - a) + image[rows[1], columns[1]] * a) * b
