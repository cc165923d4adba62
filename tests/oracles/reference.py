"""The renderer once more, slowly: plain PyTorch in float64, brute force over all faces, for checking the kernel.

A sample at an image point x asks which face is the closest there and what radiance L that face has at x. The first is
a decision, without derivative; the second is differentiated by autograd. What comes out is therefore the *interior*
term of the gradient, ∫ k ∂L/∂Φ dx, and nothing of the *boundary* term, which moves the curves where L jumps.

Perspective and orthographic cameras differ only in the homogeneous image position P of a point q = R p + t,

    perspective   P = K (X, Y, Z)          orthographic   P = K (X, Y, 1)

with pixel position P[:2] / P[2]. The corners of a face, seen from the image point x, are at a_i = P_i[:2] - P_i[2] x,
and x has the barycentrics b_i ∝ a_j ∧ a_k, (i, j, k) cyclic. That is det(x̃, P_j, P_k) with x̃ = (x, 1): the edge
functions of Olano and Greer (Triangle scan conversion using 2D homogeneous coordinates, 1997), which equal, up to a
factor shared by the three, d · ((p_j - o) × (p_k - o)) for the ray o + s d. No corner is divided by its depth, so a
face may reach behind the camera.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.light.radiance import check_unlit
from edgegrad.scene.mesh import DEFAULT_RADIANCE, Mesh
from edgegrad.scene.scene import Scene

BLOCK = 128  # image points that are tested against all faces at once

# Filters k(x) k(y), up to a factor: half the width of the support in pixels, and k on it.
FILTERS: dict[str, tuple[float, Callable[[Tensor], Tensor]]] = {
    "box": (0.5, torch.ones_like),
    "tent": (1.0, lambda x: 1.0 - x.abs()),
    "gaussian": (1.5, lambda x: torch.exp(-(x**2) / (2.0 * 0.5**2))),
}


def radiance(scene: Scene, camera: Camera, points: Tensor, faces: Tensor | None = None) -> Tensor:
    """Radiance (N, C) float64 at the image points (N, 2), in pixels.

    faces (N,) int: the face seen at each point, counted over the meshes laid end to end, -1 for the background; found
    by `closest_faces` when None. Giving it fixes a sample while the scene moves, as finite differences of the interior
    term need. Differentiable in vertices, colours, textures, texture coordinates, background and camera, at fixed
    points. A background image counts with the pixel around the point.

    Raises ValueError for a batch of cameras, or a lens that distorts.
    """
    points = points.double()
    if faces is None:
        faces = closest_faces(scene, camera, points)
    surface = _surface_radiance(scene, camera, points, faces)
    background = _background(scene)
    if background.dim() == 3:
        H, W = background.shape[:2]
        x, y = points.detach().floor().long().unbind(-1)
        background = background[y.clamp(0, H - 1), x.clamp(0, W - 1)]
    return torch.where((faces >= 0)[:, None], surface, background)


def render(scene: Scene, camera: Camera, grid: int = 8, filter: str = "box") -> Tensor:
    """Image (H, W, C) float64 from a regular grid of `grid` × `grid` points a pixel, at the middles of its cells.

    filter: "box" = 1 on [-½, ½], "tent" = 1 - |x| on [-1, 1], or "gaussian" = exp(-x² / (2 · 0.5²)) on [-1.5, 1.5];
    weights are normalised to sum to one. Autograd gives the *interior* term of the gradient only.

    Raises ValueError for a batch of cameras or an unknown filter.
    """
    H, W = camera.size
    # The filter is separable, so with samples on one grid over the whole image it is a matrix for each axis.
    y, weights_y = _filter_matrix(H, grid, filter)
    x, weights_x = _filter_matrix(W, grid, filter)
    points = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)

    faces = closest_faces(scene, camera, points)
    surface = _surface_radiance(scene, camera, points, faces).reshape(len(y), len(x), -1)
    hit = (faces >= 0).double().reshape(len(y), len(x))
    coverage = weights_y @ hit @ weights_x.mT
    image = torch.einsum("ij,jkc,lk->ilc", weights_y, surface, weights_x)
    return image + (1.0 - coverage)[..., None] * _background(scene)


def closest_faces(scene: Scene, camera: Camera, points: Tensor) -> Tensor:
    """The face (N,) seen at each image point (N, 2), counted over the meshes laid end to end; -1 where there is none.

    A perspective camera sees what lies at Z > 0, an orthographic one everything on the line.
    """
    with torch.no_grad():
        P, Z = _project(scene, camera)
        low, high = _bounds(P)
        found = []
        for x in points.double().split(BLOCK):
            near = torch.nonzero(((low <= x.amax(0)) & (high >= x.amin(0))).all(-1))[:, 0]
            if len(near) == 0:
                found.append(torch.full((len(x),), -1))
                continue
            w = _edge_functions(P[near], x[:, None])
            inside = (w.amin(-1) >= 0) | (w.amax(-1) <= 0)  # faces are seen from both sides
            area = w.sum(-1)
            depth = (w * Z[near]).sum(-1) / area
            inside &= area != 0  # a face seen end-on, or of no area, covers nothing
            inside &= _shows(scene, near, w / area[..., None])
            if camera.projection == "perspective":
                inside &= depth > 0
            closest = near[torch.where(inside, depth, math.inf).argmin(-1)]
            found.append(torch.where(inside.any(-1), closest, -1))
    return torch.cat(found) if found else torch.empty(0, dtype=torch.int64)


def _shows(scene: Scene, faces: Tensor, barycentrics: Tensor) -> Tensor:
    """Return (m, n) whether alpha shows the faces (n,) at these barycentrics (m, n, 3)."""
    shows = torch.ones(barycentrics.shape[:-1], dtype=torch.bool)
    first = 0
    for mesh in scene.meshes:
        last = first + len(mesh.faces)
        if mesh.alpha is not None:
            own = torch.nonzero((faces >= first) & (faces < last))[:, 0]
            uv = (barycentrics[:, own, :, None] * _corner_uvs(mesh, faces[own] - first)).sum(-2)
            uv = torch.where(uv.isfinite(), uv, 0.0)  # of faces without area, which cover nothing
            alpha = _lookup(mesh, mesh.alpha.double()[..., None], uv.reshape(-1, 2)).reshape(uv.shape[:-1])
            shows[:, own] = alpha >= mesh.alpha_cutoff
        first = last
    return shows


def _bounds(P: Tensor) -> tuple[Tensor, Tensor]:
    """Lower and upper corners (F, 2) of a box in the image around each face, to leave out faces far from a point."""
    x = P[..., :2] / P[..., 2:]
    low, high = x.amin(1), x.amax(1)
    slack = 1e-9 * (1.0 + low.abs() + high.abs())  # far above the rounding of the division, far below a pixel
    bounded = (P[..., 2] > 0).all(-1, keepdim=True)  # a face that reaches behind the camera can be seen anywhere
    return torch.where(bounded, low - slack, -math.inf), torch.where(bounded, high + slack, math.inf)


def _project(scene: Scene, camera: Camera) -> tuple[Tensor, Tensor]:
    """Homogeneous image positions P (F, 3 corners, 3) of all faces and the depths Z (F, 3) of their corners."""
    if camera.batch is not None:
        raise ValueError(f"camera: expected a single camera, got a batch of {camera.batch}; call once for each")
    if camera.lens != "pinhole":
        raise ValueError(f"camera: expected straight edges to stay straight, got {camera!r}; leave out the distortion")
    M, K = camera.world_to_camera.double(), camera.K.double()
    q = torch.cat([(mesh.verts.double() @ M[:3, :3].mT + M[:3, 3])[mesh.faces.long()] for mesh in scene.meshes])
    X, Y, Z = q.unbind(-1)
    last = Z if camera.projection == "perspective" else torch.ones_like(Z)
    return torch.stack([X, Y, last], -1) @ K.mT, Z


def _edge_functions(P: Tensor, x: Tensor) -> Tensor:
    """Barycentrics (…, 3) of the image points x (…, 2) in the faces P (…, 3, 3), up to a common factor."""
    (ux, vx, wx), (uy, vy, wy) = ((P[..., i] - P[..., 2] * x[..., i : i + 1]).unbind(-1) for i in (0, 1))
    return torch.stack([vx * wy - vy * wx, wx * uy - wy * ux, ux * vy - uy * vx], -1)


def _surface_radiance(scene: Scene, camera: Camera, points: Tensor, faces: Tensor) -> Tensor:
    """Radiance (N, C) of the given faces at the image points (N, 2); zero where the face is -1."""
    check_unlit("reference", scene, "it knows colours alone")
    P, _ = _project(scene, camera)
    out = torch.zeros((len(points), scene.channels), dtype=torch.float64)
    first = 0
    for mesh in scene.meshes:
        last = first + len(mesh.faces)
        rows = torch.nonzero((faces >= first) & (faces < last))[:, 0]
        w = _edge_functions(P[faces[rows]], points[rows])
        b = w / w.sum(-1, keepdim=True)
        value = (b[..., None] * _corner_values(mesh, scene.channels, faces[rows] - first)).sum(1)
        out = out.index_put((rows,), value if mesh.texture is None else _lookup(mesh, mesh.texture.double(), value))
        first = last
    return out


def _corner_values(mesh: Mesh, channels: int, faces: Tensor) -> Tensor:
    """Return what is interpolated over faces (N,), at their corners: colours (N, 3, C) or uvs (N, 3, 2)."""
    if mesh.texture is not None:
        return _corner_uvs(mesh, faces)
    if mesh.colors is not None:
        return mesh.colors.double()[mesh.faces.long()[faces]]
    if mesh.corner_colors is not None:
        return mesh.corner_colors.double()[faces]
    if mesh.face_colors is not None:
        return mesh.face_colors.double()[faces][:, None].expand(-1, 3, -1)
    return torch.full((len(faces), 3, channels), DEFAULT_RADIANCE, dtype=torch.float64)


def _corner_uvs(mesh: Mesh, faces: Tensor) -> Tensor:
    """Return texture coordinates (N, 3, 2) of faces (N,)."""
    assert mesh.uvs is not None and mesh.uv_faces is not None
    return mesh.uvs.double()[mesh.uv_faces.long()[faces]]


def _lookup(mesh: Mesh, texture: Tensor, uv: Tensor) -> Tensor:
    """Texture (h, w, C) of a mesh at coordinates (N, 2): texel centres at +0.5, row 0 on top while v runs up."""
    h, w = texture.shape[:2]
    column, row = uv[:, 0] * w, (1.0 - uv[:, 1]) * h

    def texel(i: Tensor, j: Tensor) -> Tensor:
        return texture[_wrapped(i, h, mesh.wraps[1]), _wrapped(j, w, mesh.wraps[0])]

    if mesh.filter == "nearest":
        return texel(row.detach().floor().long(), column.detach().floor().long())
    column, row = column - 0.5, row - 0.5
    left, top = column.detach().floor(), row.detach().floor()
    s, t = (column - left)[:, None], (row - top)[:, None]
    i, j = top.long(), left.long()
    upper = (1.0 - s) * texel(i, j) + s * texel(i, j + 1)
    lower = (1.0 - s) * texel(i + 1, j) + s * texel(i + 1, j + 1)
    return (1.0 - t) * upper + t * lower


def _wrapped(index: Tensor, count: int, wrap: str) -> Tensor:
    if wrap == "clamp":
        return index.clamp(0, count - 1)
    if wrap == "repeat":
        return index % count
    return count - 1 - ((index % (2 * count)) - count + 0.5).abs().sub(0.5).long()


def _background(scene: Scene) -> Tensor:
    """Return the background (C,) or (H, W, C), black when the scene has none."""
    return torch.zeros(scene.channels, dtype=torch.float64) if scene.background is None else scene.background.double()


def _filter_matrix(pixels: int, grid: int, filter: str) -> tuple[Tensor, Tensor]:
    """Sample positions (S,) along one axis, in pixels, and the filter's weights (pixels, S), whose rows sum to one."""
    if filter not in FILTERS:
        raise ValueError(f"filter: expected one of {', '.join(FILTERS)}, got {filter!r}")
    radius, kernel = FILTERS[filter]
    margin = math.ceil(radius - 0.5)  # pixels beyond the image that the filter reaches into
    samples = (torch.arange((pixels + 2 * margin) * grid, dtype=torch.float64) + 0.5) / grid - margin
    distance = samples - (torch.arange(pixels, dtype=torch.float64) + 0.5)[:, None]
    weights = torch.where(distance.abs() < radius, kernel(distance), 0.0)
    return samples, weights / weights.sum(-1, keepdim=True)
