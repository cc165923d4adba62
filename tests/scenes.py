"""Small scenes and meshes that many tests share, in float64."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from edgegrad.camera import Camera
from edgegrad.mesh import Mesh
from edgegrad.scene import Scene


def front_camera(size: int | tuple[int, int] = 64, projection: str = "perspective") -> Camera:
    """A camera 4 units from the origin, off every axis and tilted, that sees the ball of radius 1.2 around it."""
    size = (size, size) if isinstance(size, int) else size
    eye = 4.0 * torch.nn.functional.normalize(torch.tensor([0.31, 0.23, 1.0], dtype=torch.float64), dim=0)
    target, up = torch.zeros_like(eye), torch.tensor([0.17, 1.0, 0.0], dtype=torch.float64)
    if projection == "orthographic":
        return Camera.orthographic(eye, target, up, height=2.4, size=size)
    return Camera.look_at(eye, target, up, fov_y=36.0, size=size)


def unproject(camera: Camera, pixels: Tensor, depth: Tensor) -> Tensor:
    """World points (…, 3) at the pixel positions (…, 2) and the depths Z (…) of a camera."""
    xy = torch.linalg.solve(camera.K[:2, :2], (pixels - camera.K[:2, 2])[..., None])[..., 0]
    if camera.projection == "perspective":
        xy = xy * depth[..., None]
    R, t = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return (torch.cat([xy, depth[..., None]], -1) - t) @ R


def one_triangle() -> Scene:
    """One triangle with smooth colours on a coloured background."""
    verts = torch.tensor([[-0.83, -0.61, 0.2], [0.87, -0.42, -0.3], [0.13, 0.79, 0.1]], dtype=torch.float64)
    colors = torch.tensor([[0.9, 0.2, 0.1], [0.3, 0.8, 0.2], [0.1, 0.4, 1.0]], dtype=torch.float64)
    return Scene(Mesh(verts, torch.tensor([[0, 1, 2]]), colors=colors), _background())


def occluded_triangle() -> Scene:
    """A triangle with smooth colours, partly behind another one."""
    behind = one_triangle().meshes[0]
    verts = torch.tensor([[-0.31, -0.93, 0.9], [0.95, 0.17, 0.8], [-0.43, 0.57, 1.0]], dtype=torch.float64)
    colors = torch.tensor([[0.2, 0.9, 0.7], [0.8, 0.1, 0.6], [0.6, 0.5, 0.05]], dtype=torch.float64)
    return Scene([behind, Mesh(verts, torch.tensor([[0, 1, 2]]), colors=colors)], _background())


def cube(half: float = 0.6) -> Mesh:
    """A cube of edge length 2 · half: 8 vertices, 12 faces, outward, with a colour for each vertex."""
    x, y, z = (np.arange(8) >> 2) & 1, (np.arange(8) >> 1) & 1, np.arange(8) & 1
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = [[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)]
    verts = torch.from_numpy(half * (2.0 * np.stack([x, y, z], 1) - 1.0))
    return Mesh(verts, torch.tensor(faces), colors=smooth_colors(verts))


def icosphere(subdivisions: int = 3) -> Mesh:
    """Unit sphere of 20 · 4^subdivisions faces (3: 1,280; 6: 81,920), watertight, outward, with smooth colours."""
    phi = (1.0 + math.sqrt(5.0)) / 2.0
    # Corners (0, ±1, ±φ) and its rotations of coordinates: three rectangles, one in each plane.
    rectangle = np.array([[-1, phi, 0], [1, phi, 0], [-1, -phi, 0], [1, -phi, 0]])
    verts = np.concatenate([np.roll(rectangle, shift, axis=1) for shift in range(3)])
    # fmt: off
    faces = np.array([
        [0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11],  # around corner 0
        [1, 5, 9], [5, 11, 4], [11, 10, 2], [10, 7, 6], [7, 1, 8],  # next to those
        [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9],  # around corner 3
        [4, 9, 5], [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1],  # next to those
    ])
    # fmt: on
    for _ in range(subdivisions):
        # Each edge is listed by both its faces; `middle` numbers the edges once, after the vertices.
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        _, first, middle = np.unique(edges[:, 0] * len(verts) + edges[:, 1], return_index=True, return_inverse=True)
        a, b, c = faces.T
        ab, bc, ca = (middle.reshape(-1, 3) + len(verts)).T
        verts = np.concatenate([verts, verts[edges[first]].mean(1)])
        faces = np.stack([a, ab, ca, b, bc, ab, c, ca, bc, ab, bc, ca], 1).reshape(-1, 3)
    verts_tensor = torch.from_numpy(verts / np.linalg.norm(verts, axis=1, keepdims=True))
    return Mesh(verts_tensor, torch.from_numpy(faces), colors=smooth_colors(verts_tensor))


def smooth_colors(points: Tensor) -> Tensor:
    """Colours (V, 3) in (0, 1) that vary slowly with the position (V, 3)."""
    directions = torch.tensor([[2.1, 0.7, -1.3], [-0.9, 2.3, 1.1], [1.7, -1.9, 0.6]], dtype=points.dtype)
    return 0.5 + 0.4 * torch.sin(points @ directions + torch.tensor([0.3, 1.1, 2.0], dtype=points.dtype))


def random_slivers(count: int, seed: int, camera: Camera) -> Mesh:
    """Long thin triangles (half to nine tenths of the image, 1 to 3 % of it wide) that overlap heavily in the view of
    `camera`, each at a depth of its own, so that no two meet, with a random colour for each."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, dtype=torch.float64, generator=generator)

    H, W = camera.size
    scale = min(H, W)
    angle, length, width = uniform(0.0, 2.0 * math.pi), scale * uniform(0.5, 0.9), scale * uniform(0.01, 0.03)
    along = 0.5 * length[:, None] * torch.stack([angle.cos(), angle.sin()], -1)
    across = 0.5 * width[:, None] * torch.stack([-angle.sin(), angle.cos()], -1)
    centre = torch.stack([0.5 * W + scale * uniform(-0.25, 0.25), 0.5 * H + scale * uniform(-0.25, 0.25)], -1)
    pixels = torch.stack([centre - along - across, centre - along + across, centre + along], 1)
    depth = 3.0 + 2.0 * (torch.randperm(count, generator=generator).double() + uniform(0.2, 0.8)) / count
    verts = unproject(camera, pixels, depth[:, None].expand(-1, 3)).reshape(-1, 3)
    colors = torch.rand((count, 3), dtype=torch.float64, generator=generator)
    return Mesh(verts, torch.arange(3 * count).reshape(-1, 3), face_colors=colors)


def default_samples(mesh: Mesh, camera: Camera, adjoint: Tensor) -> tuple[int, int]:
    """How many surface and edge samples the kernel takes when it is not told, for the gradient of the vertices."""
    from edgegrad.render import _kernel_camera, _kernel_scene
    from edgegrad.scene import flatten

    scene = _kernel_scene(flatten(Scene([mesh])), torch.finfo(mesh.verts.dtype).eps)
    kernel_camera = _kernel_camera(
        camera.world_to_camera.double(), camera.K.double(), camera.projection == "perspective", *camera.size
    )
    dtype = scene_dtype(mesh)
    coverage = torch.zeros(camera.size, dtype=dtype)
    return scene.backward(
        kernel_camera, -1, -1, "box", 0, 1, True, True, adjoint.to(dtype).contiguous().numpy(), coverage.numpy(),
        verts=torch.zeros(mesh.verts.shape, dtype=torch.float64).numpy(),
    )  # fmt: skip


def scene_dtype(mesh: Mesh) -> torch.dtype:
    """The dtype of the colours of a mesh, which is that of its image."""
    return next(t.dtype for t in (mesh.colors, mesh.face_colors, mesh.corner_colors, mesh.texture) if t is not None)


def _background() -> Tensor:
    return torch.tensor([0.15, 0.25, 0.4], dtype=torch.float64)


def smooth_adjoint(height: int, width: int, channels: int) -> Tensor:
    """A smooth adjoint image (H, W, C), float64, of both signs, without symmetry."""
    y = torch.linspace(0.0, 1.0, height, dtype=torch.float64)[:, None, None]
    x = torch.linspace(0.0, 1.0, width, dtype=torch.float64)[None, :, None]
    c = torch.arange(channels, dtype=torch.float64)
    return torch.sin(5.0 * x + (2.0 + c) * y + c) + 0.5 * torch.cos(3.0 * y * (1.0 + 0.4 * c) - 2.0 * x) + 0.2
