"""Scenes to measure gradients on, procedural but for the scan, and the pieces from which tests build theirs."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.files.load import load_scene
from edgegrad.preview import framing
from edgegrad.scene.environment import Environment
from edgegrad.scene.lights import Light, PointLight
from edgegrad.scene.material import Material
from edgegrad.scene.mesh import Mesh
from edgegrad.scene.scene import Scene
from edgegrad.scene.tree import tensors_in
from edgegrad.shapes import rectangle

BACKGROUND = (0.15, 0.25, 0.4)


@dataclass(frozen=True, eq=False)
class ReportScene:
    """A scene on which a gradient is measured; the loss is image · adjoint."""

    name: str
    title: str  # what it shows, in a few words
    scene: Scene
    camera: Camera
    adjoint: Tensor  # (H, W, C) ∂loss/∂image
    objects: int | None = None  # of the gradient: so many meshes, the first ones; all when None
    bounces: int = 1  # how often light is scattered

    @property
    def moving(self) -> Sequence[Mesh]:
        """Meshes whose vertices have the gradient."""
        return self.scene.meshes[: self.objects]

    @property
    def verts(self) -> Tensor:
        """Vertices (V, 3) of these meshes, end to end, float64."""
        return torch.cat([mesh.verts.double() for mesh in self.moving])

    @property
    def faces(self) -> int:
        return sum(len(mesh.faces) for mesh in self.scene.meshes)

    @property
    def center(self) -> Tensor:
        """Centroid (3,) of the vertices, float64; the object rotates about it."""
        return self.verts.mean(0)

    def moved(self, verts: Tensor) -> Scene:
        """Return the scene with other vertices (V, 3)."""
        parts = verts.split([len(mesh.verts) for mesh in self.moving])
        moved = [mesh.replace(verts=part) for mesh, part in zip(self.moving, parts, strict=True)]
        return self.scene.replace(meshes=[*moved, *self.scene.meshes[len(moved) :]])

    @property
    def fingerprint(self) -> str:
        """Tells scenes of one name apart, such as two scans or two sizes."""
        digest = hashlib.sha256(repr((self.camera.size, self.camera.projection)).encode())
        tensors = [self.camera.world_to_camera, self.camera.K, self.adjoint, self.scene.background]
        for mesh in self.scene.meshes:
            tensors += [getattr(mesh, field.name) for field in dataclasses.fields(mesh)[:8]]
            tensors += [] if mesh.alpha is None else [mesh.alpha]
        if self.scene.is_lit:
            digest.update(repr((self.objects, [type(light).__name__ for light in self.scene.lights])).encode())
            digest.update(str(self.bounces).encode() if self.bounces > 1 else b"")
            tensors += tensors_in(self.scene)
        for tensor in tensors:
            digest.update(b"-" if tensor is None else tensor.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()[:16]


def build(name: str, size: int = 256, mesh: Path | None = None, **variant: float) -> ReportScene:
    """Return a scene by its name, in float32, seen in size × size pixels.

    `mesh` is the file of the scan. `variant` holds other arguments of the function of the scene, such as subdivisions=3.

    Raises ValueError for another name or a mesh that cannot be framed, OSError and ImportError where the scan is not there.
    """
    if name not in SCENES:
        raise ValueError(f"scene: expected one of {', '.join(SCENES)}, got {name!r}")
    if name == "scan":
        title, scene, camera = _scan(size, mesh)
    else:
        title, scene, camera = SCENES[name](size, **variant)
    # As users have them: meshes in float32.
    scene, camera = scene.to(torch.float32), camera.to(torch.float64)
    adjoint = noise_adjoint if name == "noise" else smooth_adjoint
    objects, bounces = 1 if name in LIT else None, 2 if name in BOUNCED else 1
    return ReportScene(name, title, scene, camera, adjoint(size, size, scene.channels).float(), objects, bounces)


# -- pieces that the tests use as well -------------------------------------------------------------------------------


def front_camera(size: int | tuple[int, int] = 64, projection: str = "perspective") -> Camera:
    """Return a tilted camera off every axis, 4 units from the origin, that sees the ball of radius 1.2 around it."""
    size = (size, size) if isinstance(size, int) else size
    eye = 4.0 * torch.nn.functional.normalize(torch.tensor([0.31, 0.23, 1.0], dtype=torch.float64), dim=0)
    target, up = torch.zeros_like(eye), torch.tensor([0.17, 1.0, 0.0], dtype=torch.float64)
    if projection == "orthographic":
        return Camera.orthographic(eye, target, up, height=2.4, size=size)
    return Camera.look_at(eye, target, up, fov_y=36.0, size=size)


def unproject(camera: Camera, pixels: Tensor, depth: Tensor) -> Tensor:
    """Return world points (…, 3) at the pixel positions (…, 2) and the depths Z (…) of a camera."""
    xy = torch.linalg.solve(camera.K[:2, :2], (pixels - camera.K[:2, 2])[..., None])[..., 0]
    if camera.projection == "perspective":
        xy = xy * depth[..., None]
    R, t = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return (torch.cat([xy, depth[..., None]], -1) - t) @ R


def one_triangle() -> Scene:
    """Return one large triangle with smooth colours on a coloured background, in float64."""
    verts = torch.tensor([[-0.83, -0.61, 0.2], [0.87, -0.42, -0.3], [0.13, 0.79, 0.1]], dtype=torch.float64)
    colors = torch.tensor([[0.9, 0.2, 0.1], [0.3, 0.8, 0.2], [0.1, 0.4, 1.0]], dtype=torch.float64)
    return Scene([Mesh(verts, torch.tensor([[0, 1, 2]]), colors=colors)], background())


def occluded_triangle() -> Scene:
    """Return a triangle with smooth colours, partly behind another one."""
    behind = one_triangle().meshes[0]
    verts = torch.tensor([[-0.31, -0.93, 0.9], [0.95, 0.17, 0.8], [-0.43, 0.57, 1.0]], dtype=torch.float64)
    colors = torch.tensor([[0.2, 0.9, 0.7], [0.8, 0.1, 0.6], [0.6, 0.5, 0.05]], dtype=torch.float64)
    return Scene([behind, Mesh(verts, torch.tensor([[0, 1, 2]]), colors=colors)], background())


def cube(half: float = 0.6) -> Mesh:
    """Return a cube of edge length 2 · half: 8 vertices, 12 outward faces, a colour for each vertex."""
    x, y, z = (np.arange(8) >> 2) & 1, (np.arange(8) >> 1) & 1, np.arange(8) & 1
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = [[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)]
    verts = torch.from_numpy(half * (2.0 * np.stack([x, y, z], 1) - 1.0))
    return Mesh(verts, torch.tensor(faces), colors=smooth_colors(verts))


def icosphere(subdivisions: int = 3) -> Mesh:
    """Return a watertight unit sphere of 20 · 4^subdivisions faces (3: 1,280; 6: 81,920) with smooth colours."""
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


def soup(mesh: Mesh) -> Mesh:
    """Return the mesh with separate vertices for each face."""
    assert mesh.texture is None
    index = mesh.faces.long().reshape(-1)
    colors = None if mesh.colors is None else mesh.colors[index]
    return mesh.replace(verts=mesh.verts[index], faces=torch.arange(len(index)).reshape(-1, 3), colors=colors)


def random_slivers(count: int, seed: int, camera: Camera) -> Mesh:
    """Return long thin triangles that overlap heavily in the view of `camera`.

    They are half to nine tenths of the image long and 1 to 3 % of it wide. Each has its own depth, so that no two meet, and a
    random colour.
    """
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


def smooth_colors(points: Tensor) -> Tensor:
    """Return colours (V, 3) in (0, 1) that vary slowly with the position (V, 3)."""
    directions = torch.tensor([[2.1, 0.7, -1.3], [-0.9, 2.3, 1.1], [1.7, -1.9, 0.6]], dtype=points.dtype)
    return 0.5 + 0.4 * torch.sin(points @ directions + torch.tensor([0.3, 1.1, 2.0], dtype=points.dtype))


def smooth_adjoint(height: int, width: int, channels: int) -> Tensor:
    """Return a smooth adjoint image (H, W, C) of both signs without symmetry, float64."""
    y = torch.linspace(0.0, 1.0, height, dtype=torch.float64)[:, None, None]
    x = torch.linspace(0.0, 1.0, width, dtype=torch.float64)[None, :, None]
    c = torch.arange(channels, dtype=torch.float64)
    return torch.sin(5.0 * x + (2.0 + c) * y + c) + 0.5 * torch.cos(3.0 * y * (1.0 + 0.4 * c) - 2.0 * x) + 0.2


def noise_adjoint(height: int, width: int, channels: int) -> Tensor:
    """Return white noise (H, W, C), float64, as the adjoint of an L1 loss or of a noisy photograph near the optimum."""
    return torch.randn((height, width, channels), dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def background() -> Tensor:
    """Return the background (3,) of all scenes, float64."""
    return torch.tensor(BACKGROUND, dtype=torch.float64)


# -- the scenes, float64: (title, scene, camera) of a size in pixels --------------------------------------------------

Built = tuple[str, Scene, Camera]


def _triangle(size: int) -> Built:
    return "one large triangle", one_triangle(), front_camera(size)


def _sphere(size: int, subdivisions: int = 6) -> Built:
    mesh = icosphere(subdivisions)
    camera = Camera.look_at((0.9, 0.7, 3.2), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, (size, size))
    title = f"sphere of {len(mesh.faces):,} faces, smooth colours"
    return title, Scene([mesh], background()), camera


def _tangled(size: int, noise: float = 0.03, subdivisions: int = 5) -> Built:
    """Return a sphere like one in the first steps of a shape fit: normal noise, a share of the radius, moves each vertex."""
    title, scene, camera = _sphere(size, subdivisions)
    (mesh,) = scene.meshes
    shift = torch.randn(mesh.verts.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    title = f"tangled sphere of {len(mesh.faces):,} faces, {100 * noise:g} % noise"
    return title, scene.replace(meshes=[mesh.replace(verts=mesh.verts + noise * shift)]), camera


def _flat_colors(size: int, subdivisions: int = 6) -> Built:
    _, scene, camera = _sphere(size, subdivisions)
    (mesh,) = scene.meshes
    colors = torch.rand((len(mesh.faces), 3), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    title = f"sphere of {len(mesh.faces):,} faces, a colour each"
    return title, scene.replace(meshes=[mesh.replace(colors=None, face_colors=colors)]), camera


def _noise(size: int, subdivisions: int = 6) -> Built:
    title, scene, camera = _sphere(size, subdivisions)
    return f"{title}, adjoint of white noise", scene, camera


def _slivers(size: int) -> Built:
    camera = front_camera(size)
    return "100 random slivers", Scene([random_slivers(100, 0, camera)], background()), camera


def _globe(size: int, rows: int = 128) -> Built:
    """Return a sphere by latitude and longitude, with copies of vertices along the seam of its texture, as in files."""
    columns = 2 * rows
    latitude = math.pi * torch.arange(rows + 1, dtype=torch.float64) / rows
    longitude = 2.0 * math.pi * torch.arange(columns + 1, dtype=torch.float64) / columns
    longitude[-1] = 0.0  # copies have the same position, to the last bit
    ring, pole = latitude.sin()[:, None], latitude.cos()[:, None]
    ring[-1] = 0.0
    verts = torch.stack([ring * longitude.cos(), pole.expand(-1, columns + 1), -ring * longitude.sin()], -1)
    u, v = torch.arange(columns + 1).double() / columns, 1.0 - torch.arange(rows + 1).double() / rows
    uvs = torch.stack(torch.broadcast_tensors(u, v[:, None]), -1)
    index = torch.arange(verts[..., 0].numel()).reshape(rows + 1, columns + 1)
    a, b, c, d = (corner.reshape(-1) for corner in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    # A quad has two faces, at the poles one.
    faces = torch.cat([torch.stack([a, b, c], 1)[: -columns or None], torch.stack([a, c, d], 1)[columns:]])
    # The pattern goes around without a seam: whole waves in u.
    h, w = 512, 1024
    y, x = ((torch.arange(n).double() + 0.5) / n for n in (h, w))
    mesh = Mesh(
        verts.reshape(-1, 3), faces.int(), texture=pattern(x[None] * 2.0, y[:, None]),
        uvs=uvs.reshape(-1, 2), uv_faces=faces.int(),
    )  # fmt: skip
    camera = Camera.look_at((0.9, 1.1, 3.2), (0.0, 0.0, 0.0), (0.1, 1.0, 0.0), 40.0, (size, size))
    return f"globe of {len(faces):,} faces, fine texture", Scene([mesh], background()), camera


def _quad(size: int) -> Built:
    """Return a slanted quad larger than the image: its edges are out of view."""
    camera = front_camera(size)
    corners = size * torch.tensor([[-0.11, -0.17], [1.13, -0.12], [1.21, 1.14], [-0.15, 1.19]], dtype=torch.float64)
    verts = unproject(camera, corners, torch.tensor([3.6, 4.1, 4.4, 3.8], dtype=torch.float64))
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    uvs = torch.tensor([[0.02, 0.97], [0.96, 0.99], [0.98, 0.03], [0.01, 0.04]], dtype=torch.float64)
    x = (torch.arange(256).double() + 0.5) / 256
    mesh = Mesh(verts, faces, texture=pattern(x[None], x[:, None]), uvs=uvs, uv_faces=faces)
    return "textured quad that fills the picture", Scene([mesh], background()), camera


def _million(size: int) -> Built:
    return _sphere(size, subdivisions=8)


def _lit(size: int, light: Light | Mesh, title: str, subdivisions: int = 6) -> Built:
    """Return a black ellipsoid and its shadow on a plane.

    The gradient is that of the ellipsoid. That of the plane's corners, which move all of the image, would hide it. If the
    ellipsoid were lit, each of its edges would be a crease, which Mitsuba does not sample.
    """
    ball = icosphere(subdivisions)
    look = Material(base_color=torch.tensor([0.8, 0.6, 0.4], dtype=torch.float64))
    size_of, at = torch.tensor(
        [[0.5, 0.3, 0.4], [0.0, 0.0, 1.0]], dtype=torch.float64
    )  # rotating a ball would change nothing
    raised = ball.verts * size_of + at
    square = 4.0 * torch.tensor([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=torch.float64)
    plane = Mesh(square, torch.tensor([[0, 1, 2], [0, 2, 3]]), material=look)
    meshes = [Mesh(raised, ball.faces, colors=torch.zeros_like(raised)), plane]
    camera = Camera.look_at((1.2, -3.5, 2.6), (0.0, 0.0, 0.3), (0.0, 0.0, 1.0), 42.0, (size, size))
    return f"shadow of a black ellipsoid of {len(ball.faces):,} faces, {title}", Scene(meshes, lights=[light]), camera


LIGHT_AT = (0.9, -0.6, 2.4)


def _lit_point(size: int, subdivisions: int = 6) -> Built:
    return _lit(size, PointLight(torch.tensor(LIGHT_AT, dtype=torch.float64), 10.0), "point light", subdivisions)


def _lit_area(size: int, subdivisions: int = 6) -> Built:
    at, u, v = (torch.tensor(x, dtype=torch.float64) for x in (LIGHT_AT, (0.0, 0.3, 0.0), (0.4, 0.0, 0.1)))
    emitting = Material(base_color=0.0, emission=8.0, two_sided=False)
    panel = rectangle(at, u, v, material=emitting)  # u × v points down
    return _lit(size, panel, "area light", subdivisions)


def _lit_sky(size: int, subdivisions: int = 6) -> Built:
    return _lit(size, Environment(torch.ones(3, dtype=torch.float64)), "constant environment", subdivisions)


def _room(size: int, light: Mesh, at: tuple[float, float, float], title: str, subdivisions: int = 3) -> Built:
    """Return a black ellipsoid in a room with coloured walls, open towards −y. As in `_lit`, its edges are no creases."""
    ball, (x, y, z) = icosphere(subdivisions), at
    size_of, centre = torch.tensor([[0.45, 0.25, 0.35], [x, y, z]], dtype=torch.float64)
    meshes = [Mesh(ball.verts * size_of + centre, ball.faces, colors=torch.zeros_like(ball.verts))]
    white, red, green = (0.75, 0.75, 0.75), (0.7, 0.15, 0.1), (0.15, 0.6, 0.2)
    walls = [
        (white, [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]),
        (white, [[-1, 1, 0], [1, 1, 0], [1, 1, 2], [-1, 1, 2]]),
        (white, [[-1, -1, 2], [-1, 1, 2], [1, 1, 2], [1, -1, 2]]),
        (red, [[-1, -1, 0], [-1, 1, 0], [-1, 1, 2], [-1, -1, 2]]),
        (green, [[1, -1, 0], [1, -1, 2], [1, 1, 2], [1, 1, 0]]),
    ]
    for color, corners in walls:
        look = Material(base_color=torch.tensor(color, dtype=torch.float64))
        verts = torch.tensor(corners, dtype=torch.float64)
        meshes.append(Mesh(verts, torch.tensor([[0, 1, 2], [0, 2, 3]]), material=look))
    camera = Camera.look_at((0.1, -3.4, 1.1), (0.0, 0.0, 1.0), (0.0, 0.0, 1.0), 38.0, (size, size))
    return (
        f"black ellipsoid of {len(ball.faces):,} faces in a room, {title}, 2 bounces",
        Scene([*meshes, light]),
        camera,
    )


def _panel(height: float, x: float, side: float, down: bool) -> Mesh:
    corners = [[x - side, -side, height], [x - side, side, height], [x + side, side, height], [x + side, -side, height]]
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]] if down else [[0, 2, 1], [0, 3, 2]])
    look = Material(base_color=0.0, emission=torch.full((3,), 8.0, dtype=torch.float64), two_sided=False)
    return Mesh(torch.tensor(corners, dtype=torch.float64), faces, material=look)


def _bounce_down(size: int, subdivisions: int = 3) -> Built:
    return _room(size, _panel(1.95, 0.1, 0.3, True), (0.15, -0.1, 0.75), "light above", subdivisions)


def _bounce_up(size: int, subdivisions: int = 3) -> Built:
    """Return the room lit from below: all surfaces in view below the ceiling get indirect light only."""
    return _room(size, _panel(1.2, -0.45, 0.25, False), (0.3, 0.0, 0.7), "light towards the ceiling", subdivisions)


def _scan(size: int, path: Path | None) -> Built:
    if path is None:
        from edgegrad.demo import airliner

        scene, title, up = Scene([airliner()], background()), "airliner", (0.0, 0.0, 1.0)
    else:
        scene, title, up = load_scene(path), Path(path).stem, (0.0, 1.0, 0.0)
    count = sum(len(mesh.faces) for mesh in scene.meshes)
    return f"{title}, {count:,} faces", scene, framing(scene, (size, size), up=up)


def pattern(x: Tensor, y: Tensor) -> Tensor:
    """Return a repeating texture (h, w, 3), float64, of 2 to 61 waves a side, at x (1, w) and y (h, 1) from 0 to 1."""
    generator = torch.Generator().manual_seed(3)
    color = torch.zeros((*torch.broadcast_shapes(x.shape, y.shape), 3), dtype=torch.float64)
    for waves in (2, 5, 11, 23, 37, 61):
        across, down = (int(n) for n in torch.randint(-waves, waves + 1, (2,), generator=generator))
        phase = 2.0 * math.pi * torch.rand(3, dtype=torch.float64, generator=generator)
        color += torch.sin(2.0 * math.pi * (across * x + down * y)[..., None] + phase) / waves**0.4
    return 0.5 + 0.14 * color


SCENES: dict[str, Callable[..., Built]] = {
    "triangle": _triangle,
    "sphere": _sphere,
    "tangled": _tangled,
    "flat-colors": _flat_colors,
    "noise": _noise,
    "slivers": _slivers,
    "globe": _globe,
    "quad": _quad,
    "scan": _scan,
    "million": _million,
    "lit-point": _lit_point,
    "lit-area": _lit_area,
    "lit-sky": _lit_sky,
    "bounce-down": _bounce_down,
    "bounce-up": _bounce_up,
}
BOUNCED = ("bounce-down", "bounce-up")
LIT = ("lit-point", "lit-area", "lit-sky", *BOUNCED)
