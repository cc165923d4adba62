"""Meshes of simple shapes, of silhouettes, and of trimesh.

Simple shapes have texture coordinates, and their fronts outside. Given `material=eg.Material(base_color=0.0, emission=…)` they
are area lights. Positions are differentiable functions of the tensors that are given.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from .check import check_dtype, check_int, check_shape, values_visible
from .files.save import from_trimesh, to_trimesh
from .fit.hull import visual_hull
from .scene.material import Material, numbers
from .scene.mesh import Mesh

__all__ = ["box", "disc", "from_trimesh", "grid", "rectangle", "sphere", "to_trimesh", "visual_hull"]

MOST_ROWS = 1 << 14  # of a grid's cells
MOST_SEGMENTS = 1 << 20
MOST_SUBDIVISIONS = 9  # 2.6 million vertices
Vector = Tensor | tuple[float, float, float] | list[float]


def rectangle(
    center: Vector = (0.0, 0.0, 0.0),
    u: Vector = (1.0, 0.0, 0.0),
    v: Vector = (0.0, 1.0, 0.0),
    *,
    material: Material | None = None,
    dtype: torch.dtype | None = None,
) -> Mesh:
    """Return a rectangle, or a parallelogram, with the corners center ± u ± v.

    Parameters
    ----------
    center : (3,), default the origin
        World units.
    u, v : (3,), default the axes x and y
        Half of the sides, world units. The front is on the side of u × v; texture coordinates run along u and v.
    material : Material, optional
        With emission it makes an area light.
    dtype : torch.dtype, default that of the given tensors, else torch's default
        Of the mesh.

    Returns
    -------
    Mesh
        4 vertices and 2 faces.

    Raises
    ------
    TypeError, ValueError
        An argument has another type or shape, or is not finite.

    Examples
    --------
    >>> import edgegrad as eg
    >>> emitting = eg.Material(base_color=0.0, emission=8.0, two_sided=False)
    >>> eg.shapes.rectangle((0, 3, 0), (0, 0, 0.5), (0.5, 0, 0), material=emitting)
    Mesh(4 vertices, 2 faces, plain, lit, torch.float32)
    """
    center, u, v = _vectors(dtype, center=center, u=u, v=v)
    uvs = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    verts = torch.stack([center - u - v, center + u - v, center + u + v, center - u + v])
    return _mesh(verts, torch.tensor([[0, 1, 2], [0, 2, 3]]), uvs, None, material)


def disc(
    center: Vector = (0.0, 0.0, 0.0),
    u: Vector = (1.0, 0.0, 0.0),
    v: Vector = (0.0, 1.0, 0.0),
    segments: int = 64,
    *,
    material: Material | None = None,
    dtype: torch.dtype | None = None,
) -> Mesh:
    """Return a disc, or an ellipse, as a polygon with the corners center + u cos φ + v sin φ.

    Parameters
    ----------
    center : (3,), default the origin
        World units.
    u, v : (3,), default the axes x and y
        Radii, world units. The front is on the side of u × v; texture coordinates are 0 … 1 along u and v.
    segments : int, default 64
        Corners of the polygon, at least 3.
    material, dtype
        As of rectangle().

    Returns
    -------
    Mesh
        segments + 1 vertices, the centre last, and as many faces as segments.

    Raises
    ------
    TypeError, ValueError
        An argument has another type or shape, or is out of range.

    Examples
    --------
    >>> import edgegrad as eg
    >>> eg.shapes.disc(segments=12)
    Mesh(13 vertices, 12 faces, plain, torch.float32)
    """
    center, u, v = _vectors(dtype, center=center, u=u, v=v)
    check_int("segments", segments, 3, MOST_SEGMENTS)
    k = torch.arange(segments)
    angle = (2 * math.pi / segments * k).to(center)[:, None]
    verts = torch.cat([center + angle.cos() * u + angle.sin() * v, center[None]])
    faces = torch.stack([torch.full_like(k, segments), k, (k + 1) % segments], 1)
    phi = (2 * math.pi / segments * k).double()
    uvs = torch.cat([0.5 + 0.5 * torch.stack([phi.cos(), phi.sin()], 1), torch.tensor([[0.5, 0.5]])])
    return _mesh(verts, faces, uvs, None, material)


def grid(
    rows: int,
    columns: int,
    center: Vector = (0.0, 0.0, 0.0),
    u: Vector = (1.0, 0.0, 0.0),
    v: Vector = (0.0, 1.0, 0.0),
    *,
    material: Material | None = None,
    dtype: torch.dtype | None = None,
) -> Mesh:
    """Return a rectangle of rows × columns cells, such as a ground whose heights are to be found.

    Parameters
    ----------
    rows, columns : int
        Cells along v and along u.
    center, u, v, material, dtype
        As of rectangle().

    Returns
    -------
    Mesh
        (rows + 1) · (columns + 1) vertices, row by row from −v to v, each from −u to u, and 2 · rows · columns faces.

    Raises
    ------
    TypeError, ValueError
        An argument has another type or shape, or is out of range.

    Examples
    --------
    >>> import edgegrad as eg
    >>> ground = eg.shapes.grid(3, 4)
    >>> ground.verts.view(4, 5, 3)[0, 4]
    tensor([ 1., -1.,  0.])
    """
    center, u, v = _vectors(dtype, center=center, u=u, v=v)
    check_int("rows", rows, 1, MOST_ROWS)
    check_int("columns", columns, 1, MOST_ROWS)
    along_v, along_u = (torch.arange(n + 1, dtype=torch.float64) / n for n in (rows, columns))
    y, x = torch.meshgrid(along_v, along_u, indexing="ij")
    uvs = torch.stack([x, y], -1).reshape(-1, 2)
    steps = (2.0 * uvs - 1.0).to(center)
    verts = center + steps[:, :1] * u + steps[:, 1:] * v
    first = (torch.arange(rows)[:, None] * (columns + 1) + torch.arange(columns)).reshape(-1)
    a, b, c, d = first, first + 1, first + columns + 2, first + columns + 1
    faces = torch.stack([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)], 1).reshape(-1, 3)
    return _mesh(verts, faces, uvs, None, material)


def box(
    center: Vector = (0.0, 0.0, 0.0),
    size: Vector | float = 2.0,
    *,
    material: Material | None = None,
    dtype: torch.dtype | None = None,
) -> Mesh:
    """Return a box along the axes.

    Parameters
    ----------
    center : (3,), default the origin
        World units.
    size : float or (3,), default 2
        Lengths of the edges along x, y and z, world units, above zero.
    material, dtype
        As of rectangle().

    Returns
    -------
    Mesh
        8 vertices and 12 faces, in pairs: those at −x, +x, −y, +y, −z and +z. Each side has the whole of a texture, which is
        upright on the four sides around y.

    Raises
    ------
    TypeError, ValueError
        An argument has another type or shape, or is out of range.

    Examples
    --------
    >>> import edgegrad as eg
    >>> eg.shapes.box(size=(1, 2, 3)).verts.amax(0)
    tensor([0.5000, 1.0000, 1.5000])
    """
    edges: object = size
    if isinstance(size, Tensor):
        edges = size.expand(3) if size.dim() == 0 else size
    elif isinstance(size, (int, float)):
        edges = (size, size, size)
    center, size = _vectors(dtype, center=center, size=edges)
    _check_positive("size", size)
    signs = torch.tensor([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]).to(size)
    # Corners of each side from the lower left, counter-clockwise as seen from outside.
    sides = torch.tensor([[0, 1, 3, 2], [5, 4, 6, 7], [0, 4, 5, 1], [3, 7, 6, 2], [4, 0, 2, 6], [1, 5, 7, 3]])
    uvs = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    uv_faces = torch.tensor([[0, 1, 2], [0, 2, 3]]).repeat(6, 1)
    return _mesh(center + 0.5 * signs * size, _halves(sides), uvs, uv_faces, material)


def sphere(
    center: Vector = (0.0, 0.0, 0.0),
    radius: Tensor | float = 1.0,
    subdivisions: int = 4,
    *,
    material: Material | None = None,
    dtype: torch.dtype | None = None,
) -> Mesh:
    """Return a sphere of triangles of about the same size: an icosahedron, each face of it divided into 4 so many times.

    Parameters
    ----------
    center : (3,), default the origin
        World units.
    radius : float, default 1
        Distance of the vertices from the center, world units, above zero.
    subdivisions : int, default 4
        From 0 to 9.
    material, dtype
        As of rectangle().

    Returns
    -------
    Mesh
        10 · 4ⁿ + 2 vertices and 20 · 4ⁿ faces after n subdivisions. A texture lies on it as a map on a globe, with the north
        pole at +y, the middle of the map at +z, and east to the right.

    Raises
    ------
    TypeError, ValueError
        An argument has another type or shape, or is out of range.

    Notes
    -----
    It has no normals, so it is shaded flat; `mesh.replace(normals=mesh.vertex_normals())` is smooth.

    Examples
    --------
    >>> import edgegrad as eg
    >>> eg.shapes.sphere(radius=0.5, subdivisions=2)
    Mesh(162 vertices, 320 faces, plain, torch.float32)
    """
    given = numbers("radius", radius)
    if given.numel() != 1:
        raise ValueError(f"radius: expected one number, got shape {tuple(given.shape)}")
    if isinstance(radius, Tensor):
        center, given = _vectors(dtype, center=center, radius=given.reshape(1).expand(3))
    else:
        (center,) = _vectors(dtype, center=center)
        given = given.to(center)
    _check_positive("radius", given)
    check_int("subdivisions", subdivisions, 0, MOST_SUBDIVISIONS)
    directions, faces = _icosphere(subdivisions)
    uvs, uv_faces = _on_a_globe(directions, faces)
    return _mesh(center + given * directions.to(center), faces, uvs, uv_faces, material)


def _icosphere(subdivisions: int) -> tuple[Tensor, Tensor]:
    """Return unit vectors (V, 3) float64 and faces (F, 3)."""
    g = (1 + math.sqrt(5.0)) / 2
    corners = [
        [-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0], [0, -1, g], [0, 1, g],
        [0, -1, -g], [0, 1, -g], [g, 0, -1], [g, 0, 1], [-g, 0, -1], [-g, 0, 1],
    ]  # fmt: skip
    faces = torch.tensor([
        [0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2], [10, 7, 6], [7, 1, 8],
        [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9], [4, 9, 5], [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1],
    ])  # fmt: skip
    verts = torch.nn.functional.normalize(torch.tensor(corners, dtype=torch.float64), dim=1)
    for _ in range(subdivisions):
        edges = faces[:, [[0, 1], [1, 2], [2, 0]]].sort(-1).values.reshape(-1, 2)
        unique, index = edges.unique(dim=0, return_inverse=True)
        ab, bc, ca = (index.view(-1, 3) + len(verts)).unbind(1)
        a, b, c = faces.unbind(1)
        parts = [[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]
        faces = torch.stack([torch.stack(part, 1) for part in parts], 1).reshape(-1, 3)
        verts = torch.cat([verts, torch.nn.functional.normalize(verts[unique].sum(1), dim=1)])
    return verts, faces


def _on_a_globe(directions: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Return texture coordinates (T, 2) and their faces (F, 3). Faces across the date line reach beyond u = 1."""
    x, y, z = directions.unbind(1)
    u = (0.5 + torch.atan2(x, z) / (2 * math.pi))[faces]
    pole = (x.abs() + z.abs() < 1e-9)[faces]
    u = u.where(~pole, torch.nan)
    across = u.nan_to_num(-1.0).amax(1, keepdim=True) - u.nan_to_num(2.0).amin(1, keepdim=True) > 0.5
    u = torch.where(across & (u < 0.5), u + 1.0, u)
    u = torch.where(pole, u.nanmean(1, keepdim=True), u)  # a pole lies above the middle of each face that meets there
    v = (0.5 + torch.asin(y.clamp(-1, 1)) / math.pi)[faces]
    uvs, index = torch.stack([u, v], -1).reshape(-1, 2).unique(dim=0, return_inverse=True)
    return uvs, index.view(-1, 3)


def _halves(sides: Tensor) -> Tensor:
    """Return two triangles (2 N, 3) of each quadrilateral (N, 4)."""
    return sides[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def _mesh(verts: Tensor, faces: Tensor, uvs: Tensor, uv_faces: Tensor | None, material: Material | None) -> Mesh:
    """Return the mesh on the device of its vertices; without uv_faces, each vertex has its own texture coordinates."""
    faces, uvs = faces.to(verts.device), uvs.to(verts)
    uv_faces = faces if uv_faces is None else uv_faces.to(verts.device)
    return Mesh(verts, faces, uvs=uvs, uv_faces=uv_faces, material=material)


def _vectors(dtype: torch.dtype | None, **given: Any) -> list[Tensor]:
    """Return vectors (3,) of one dtype: the given one, else the widest of the tensors, else torch's default."""
    found = {name: numbers(name, value) for name, value in given.items()}
    for name, vector in found.items():
        check_shape(name, vector, (3,))
    tensors = [found[name] for name, value in given.items() if isinstance(value, Tensor)]
    widest = max((t.dtype for t in tensors), key=lambda t: torch.finfo(t).bits, default=torch.get_default_dtype())
    device = tensors[0].device if tensors else None
    return [vector.to(device, check_dtype(dtype) or widest) for vector in found.values()]


def _check_positive(name: str, value: Tensor) -> None:
    if values_visible(value) and not bool((value.detach() > 0).all()):
        raise ValueError(f"{name}: expected numbers above 0, got {value.detach().tolist()}")
