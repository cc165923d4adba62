"""Cameras: narrow, wide, inside, on a surface, on an edge's line; images of unusual shape."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.camera.poses import rotation
from edgegrad.scene.mesh import Mesh
from edgegrad.scene.scene import Scene

from ...scenes import background, cube, front_camera, icosphere, smooth_colors
from .case import F64, Group, Problem, everything, rigid
from .scale import tilted_cube

group = Group("camera")
ORIGIN = torch.zeros(3, dtype=F64)


def vector(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=F64)


def upright(eye: Tensor, size: int = 48, focal: float = 50.0) -> Camera:
    """Return a camera at `eye` that looks along −z with y up; its axes are exactly those of the world."""
    R = torch.diag(vector(1.0, -1.0, -1.0))
    M = torch.eye(4, dtype=F64)
    M[:3, :3], M[:3, 3] = R, -R @ eye
    K = torch.tensor([[focal, 0.0, 0.5 * size], [0.0, focal, 0.5 * size], [0.0, 0.0, 1.0]], dtype=F64)
    return Camera(M, K, (size, size))


def flat(mesh: Mesh) -> Mesh:
    """Return the mesh with a colour for each face."""
    return Mesh(mesh.verts, mesh.faces, face_colors=smooth_colors(3.0 * mesh.verts[mesh.faces.long()].mean(1)))


@group.add("fov-0.05", "field of view 0.05°", 0.05)
@group.add("fov-1", "field of view 1°", 1.0)
def narrow(fov: float) -> Problem:
    distance = 1.3 / math.tan(math.radians(fov / 2))
    eye = distance * torch.nn.functional.normalize(vector(0.5, 0.4, 0.77), dim=0)
    camera = Camera.look_at(eye, ORIGIN, vector(0.2, 1.0, 0.1), fov, (48, 48))
    return everything(Scene([tilted_cube()], background()), camera)


@group.add("fov-120", "field of view 120°, the object towards the corner", 120.0, 40.0, 48)
@group.add("fov-170", "field of view 170°, the object 72° from the axis", 170.0, 72.0, 128)
def wide(fov: float, angle: float, size: int) -> Problem:
    """Let the camera look past the object by `angle` degrees."""
    eye = 1.4 * torch.nn.functional.normalize(vector(0.31, 0.23, 1.0), dim=0)
    past = rotation(vector(0.6, 0.75, -0.28) * math.radians(angle)) @ -eye
    camera = Camera.look_at(eye, eye + past, vector(0.2, 1.0, 0.1), fov, (size, size))
    return everything(Scene([tilted_cube(0.4)], background()), camera)


@group.add("off-axis", "rotated off-axis, the object at 40° from the axis and rolled")
def off_axis() -> Problem:
    eye = vector(0.0, 0.0, 3.0)
    K = torch.tensor([[60.0, 0.0, -28.0], [0.0, 60.0, 10.0], [0.0, 0.0, 1.0]], dtype=F64)
    target = vector(-3.0, -0.9, 0.1)
    camera = Camera.look_at(eye, target, vector(0.9, 0.7, 0.1), 40.0, (48, 48)).replace(K=K)
    middle = camera.project(ORIGIN) - 24.0
    return everything(Scene([tilted_cube()], background()), camera.replace(K=_principal(K, K[:2, 2] - middle)))


def _principal(K: Tensor, point: Tensor) -> Tensor:
    K = K.clone()
    K[:2, 2] = point
    return K


@group.add("inside", "inside a mesh with a colour for each face", True)
@group.add("inside-smooth", "inside a mesh with smooth colours: no curve at all", False)
def inside(creases: bool) -> Problem:
    mesh = icosphere(1)
    camera = Camera.look_at(vector(0.3, -0.2, 0.1), vector(-0.5, 0.4, -1.0), vector(0.1, 1.0, 0.0), 70.0, (48, 48))
    return everything(Scene([flat(mesh) if creases else mesh], background()), camera)


@group.add("on-surface", "the eye on a face, looking away from it")
def on_surface() -> Problem:
    """Put a quad through the eye at right angles to the view; it hides nothing."""
    camera = upright(vector(0.25, 0.125, 4.0))
    wall = vector(-1, -2, 4, 3, -2, 4, 3, 3, 4, -2, 3, 4).reshape(4, 3)
    return _with_unseen(
        Mesh(wall, torch.tensor([[0, 1, 2], [0, 2, 3]]), face_colors=torch.ones((2, 3), dtype=F64)), camera
    )


@group.add("on-vertex", "the eye on a vertex of a mesh that reaches into the view behind it")
def on_vertex() -> Problem:
    camera = upright(vector(0.25, 0.125, 4.0))
    tip = vector(0.25, 0.125, 4, -1, -1, 5, 1, -0.5, 6, 0.5, 2, 5).reshape(4, 3)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    return _with_unseen(Mesh(tip, faces, face_colors=torch.ones((4, 3), dtype=F64)), camera)


@group.add("along-surface", "the eye on a face, looking along it: it is seen end-on")
def along_surface() -> Problem:
    camera = upright(vector(0.25, -0.75, 4.0))
    floor = vector(-9, -0.75, 9, 9, -0.75, 9, 9, -0.75, -9, -9, -0.75, -9).reshape(4, 3)
    return _with_unseen(
        Mesh(floor, torch.tensor([[0, 1, 2], [0, 2, 3]]), face_colors=torch.ones((2, 3), dtype=F64)), camera
    )


@group.add("edge-on", "a quad seen exactly edge-on before a cube")
def edge_on() -> Problem:
    camera = upright(vector(0.25, 0.125, 4.0))
    quad = vector(0.25, -1, 1, 0.25, 1, 1, 0.25, 1, 2, 0.25, -1, 2).reshape(4, 3)
    return _with_unseen(
        Mesh(quad, torch.tensor([[0, 1, 2], [0, 2, 3]]), face_colors=torch.ones((2, 3), dtype=F64)), camera
    )


def _with_unseen(unseen: Mesh, camera: Camera) -> Problem:
    """Return a cube and an invisible mesh; everything but the latter is a part."""
    return everything(
        Scene([tilted_cube()], background()), camera, camera_too=False,
        shown=lambda scene: scene.replace(meshes=[*scene.meshes, unseen]),
    )  # fmt: skip


@group.add("edge-on-face", "a box one of whose faces is seen exactly edge-on")
def edge_on_face() -> Problem:
    """Only motions that keep it so: to the other sides the face turns up or stays hidden, a kink."""
    box = cube(0.6).transformed(t=vector(-0.35, 0.1, 0.0))
    eye = vector(0.25, 0.125, 4.0)
    directions = torch.eye(3, dtype=F64)[1:]
    return rigid(Scene([box], background()), upright(eye), directions=directions, centre=eye)


@group.add("along-edge", "the eye on the line of a box's edge, which is seen as a point")
def along_edge() -> Problem:
    box = cube(0.6).transformed(t=vector(-0.35, -0.475, 0.0))
    eye = vector(0.25, 0.125, 4.0)
    return rigid(Scene([box], background()), upright(eye), directions=torch.eye(3, dtype=F64)[2:], centre=eye)


@group.add("camera-plane", "edges that cross the camera plane", 1.5)
@group.add("vertex-on-plane", "edges that cross the camera plane, a vertex exactly on it", 0.0)
def camera_plane(z: float) -> Problem:
    camera = upright(ORIGIN, focal=42.0)
    verts = torch.tensor([[-1.1, -0.9, 1.5], [0.35, -0.8, z], [0.4, 0.9, -6.0]], dtype=F64)
    return everything(
        Scene([Mesh(verts, torch.tensor([[0, 1, 2]]), colors=smooth_colors(verts))], background()), camera
    )


@group.add("pixels", "non-square pixels, skewed K, principal point outside the image")
def pixels() -> Problem:
    camera = front_camera(64)
    K = torch.tensor([[55.0, 17.0, -31.0], [0.0, 118.0, 95.0], [0.0, 0.0, 1.0]], dtype=F64)
    camera = camera.replace(K=K)
    eye = camera.world_to_camera[:3, :3].T @ -camera.world_to_camera[:3, 3]
    # Turned until the object is in the middle.
    ray = torch.linalg.solve(K, vector(32.0, 32.0, 1.0))
    turn = rotation(torch.linalg.cross(vector(0, 0, 1), ray / ray.norm()))
    R = turn @ camera.world_to_camera[:3, :3]
    M = camera.world_to_camera.clone()
    M[:3, :3], M[:3, 3] = R, -R @ eye
    return everything(Scene([tilted_cube()], background()), camera.replace(world_to_camera=M))


@group.add("1x1", "an image of one pixel", (1, 1), 1.1)
@group.add("1x4096", "an image of 1 × 4096 pixels", (1, 4096), 9000.0)
@group.add("4096x1", "an image of 4096 × 1 pixels", (4096, 1), 9000.0)
def thin_image(size: tuple[int, int], focal: float) -> Problem:
    H, W = size
    K = torch.tensor([[focal, 0.0, 0.5 * W], [0.0, focal, 0.5 * H], [0.0, 0.0, 1.0]], dtype=F64)
    return everything(
        Scene([tilted_cube()], background()),
        front_camera(48).replace(K=K, size=size),
        spp=4096 if size == (1, 1) else 64,
    )


@group.add("crop", "a crop of the image")
def crop() -> Problem:
    return everything(Scene([tilted_cube()], background()), front_camera(96).crop(20, 14, 48, 48))


@group.add("orthographic", "orthographic, the object behind the camera's position")
def orthographic() -> Problem:
    camera = front_camera(48, "orthographic")
    M = camera.world_to_camera.clone()
    M[2, 3] -= 1e3
    return everything(Scene([tilted_cube()], background()), camera.replace(world_to_camera=M))
