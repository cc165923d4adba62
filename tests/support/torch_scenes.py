"""Small scenes, their gradients and leaves, for tests of render() among other torch operations."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from scenes import cube, front_camera, icosphere, one_triangle, smooth_adjoint, smooth_colors
from torch import Tensor

import edgegrad as eg

F32, F64 = torch.float32, torch.float64
SIZE = 20
TRIANGLE = one_triangle()
MESH, BACKGROUND = TRIANGLE.meshes[0], TRIANGLE.background
CAMERA = front_camera(SIZE)
OTHER = eg.Camera.look_at((-1.2, 0.6, 3.0), (0.0, 0.0, 0.0), fov_y=40.0, size=(SIZE, SIZE)).to(F64)
ADJOINT = smooth_adjoint(SIZE, SIZE, 3)


def mixed_scene() -> eg.Scene:
    """Smooth colours, creases, a texture, and a background image; the meshes hide one another in part."""
    sphere = icosphere(2).transformed(scale=0.7)
    box = cube(0.5).transformed(t=torch.tensor([0.7, -0.4, 0.3], dtype=F64))
    box = box.replace(face_colors=smooth_colors(3.0 * box.verts[box.faces].mean(1)))
    quad = torch.tensor([[-1.1, -0.9, -0.6], [0.9, -1.05, -0.4], [1.05, 0.8, -0.5], [-0.8, 1.0, -0.7]], dtype=F64)
    plane = eg.Mesh(
        quad,
        torch.tensor([[0, 1, 2], [0, 2, 3]]),
        texture=ADJOINT[:7, :5].sigmoid(),
        uvs=torch.tensor([[0.1, 0.05], [0.9, 0.1], [0.95, 0.9], [0.0, 0.85], [0.3, 0.3]], dtype=F64),
        uv_faces=torch.tensor([[0, 1, 2], [4, 2, 3]]),
    )
    return eg.Scene([sphere, box, plane], ADJOINT.sigmoid())


def with_leaves(scene: eg.Scene, camera: eg.Camera) -> tuple[eg.Scene, eg.Camera, list[Tensor]]:
    """Return the same, with leaves of their own that require gradients."""
    leaves = []

    def leaf(tensor: Tensor) -> Tensor:
        leaves.append(tensor.detach().clone().requires_grad_())
        return leaves[-1]

    meshes = []
    for mesh in scene.meshes:
        floats = {
            name: value for name, value in vars(mesh).items() if isinstance(value, Tensor) and value.is_floating_point()
        }
        meshes.append(mesh.replace(**{name: leaf(value) for name, value in floats.items()}))
    background = None if scene.background is None else leaf(scene.background)
    camera = camera.replace(world_to_camera=leaf(camera.world_to_camera), K=leaf(camera.K))
    return eg.Scene(meshes, background), camera, leaves


def image_and_gradients(scene: eg.Scene, camera: eg.Camera, **options) -> list[Tensor]:
    """The image, and the gradient of one loss of it in every floating-point tensor of scene and camera."""
    scene, camera, leaves = with_leaves(scene, camera)
    image = eg.render(scene, camera, **{"spp": 4, "seed": 0, **options})
    return [image.detach(), *gradients(image, leaves)]


def gradients(image: Tensor, leaves: Sequence[Tensor], adjoint: Tensor | None = None) -> list[Tensor]:
    if adjoint is None:
        adjoint = smooth_adjoint(*image.shape[-3:]).to(image).expand_as(image)
    return list(torch.autograd.grad(image, leaves, adjoint))


def same_bits(a: Sequence[Tensor], b: Sequence[Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def leaf(tensor: Tensor) -> Tensor:
    return tensor.detach().clone().requires_grad_()
