"""Scenes of which plan() and profile() tell different things, and their tensors that require gradients."""

from __future__ import annotations

import torch
from scenes import cube, front_camera, icosphere, smooth_adjoint

import edgegrad as eg

F64 = torch.float64


CAMERA = front_camera(24)
KINDS = ("verts", "colors", "uvs", "texture", "background", "world_to_camera", "K")


def one_colour() -> eg.Mesh:
    box = cube()
    return box.replace(face_colors=torch.full((12, 3), 0.4, dtype=F64))


def creased() -> eg.Mesh:
    return cube().replace(face_colors=torch.linspace(0, 1, 36, dtype=F64).reshape(12, 3))


def textured() -> eg.Scene:
    """A textured quad next to a box without texture."""
    quad = torch.tensor([[-1.1, -0.9, 0.0], [0.9, -1.0, 0.1], [1.0, 0.8, 0.0], [-0.8, 1.0, 0.2]], dtype=F64)
    uvs = torch.tensor([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]], dtype=F64)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    plane = eg.Mesh(quad, faces, texture=smooth_adjoint(7, 5, 3).sigmoid(), uvs=uvs, uv_faces=faces)
    return eg.Scene([plane, cube(0.3)], torch.tensor([0.1, 0.2, 0.3], dtype=F64))


def inside() -> eg.Mesh:
    """A sphere around the camera: no edge of it is a silhouette."""
    return icosphere(2).transformed(scale=100.0)


def nowhere() -> eg.Mesh:
    return cube().transformed(t=torch.tensor([0.0, 0.0, 1e3], dtype=F64))


def requiring(scene: eg.Scene | eg.Mesh, camera: eg.Camera, kinds: tuple[str, ...]) -> tuple[eg.Scene, eg.Camera]:
    """Return the same with copies of the tensors of these kinds that require gradients."""
    scene = eg.Scene([scene]) if isinstance(scene, eg.Mesh) else scene

    def leaves(thing, *names):
        have = {name: getattr(thing, name) for name in names if getattr(thing, name) is not None}
        return thing.replace(**{name: value.clone().requires_grad_() for name, value in have.items()})

    def fields(kind):
        return ("colors", "face_colors", "corner_colors") if kind == "colors" else (kind,)

    meshes = [
        leaves(mesh, *(name for kind in kinds if kind in KINDS[:4] for name in fields(kind))) for mesh in scene.meshes
    ]
    scene = scene.replace(meshes=meshes)
    scene = leaves(scene, "background") if "background" in kinds else scene
    return scene, leaves(camera, *(kind for kind in kinds if kind in KINDS[5:]))
