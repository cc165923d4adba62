"""Scale and place: any unit, far from the origin, near and far from the camera, small next to large."""

from __future__ import annotations

import math

import torch
from oracles.exact import exact_image
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.camera.poses import rotation
from edgegrad.scene.mesh import Mesh
from edgegrad.scene.scene import Scene

from ...scenes import background, cube, front_camera, icosphere, smooth_colors
from .case import F64, Group, Parts, Problem, View, camera_parts, everything, in_view

group = Group("scale and place")


def tilted_cube(half: float = 0.5) -> Mesh:
    return cube(half).transformed(rotation(torch.tensor([0.29, 0.36, 0.38], dtype=F64)))


def moved(camera: Camera, scale: float = 1.0, by: Tensor | None = None) -> Camera:
    """Return the camera after the world around it was scaled and then moved."""
    M = camera.world_to_camera.clone()
    M[:3, 3] *= scale
    if by is not None:
        M[:3, 3] -= M[:3, :3] @ by
    return camera.replace(world_to_camera=M)


def single(scene: Scene) -> Scene:
    """Return the scene in float32, as users have it."""
    return scene.to(torch.float32)


@group.add("scale-1e-30", "a cube of 1e-30 units, float32", 1e-30)
@group.add("scale-1e-6", "a cube of 1e-6 units, float32", 1e-6)
@group.add("scale-1e-3", "a cube of 1e-3 units, float32", 1e-3)
@group.add("scale-1e3", "a cube of 1e3 units, float32", 1e3)
@group.add("scale-1e6", "a cube of 1e6 units, float32", 1e6)
@group.add("scale-1e30", "a cube of 1e30 units, float32", 1e30)
def scaled(unit: float) -> Problem:
    scene = single(Scene([tilted_cube().transformed(scale=unit)], background()))
    return everything(scene, moved(front_camera(48), unit), zero=0.0)


@group.add("offset-1e3", "1e3 times its size from the origin, float32", 1e3, torch.float32)
@group.add("offset-1e6", "1e6 times its size from the origin, float64", 1e6, torch.float64)
def offset(distance: float, dtype: torch.dtype) -> Problem:
    far = distance * torch.tensor([0.36, -0.48, 0.8], dtype=F64)
    scene = Scene([tilted_cube().transformed(t=far)], background()).to(dtype)
    return everything(scene, moved(front_camera(48), by=far))


@group.add("near-corner", "the camera 1e-3 of its size before a cube's corner")
def near_corner() -> Problem:
    mesh = cube(0.5)
    colors = smooth_colors(mesh.verts[mesh.faces].mean(1) * 3.0)
    mesh = Mesh(mesh.verts, mesh.faces, face_colors=colors)
    corner = torch.tensor([0.5, 0.5, 0.5], dtype=F64)
    eye, target = corner * (1.0 + 2e-3 / 3**0.5), corner * 0.999 + torch.tensor([2e-4, -1e-4, 0.0])
    camera = Camera.look_at(eye, target, (0.1, 1.0, 0.0), 50.0, (48, 48))
    return everything(single(Scene([mesh], background())), camera)


@group.add("near-edge", "the camera 1e-3 of its size above a cube's edge; most of the cube lies behind it")
def near_edge() -> Problem:
    eye = torch.tensor([0.4992, 0.501, 0.1], dtype=F64)
    camera = Camera.look_at(eye, eye + torch.tensor([0.5, -0.55, -0.7]), (0.1, 1.0, 0.0), 60.0, (48, 48))
    return everything(single(Scene([cube(0.5)], background())), camera)


@group.add("far", "a cube and a camera 1e5 times its size away")
def far() -> Problem:
    distance = 1e5
    eye = distance * torch.nn.functional.normalize(torch.tensor([0.5, 0.4, 0.77], dtype=F64), dim=0)
    fov = 2.0 * math.degrees(math.atan(1.3 / distance))
    camera = Camera.look_at(eye, torch.zeros(3, dtype=F64), torch.tensor([0.2, 1.0, 0.1], dtype=F64), fov, (48, 48))
    return everything(single(Scene([tilted_cube()], background())), camera)


@group.add("mixed", "a cube of 1e-4 units that stands on a ground plane of 1e4, float32")
def mixed() -> Problem:
    """The cube slides and grows on the plane: where it would sink into it the gradient is another one."""
    size = 1e-4
    ground = torch.tensor([[-5e3, 0.0, -5e3], [5e3, 0.0, -4.8e3], [-3e2, 0.0, 7e3]], dtype=F64)
    plane = Mesh(ground, torch.tensor([[0, 2, 1]]), face_colors=torch.tensor([[0.3, 0.6, 0.2]], dtype=F64))
    turn = rotation(torch.tensor([0.0, 0.5, 0.0], dtype=F64))
    standing = cube(0.5).transformed(turn, torch.tensor([0.0, 0.5, 0.0], dtype=F64))
    plane, standing = plane.to(torch.float32), standing.to(torch.float32)
    eye = size * torch.tensor([1.4, 1.7, 3.3], dtype=F64)
    camera = Camera.look_at(eye, size * torch.tensor([0.05, 0.5, 0.0]), (0.25, 1.0, 0.0), 50.0, (48, 48))
    view, look = camera_parts(camera.to(F64))
    assert standing.colors is not None and plane.face_colors is not None
    parts = {
        "slide": torch.zeros(2), "size": torch.tensor([size]), "colours of the cube": standing.colors,
        "colour of the plane": plane.face_colors, "background": background().float(), **view,
    }  # fmt: skip

    def make(parts: Parts) -> View:
        x, z = parts["slide"]
        shift = torch.stack([x, torch.zeros_like(x), z])
        box = standing.transformed(t=shift, scale=parts["size"]).replace(colors=parts["colours of the cube"])
        return Scene([plane.replace(face_colors=parts["colour of the plane"]), box], parts["background"]), look(parts)

    return Problem(parts, make, lambda parts: exact_image(in_view((view := make(parts))[0], view[1]), view[1]))


FLOAT_FRAME = "both share one frame of floats, which are too coarse for either"


@group.add("two-details", "two spheres of 5,120 faces, 1.5e4 times their size apart", 2e4, slow=True)
@group.add(
    "two-details-far",
    "two spheres of 5,120 faces, 1.5e5 times their size apart",
    2e5,
    limit=FLOAT_FRAME,
    most=0.5,
    slow=True,
)
def two_details(distance: float) -> Problem:
    near = icosphere(4).transformed(scale=0.7)
    other = icosphere(4).transformed(t=distance * torch.tensor([0.94, 0.19, -0.28], dtype=F64))  # out of view
    return everything(
        Scene([near, other], background()), front_camera(48), camera_too=False,
        equal=lambda scene: scene.replace(meshes=scene.meshes[:1]),
    )  # fmt: skip
