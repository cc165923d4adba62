"""Images without sampling: exact pixel integrals, whose autograd is the exact gradient, boundary term included.

A pixel is an integral of the radiance, weighted with the filter k around its centre q. Where the visible surface is cut
into convex polygons, each of one face and within one cell of a grid on which k is smooth,

    I_q = Σ_polygons ∫ k(x - q) L dx + (1 - coverage_q) background_q,      coverage_q = Σ_polygons ∫ k(x - q) dx,

and each term is a smooth function of the corners of its polygon. For the box filter, k = 1, the cells are the pixels.
Which polygons there are is combinatorics, decided here without derivatives; each of their corners is the intersection of
two lines (edges of faces, borders of cells), so its position is computed once more from the scene, with derivatives. That
one expression holds both terms of the gradient: radiance that changes at a point, and polygons whose sides move.

It is right for faces that do not pass through each other (cut_apart.py cuts others apart), in front of a perspective camera,
in general position. Edges and vertices that faces share are recognised, also when each face has its own copies. But where an
edge lies on a cell's border the image is right and has no two-sided derivative, and where edges of two occluders that share no
vertex lie on one line before a third face, the derivative may be that of the wrong edge.
Textures are cut into the cells in which they are bilinear, whose lines are straight in the image as well.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.scene.mesh import DEFAULT_RADIANCE, Mesh
from edgegrad.scene.scene import Scene

# Pixels. A point this close to a line counts as on it: above the rounding of coordinates (1e-14), far below anything
# that matters to an area.
ON_LINE = 1e-12


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread: exact integrals are many small operations, where waiting for others gains nothing."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def exact_image(scene: Scene, camera: Camera, order: int = 5, visibility: bool = True, filter: str = "box") -> Tensor:
    """Image (H, W, C) float64, differentiable in vertices, colours, background and camera.

    order       of the Gauss rule that integrates over a triangle; not used where colours and filter are constant
    visibility  False holds the polygons still, which leaves the gradient inside faces, as in `render`
    filter      as in `render`
    """
    size, C = camera.size, scene.channels
    # Pixel i sees the cells i … i + reach, whose middle, i + (reach + 1) / 2, is its centre.
    reach = {"box": 0, "tent": 1, "gaussian": 2}[filter]
    H, W = size[0] + reach, size[1] + reach
    shift = torch.zeros_like(camera.K)
    shift[:2, 2] = 0.5 * reach
    camera = camera.replace(K=camera.K + shift, size=(H, W))
    view = project(scene, camera)
    texel_lines, lines_of_face = _texel_lines(scene, view)
    line = torch.cat([view.edges.reshape(-1, 3), texel_lines, _cell_borders(W, axis=0), _cell_borders(H, axis=1)])
    with torch.no_grad():
        lines = Lines(line / line[:, :2].norm(dim=1, keepdim=True), _line_ends(scene, len(line)))
        pieces = split_by_texels(visible_pieces(view, lines), lines, lines_of_face)
        pieces, cell = split_by_cells(pieces, lines, H, W)

    # The corners again, with derivatives: each where the side that ends there meets the side that begins there.
    before = pieces.before()
    meet = torch.linalg.cross(line[before], line[pieces.side])
    # Edges that share a vertex meet there, also where they are parallel. End e of edge i is corner i + 1 + e.
    shared = lines.shared(before, pieces.side)
    corner = (pieces.side + 1 + shared[..., 1].long()) % 3
    vertex = view.P.reshape(-1, 3)[torch.where(shared.any(-1), pieces.side - pieces.side % 3 + corner, 0)]
    meet = torch.where(shared.any(-1, keepdim=True), vertex, meet)
    xy = meet[..., :2] / meet[..., 2:]
    xy = xy if visibility else xy.detach()
    assert bool(((xy - pieces.xy).abs() < 1e-6).all()), "exact_image: lines almost coincide; move the scene a little"

    # Triangles (T, 3, 2) that fan out from the first corner of each polygon.
    n, k = torch.nonzero(torch.arange(2, xy.shape[1]) < pieces.corners[:, None], as_tuple=True)
    triangle = torch.stack([xy[n, 0], xy[n, k + 1], xy[n, k + 2]], 1)
    area = 0.5 * _wedge(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    face, row, column = pieces.face[n], cell[n] // W, cell[n] % W

    constant = all(m.colors is None and m.corner_colors is None and m.texture is None for m in scene.meshes)
    points, weights = gauss_triangle(1 if constant and filter == "box" else order)
    x = points @ triangle  # (T, G, 2)
    radiance = _radiance(scene, face, _barycentrics(view.edges[face], x))  # (T, G, C)

    image = torch.zeros((size[0] * size[1], C), dtype=torch.float64)
    coverage = torch.zeros(size[0] * size[1], dtype=torch.float64)
    for i, j in ((row - up, column - left) for up in range(reach + 1) for left in range(reach + 1)):
        center = torch.stack([j, i], -1)[:, None] + 0.5 * (reach + 1)
        part = area[:, None] * weights * filter_weight(filter, x - center).prod(-1)  # (T, G)
        inside = (i >= 0) & (i < size[0]) & (j >= 0) & (j < size[1])
        pixel = (i * size[1] + j)[inside]
        image = image.index_add(0, pixel, torch.einsum("tg,tgc->tc", part, radiance)[inside])
        coverage = coverage.index_add(0, pixel, part.sum(1)[inside])
    background = torch.zeros(C) if scene.background is None else scene.background
    return image.reshape(*size, C) + (1.0 - coverage).reshape(*size, 1) * background.double()


def filter_weight(filter: str, d: Tensor) -> Tensor:
    """k at offsets from a pixel's centre within its support, along one axis."""
    if filter == "box":
        return torch.ones_like(d)
    if filter == "tent":
        return 1.0 - d.abs()
    sigma = 0.5
    return torch.exp(-0.5 * (d / sigma) ** 2) / (math.erf(3.0 / math.sqrt(2.0)) * math.sqrt(2.0 * math.pi) * sigma)


def gauss_triangle(order: int) -> tuple[Tensor, Tensor]:
    """Barycentrics (order², 3) and weights (order²,) that sum to one; exact for polynomials of degree 2 · order - 2.

    Gauss-Legendre points (u, v) of the unit square, collapsed to the triangle by (u, v) → (u, (1 - u) v) with its
    Jacobian 1 - u, times two as the triangle has the area ½ (Stroud, Approximate Calculation of Multiple Integrals).
    """
    x, w = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(order))
    u, v = (a.reshape(-1) for a in torch.meshgrid(0.5 * (x + 1.0), 0.5 * (x + 1.0), indexing="ij"))
    weights = 2.0 * (1.0 - u) * torch.outer(0.5 * w, 0.5 * w).reshape(-1)
    return torch.stack([u, (1.0 - u) * v, (1.0 - u) * (1.0 - v)], -1), weights


# -- the scene in the image -------------------------------------------------------------------------------------------


class View(NamedTuple):
    """All faces as the camera sees them."""

    P: Tensor  # (F, 3, 3) homogeneous image positions of the corners, in pixels
    Z: Tensor  # (F, 3) their depths
    # (F, 3, 3) edges as lines a·x + b·y + c = 0, positive inside the face; edge i lies opposite corner i. At a point
    # the three values are proportional to its perspective-correct barycentrics.
    edges: Tensor


def project(scene: Scene, camera: Camera) -> View:
    """The scene in the image; P is K (X, Y, Z) for a perspective camera and K (X, Y, 1) for an orthographic one."""
    R, t = camera.world_to_camera.double()[:3, :3], camera.world_to_camera.double()[:3, 3]
    q = torch.cat([(mesh.verts.double() @ R.mT + t)[mesh.faces.long()] for mesh in scene.meshes])
    Z = q[..., 2]
    if camera.projection == "perspective":
        assert bool((Z > 0).all()), "exact_image: every vertex must lie in front of a perspective camera"
    else:
        q = torch.cat([q[..., :2], torch.ones_like(q[..., :1])], -1)
    P = q @ camera.K.double().mT
    edges = torch.linalg.cross(P[:, [1, 2, 0]], P[:, [2, 0, 1]])
    return View(P, Z, edges * torch.linalg.det(P).detach().sign()[:, None, None])


def _line_ends(scene: Scene, count: int) -> Tensor:
    """The two vertices (count, 2) that each line passes through, equal positions welded: first the edges of the faces.
    The other lines pass through none, and have a negative number each instead."""
    faces, first = [], 0
    for mesh in scene.meshes:
        faces.append(mesh.faces.long() + first)
        first += len(mesh.verts)
    verts = torch.cat([mesh.verts.detach().double() for mesh in scene.meshes])
    welded = torch.unique(verts, dim=0, return_inverse=True)[1][torch.cat(faces)]
    ends = torch.stack([welded[:, [1, 2, 0]], welded[:, [2, 0, 1]]], -1).reshape(-1, 2)
    borders = torch.arange(len(ends), count)
    return torch.cat([ends, -borders[:, None].expand(-1, 2)])


def _cell_borders(n: int, axis: int) -> Tensor:
    """The lines (n + 1, 3) between cells, x = 0 … n for axis 0 or y = 0 … n for axis 1."""
    lines = torch.zeros((n + 1, 3), dtype=torch.float64)
    lines[:, axis], lines[:, 2] = 1.0, -torch.arange(n + 1)
    return lines


def _texel_corners(mesh: Mesh) -> Tensor:
    """Columns and rows (F, 3, 2) of a texture where the corners of its faces lie; whole numbers are the middles of texels."""
    assert mesh.uvs is not None and mesh.uv_faces is not None and mesh.texture is not None
    h, w = mesh.texture.shape[:2]
    u, v = mesh.uvs.double().unbind(-1)
    return torch.stack([u * w - 0.5, (1.0 - v) * h - 0.5], -1)[mesh.uv_faces.long()]


def _texel_lines(scene: Scene, view: View) -> tuple[Tensor, Tensor]:
    """Lines (N, 3) through the middles of texels, between which a texture is bilinear, and which of all lines they are for each
    face (F, M), padded with -1."""
    lines, table, first = [], torch.full((len(view.P), 0), -1), 0
    for mesh in scene.meshes:
        if mesh.texture is not None:
            for f, corners in enumerate(_texel_corners(mesh), first):
                low, high = (
                    corners.detach().amin(0).ceil().int().tolist(),
                    corners.detach().amax(0).floor().int().tolist(),
                )
                offsets = [corners[:, a] - k for a in range(2) for k in range(low[a], high[a] + 1)]
                # At a point the values of the edges are in proportion to barycentrics: a·x + b·y + c = Σ edge · offset.
                lines += [(view.edges[f] * offset[:, None]).sum(0) for offset in offsets]
                table = torch.nn.functional.pad(table, (0, max(0, len(offsets) - table.shape[1])), value=-1)
                table[f, : len(offsets)] = 3 * len(view.P) + len(lines) - len(offsets) + torch.arange(len(offsets))
        first += len(mesh.faces)
    return torch.stack(lines) if lines else torch.zeros((0, 3), dtype=torch.float64), table


def _radiance(scene: Scene, face: Tensor, b: Tensor) -> Tensor:
    """Radiance (T, G, C) at the barycentrics b (T, G, 3) in the faces (T,); the points of one row lie between the same texels."""
    C = scene.channels
    corners = torch.cat([corner_colors(mesh, C) for mesh in scene.meshes])
    radiance = torch.einsum("tgi,tic->tgc", b, corners[face])
    first = 0
    for mesh in scene.meshes:
        rows = torch.nonzero((face >= first) & (face < first + len(mesh.faces)))[:, 0]
        if mesh.texture is not None and len(rows):
            place = b[rows] @ _texel_corners(mesh)[face[rows] - first]  # (T', G, 2)
            cell = place.detach().mean(1).floor()
            x, y = (place - cell[:, None]).unbind(-1)
            h, w = mesh.texture.shape[:2]
            total = torch.zeros((), dtype=torch.float64)
            for i, weight_y in ((0, 1.0 - y), (1, y)):
                for j, weight_x in ((0, 1.0 - x), (1, x)):
                    texel = mesh.texture.double()[(cell[:, 1].long() + i) % h, (cell[:, 0].long() + j) % w]
                    total = total + (weight_y * weight_x)[..., None] * texel[:, None]
            radiance = radiance.index_put((rows,), total)
        first += len(mesh.faces)
    return radiance


def corner_colors(mesh: Mesh, channels: int) -> Tensor:
    """Return colours (F, 3, C) at the corners of faces, whatever kind the mesh has; zero for a texture."""
    if mesh.texture is not None:
        return torch.zeros((len(mesh.faces), 3, channels), dtype=torch.float64)
    if mesh.colors is not None:
        return mesh.colors.double()[mesh.faces.long()]
    if mesh.corner_colors is not None:
        return mesh.corner_colors.double()
    if mesh.face_colors is not None:
        return mesh.face_colors.double()[:, None].expand(-1, 3, -1)
    return torch.full((len(mesh.faces), 3, channels), DEFAULT_RADIANCE, dtype=torch.float64)


def _barycentrics(edges: Tensor, x: Tensor) -> Tensor:
    """Perspective-correct barycentrics (N, G, 3) of the image points x (N, G, 2) in faces with edges (N, 3, 3)."""
    w = x @ edges[..., :2].mT + edges[:, None, :, 2]
    return w / w.sum(-1, keepdim=True)


def _wedge(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


# -- convex polygons, many at once ------------------------------------------------------------------------------------


class Lines(NamedTuple):
    """L lines: edge i of face f is number 3 f + i; then come those of texels, and the borders of cells, across and down."""

    unit: Tensor  # (L, 3) (a, b, c) with a² + b² = 1, so that a·x + b·y + c is a distance in pixels
    ends: Tensor  # (L, 2) the vertices it passes through

    def shared(self, a: Tensor, b: Tensor) -> Tensor:
        """Return which of the two ends of each line b (…) is also an end of the line a (…), as (…, 2)."""
        return (self.ends[a][..., None] == self.ends[b][..., None, :]).any(-2)


class Polygons(NamedTuple):
    """N convex polygons of up to M corners; slots beyond `corners` repeat the first one. corners 0: empty."""

    xy: Tensor  # (N, M, 2) pixels
    side: Tensor  # (N, M) the line of the side from corner k to k + 1
    corners: Tensor  # (N,) how many
    face: Tensor  # (N,) whose surface it is

    def take(self, rows: Tensor) -> Polygons:
        """Return some of them, by index or mask."""
        return Polygons(*(field[rows] for field in self))

    def bounds(self) -> tuple[Tensor, Tensor]:
        return self.xy.amin(1), self.xy.amax(1)

    def before(self) -> Tensor:
        """Return the line (N, M) of the side that ends in corner k."""
        k = torch.arange(self.side.shape[1])
        last = self.corners[:, None] - 1
        return self.side.gather(1, torch.where((k == 0) | (k > last), last.clamp(min=0), k - 1))

    def area(self) -> Tensor:
        """Return areas (N,) in square pixels; polygons must not be empty."""
        spokes = self.xy - self.xy[:, :1]
        return 0.5 * _wedge(spokes[:, :-1], spokes[:, 1:]).sum(1)

    def cut(self, lines: Lines, line: Tensor, sign: int = 1) -> Polygons:
        """Return the parts on the positive (or negative) side of the lines number `line` (N,), one for each polygon.

        Sutherland and Hodgman (Reentrant polygon clipping, 1974). A corner on the line stays, and takes the line for
        the side that begins there if the old side leaves; so a side along the line is never intersected with it.
        """
        M = self.xy.shape[1]
        k = torch.arange(M)
        after = torch.where(k + 1 < self.corners[:, None], k + 1, 0)
        normal = sign * lines.unit[line][:, None]
        d = (self.xy * normal[..., :2]).sum(-1) + normal[..., 2]
        # On the line by construction, whatever rounding says: a corner that the line's own side begins or ends in, and
        # a vertex that the line shares with both sides.
        before, line = self.before(), line[:, None].expand_as(self.side)
        same = lines.shared(line, self.side)
        on = same.all(-1) | lines.shared(line, before).all(-1) | (same & lines.shared(before, self.side)).any(-1)
        d = torch.where(on | (d.abs() < ON_LINE), 0.0, d)
        d_after = d.gather(1, after)
        xy_after = self.xy.gather(1, after[..., None].expand(-1, -1, 2))
        crossing = self.xy + (d / (d - d_after))[..., None] * (xy_after - self.xy)

        # Corner k, then the crossing between k and k + 1; those that are there move to the front.
        used = k < self.corners[:, None]
        there = torch.stack([used & (d >= 0), used & (d * d_after < 0)], 2).reshape(-1, 2 * M)
        xy = torch.stack([self.xy, crossing], 2).reshape(-1, 2 * M, 2)
        begins = [(d == 0) & (d_after < 0), d > 0]
        side = torch.stack([torch.where(b, line, self.side) for b in begins], 2).reshape(-1, 2 * M)

        count = there.sum(1)
        count = torch.where(count >= 3, count, 0)
        M = max(3, int(count.max())) if len(count) else 3
        order = torch.argsort((~there).to(torch.uint8), dim=1, stable=True)[:, :M]
        order = torch.where(torch.arange(M) < count[:, None], order, order[:, :1])
        return Polygons(xy.gather(1, order[..., None].expand(-1, -1, 2)), side.gather(1, order), count, self.face)


def _join(parts: list[Polygons]) -> Polygons:
    """All of them in one, padded with their first corners, without those that are empty."""
    M = max(p.xy.shape[1] for p in parts)
    padded = []
    for p in parts:
        p = p.take(p.corners > 0)
        slots = torch.arange(M)
        slots = torch.where(slots < p.xy.shape[1], slots, 0)
        padded.append(p._replace(xy=p.xy[:, slots], side=p.side[:, slots]))
    return Polygons(*(torch.cat(field) for field in zip(*padded, strict=True)))


# -- what is seen -----------------------------------------------------------------------------------------------------


def visible_pieces(view: View, lines: Lines) -> Polygons:
    """The visible part of every face as convex polygons, not clipped to the image."""
    faces = _triangles(view)
    occluders = _occluders(faces, view, lines)
    low, high = faces.bounds()
    row = torch.full((len(view.P),), -1)
    row[faces.face] = torch.arange(len(faces.face))  # of a face, in `faces`

    pieces = faces
    for occluder in occluders.T:  # the first occluder of every face, then the second …
        front = occluder[pieces.face]
        piece_low, piece_high = pieces.bounds()
        near = ((piece_low <= high[row[front]]) & (piece_high >= low[row[front]])).all(-1) & (front >= 0)
        # The occluder is where all its edges are positive: what lies beyond the first, before it but beyond the
        # second, and so on, is seen; what is left after the last is hidden.
        inside, whole, front = pieces.take(near), pieces.take(near), front[near]
        beyond = []
        for i in range(3):
            beyond.append(inside.cut(lines, 3 * front + i, -1))
            inside = inside.cut(lines, 3 * front + i)
        hidden = inside.corners > 0
        pieces = _join([pieces.take(~near), whole.take(~hidden), *(part.take(hidden) for part in beyond)])
    return pieces


def split_by_texels(pieces: Polygons, lines: Lines, lines_of_face: Tensor) -> Polygons:
    """The pieces cut along lines of their own faces (F, M), padded with -1."""
    for column in lines_of_face.T:
        line = column[pieces.face]
        whole, cut, line = pieces.take(line < 0), pieces.take(line >= 0), line[line >= 0]
        pieces = _join([whole, cut.cut(lines, line), cut.cut(lines, line, -1)])
    return pieces


def split_by_cells(pieces: Polygons, lines: Lines, H: int, W: int) -> tuple[Polygons, Tensor]:
    """The pieces cut along the borders of cells, without what lies outside of them all, and their cells y · W + x."""
    index = []
    first = len(lines.unit) - (W + 1) - (H + 1)  # line of the first border
    for axis, n in ((0, W), (1, H)):
        low, high = (bound[:, axis] for bound in pieces.bounds())
        start = low.floor().clamp(0, n).long()
        times = (high.ceil().clamp(0, n).long() - start).clamp(min=0)
        rows = torch.repeat_interleave(times)
        cell = start[rows] + torch.arange(len(rows)) - (times.cumsum(0) - times)[rows]
        pieces, index = pieces.take(rows), [i[rows] for i in index] + [cell]
        pieces = pieces.cut(lines, first + cell).cut(lines, first + cell + 1, -1)
        there = pieces.corners > 0
        pieces, index = pieces.take(there), [i[there] for i in index]
        first += n + 1
    return pieces, index[1] * W + index[0]


def _triangles(view: View) -> Polygons:
    """The faces that have an area, as polygons of positive orientation."""
    xy = view.P[..., :2] / view.P[..., 2:]
    # The side that begins in corner k ends in k + 1 and is opposite corner k + 2.
    line = 3 * torch.arange(len(xy))[:, None] + torch.tensor([2, 0, 1])
    area = _wedge(xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0])
    back = area < 0
    xy = torch.where(back[:, None, None], xy[:, [0, 2, 1]], xy)
    line = torch.where(back[:, None], line[:, [2, 1, 0]], line)
    triangles = Polygons(xy, line, torch.full((len(xy),), 3), torch.arange(len(xy)))
    return triangles.take(area.abs() > ON_LINE)


def _occluders(faces: Polygons, view: View, lines: Lines) -> Tensor:
    """Return for each face (F,) those in front of it, padded with -1, the ones that cover most of it first."""
    low, high = faces.bounds()
    overlap = ((low[:, None] < high) & (high[:, None] > low)).all(-1)
    i, j = torch.nonzero(torch.triu(overlap, 1), as_tuple=True)
    common, other = faces.take(i), faces.face[j]
    for side in range(3):
        common = common.cut(lines, 3 * other + side)
    meet = common.corners > 0
    common, other = common.take(meet), other[meet]

    # Which of the two is nearer, all over what they share. 1e-6 allows for faces seen almost end-on.
    depth, depth_other = (
        (_barycentrics(view.edges[f], common.xy) * view.Z[f][:, None]).sum(-1) for f in (common.face, other)
    )
    gap = depth_other - depth  # (pairs, corners)
    rounding = 1e-6 * (depth.abs() + depth_other.abs()).amax(1)
    assert not bool(((gap.amin(1) < -rounding) & (gap.amax(1) > rounding)).any()), "exact_image: faces intersect"
    nearer = gap.sum(1) > 0
    front, behind = torch.where(nearer, common.face, other), torch.where(nearer, other, common.face)

    order = torch.argsort(common.area(), descending=True)
    order = order[torch.argsort(behind[order], stable=True)]
    behind, front = behind[order], front[order]
    times = torch.bincount(behind, minlength=len(view.P))
    rank = torch.arange(len(behind)) - (times.cumsum(0) - times)[behind]
    table = torch.full((len(view.P), int(times.max())), -1)
    table[behind, rank] = front
    return table
