"""Gradients of everything that may require one, against central finite differences of the forward renderer."""

from __future__ import annotations

import pytest
import torch
from finite_differences import Estimate, check, finite_difference, gradient, rotation
from scenes import cube, front_camera, smooth_colors
from torch import Tensor

import edgegrad as eg

SIZE = 40
AXIS = (0.48, 0.6, 0.64)


def mixed_meshes() -> dict[str, eg.Mesh]:
    """One mesh for each kind of colour; they hide one another in part."""
    f64 = torch.float64
    quad = torch.tensor([[-1.1, -0.9, -0.6], [0.9, -1.05, -0.4], [1.05, 0.8, -0.5], [-0.8, 1.0, -0.7]], dtype=f64)
    yy, xx = torch.meshgrid(torch.arange(6, dtype=f64), torch.arange(5, dtype=f64), indexing="ij")
    texture = torch.stack([0.5 + 0.4 * torch.sin(xx + k) * torch.cos(1.3 * yy + k) for k in range(3)], -1)
    tetrahedron = torch.tensor([[0.0, 0.5, 0.55], [-0.5, -0.3, 0.4], [0.45, -0.35, 0.5], [0.05, 0.0, 0.95]], dtype=f64)
    fan = torch.tensor([[0.55, 0.3, 0.3], [1.0, 0.2, 0.2], [0.95, 0.75, 0.35], [0.45, 0.85, 0.25]], dtype=f64)
    turn = rotation(AXIS, torch.tensor(0.7, dtype=f64))
    corners = smooth_colors(torch.arange(18, dtype=f64).reshape(6, 3)).reshape(2, 3, 3)
    return {
        "texture": eg.Mesh(quad, torch.tensor([[0, 1, 2], [0, 2, 3]]), texture=texture,
                           uvs=torch.tensor([[0.1, 0.05], [0.9, 0.1], [0.95, 0.9], [0.0, 0.85], [0.3, 0.3]], dtype=f64),
                           uv_faces=torch.tensor([[0, 1, 2], [4, 2, 3]])),  # a seam between the two faces
        "face_colors": eg.Mesh(tetrahedron, torch.tensor([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]),
                               face_colors=smooth_colors(3.0 * tetrahedron)),
        "corner_colors": eg.Mesh(fan, torch.tensor([[0, 1, 2], [0, 2, 3]]), corner_colors=corners),
        "colors": cube(0.22).transformed(turn, torch.tensor([-0.6, 0.55, 0.5], dtype=f64)),
    }  # fmt: skip


def background_image() -> Tensor:
    """Smooth, so that a step of half a pixel sees no other background than the derivative does."""
    y, x = torch.meshgrid(
        torch.arange(SIZE, dtype=torch.float64), torch.arange(SIZE, dtype=torch.float64), indexing="ij"
    )
    return smooth_colors(torch.stack([x, y, x - y], -1).reshape(-1, 3) * (2.0 / SIZE)).reshape(SIZE, SIZE, 3)


def build(meshes: dict[str, eg.Mesh] | None = None, background: Tensor | None = None) -> eg.Scene:
    meshes = mixed_meshes() if meshes is None else meshes
    return eg.Scene(list(meshes.values()), background_image() if background is None else background)


def camera_of(view: str) -> eg.Camera:
    if view == "crop":
        return front_camera(2 * SIZE, "perspective").crop(top=22, left=17, height=SIZE, width=SIZE)
    return front_camera(SIZE, view)


def moved_camera(camera: eg.Camera, R: Tensor | None = None, t: Tensor | None = None) -> eg.Camera:
    """The camera with its coordinates turned by R and shifted by t."""
    M = torch.eye(4, dtype=torch.float64)
    if R is not None:
        M = torch.block_diag(R, torch.ones(1, 1, dtype=torch.float64))
    if t is not None:
        M = M + torch.nn.functional.pad(t[:, None], (3, 0, 0, 1))
    return camera.replace(world_to_camera=M @ camera.world_to_camera)


def vertex(theta: Tensor, camera: eg.Camera):
    meshes = mixed_meshes()
    mesh = meshes["face_colors"]
    move = torch.zeros_like(mesh.verts)
    move[1] = torch.tensor([-0.7, -0.6, 0.4])
    return build({**meshes, "face_colors": mesh.replace(verts=mesh.verts + theta * move)}), camera


def translation(theta: Tensor, camera: eg.Camera):
    meshes = mixed_meshes()
    t = theta * torch.tensor([0.8, -0.5, 0.33], dtype=torch.float64)
    return build({**meshes, "colors": meshes["colors"].transformed(t=t)}), camera


def translation_of_texture(theta: Tensor, camera: eg.Camera):
    meshes = mixed_meshes()
    t = theta * torch.tensor([0.6, 0.7, 0.4], dtype=torch.float64)
    return build({**meshes, "texture": meshes["texture"].transformed(t=t)}), camera


def rotation_of_mesh(theta: Tensor, camera: eg.Camera):
    meshes = mixed_meshes()
    R = rotation(AXIS, theta)
    return build({k: m if k == "texture" else m.transformed(R) for k, m in meshes.items()}), camera


def scale(theta: Tensor, camera: eg.Camera):
    return build().transformed(scale=1 + theta), camera


def camera_translation(theta: Tensor, camera: eg.Camera):
    return build(), moved_camera(camera, t=theta * torch.tensor([0.5, 0.7, -0.4], dtype=torch.float64))


def camera_rotation(theta: Tensor, camera: eg.Camera):
    return build(), moved_camera(camera, R=rotation(AXIS, theta))


def focal_length(theta: Tensor, camera: eg.Camera):
    return build(), camera.replace(
        K=camera.K * (1 + theta * torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 0]], dtype=torch.float64))
    )


def principal_point(theta: Tensor, camera: eg.Camera):
    return build(), camera.replace(
        K=camera.K + theta * torch.tensor([[0, 0, 0.8], [0, 0, -0.6], [0, 0, 0]], dtype=torch.float64)
    )


def skew(theta: Tensor, camera: eg.Camera):
    return build(), camera.replace(
        K=camera.K + theta * torch.tensor([[0, 1.0, 0], [0, 0, 0], [0, 0, 0]], dtype=torch.float64)
    )


def appearance(kind: str):
    def case(theta: Tensor, camera: eg.Camera):
        meshes = mixed_meshes()
        mesh = meshes[kind]
        value = getattr(mesh, kind)
        direction = torch.cos(torch.arange(value.numel(), dtype=torch.float64)).reshape(value.shape) + 0.3
        keep = {"uvs": mesh.uvs, "uv_faces": mesh.uv_faces} if kind == "texture" else {}
        return build({**meshes, kind: mesh.replace(**{kind: value + theta * direction}, **keep)}), camera

    return case


def uvs(theta: Tensor, camera: eg.Camera):
    meshes = mixed_meshes()
    mesh = meshes["texture"]
    direction = torch.tensor([[1.0, 0.3], [-0.4, 0.8], [0.6, -0.7], [0.2, 0.5], [-0.3, 0.9]], dtype=torch.float64)
    return build({**meshes, "texture": mesh.replace(uvs=mesh.uvs + theta * direction)}), camera


def background(theta: Tensor, camera: eg.Camera):
    direction = torch.cos(torch.arange(SIZE * SIZE * 3, dtype=torch.float64)).reshape(SIZE, SIZE, 3) + 0.3
    return build(background=background_image() + theta * direction), camera


def constant_background(theta: Tensor, camera: eg.Camera):
    return build(background=torch.tensor([0.2, 0.3, 0.4], dtype=torch.float64) + theta), camera


# Steps: what is geometry moves by about an eighth of a pixel at most; what is linear may move far.
CASES = {
    "vertex": (vertex, 0.01),
    "translation": (translation, 0.008),
    "translation of a textured mesh": (translation_of_texture, 0.008),
    "rotation": (rotation_of_mesh, 0.008),
    "scale": (scale, 0.006),
    "camera translation": (camera_translation, 0.006),
    "camera rotation": (camera_rotation, 0.0015),
    "focal length": (focal_length, 0.004),
    "principal point": (principal_point, 0.1),
    "skew": (skew, 0.3),
    "vertex colours": (appearance("colors"), 0.5),
    "face colours": (appearance("face_colors"), 0.5),
    "corner colours": (appearance("corner_colors"), 0.5),
    "texture": (appearance("texture"), 0.5),
    "texture coordinates": (uvs, 0.002),  # the loss bends: 0.01 is off by half of it in one of the cases, 0.005 by 12 %
    "background image": (background, 0.5),
    "background colour": (constant_background, 0.5),
}
VIEWS = [
    ("perspective", "box"),
    ("orthographic", "box"),
    ("crop", "box"),
    ("perspective", "tent"),
    ("crop", "gaussian"),
]


@pytest.mark.parametrize(("view", "filter"), VIEWS)
@pytest.mark.parametrize("name", CASES)
def test_gradient_is_the_derivative_of_the_image(name: str, view: str, filter: str) -> None:
    case, step = CASES[name]
    camera = camera_of(view)
    check(lambda theta: case(theta, camera), step, spp=1024, filter=filter, surface_samples=40_000, edge_samples=40_000)


@pytest.mark.slow
@pytest.mark.parametrize("filter", ["box", "tent", "gaussian"])
@pytest.mark.parametrize("view", ["perspective", "orthographic", "crop"])
@pytest.mark.parametrize("name", CASES)
def test_gradient_is_the_derivative_of_the_image_in_every_combination(name: str, view: str, filter: str) -> None:
    case, step = CASES[name]
    camera = camera_of(view)
    check(
        lambda theta: case(theta, camera),
        step,
        spp=512,
        seeds=16,
        filter=filter,
        surface_samples=100_000,
        edge_samples=100_000,
    )


def test_the_check_rejects_a_wrong_gradient() -> None:
    """Without the boundary term the gradient of a translation is wrong, and so is one that is 10 % off."""
    camera = camera_of("perspective")
    with pytest.raises(AssertionError, match="ratio"):
        check(lambda theta: translation(theta, camera), 0.03, spp=512, visibility=False)
    fd = finite_difference(lambda theta: translation(theta, camera), 0.03, 512, 4)
    g = gradient(lambda theta: translation(theta, camera), 8, surface_samples=40_000, edge_samples=40_000)
    wrong = Estimate(1.1 * g.mean, 1.1 * g.error)
    assert abs(fd.mean - wrong.mean) > 4 * (fd.error**2 + wrong.error**2) ** 0.5 + 0.01 * abs(fd.mean)
