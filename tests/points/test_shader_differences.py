"""Gradients of shaders written in PyTorch against finite differences of their images."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
import torch.utils.checkpoint
from finite_differences import Estimate, estimate, right_ratio
from scenes import front_camera, icosphere, smooth_adjoint
from shader_scenes import SIZE, bumpy, network
from torch import Tensor

import edgegrad as eg

F64 = torch.float64
Case = Callable[[Tensor], tuple[eg.Scene, eg.Camera, Callable[[eg.points.Hits], Tensor]]]


def turned(scene: eg.Scene, theta: Tensor) -> eg.Scene:
    c, s, zero, one = torch.cos(theta), torch.sin(theta), torch.zeros_like(theta), torch.ones_like(theta)
    R = torch.stack([torch.stack([c, zero, s]), torch.stack([zero, one, zero]), torch.stack([-s, zero, c])])
    return scene.transformed(R, 0.3 * theta * torch.tensor([1.0, -0.5, 0.2], dtype=F64))


NET, FEATURES = network(6), network(4)
TEXTURE = torch.rand((8, 8, 4), generator=torch.Generator().manual_seed(5), dtype=F64)
HARMONICS = torch.rand((4, 3), generator=torch.Generator().manual_seed(6), dtype=F64)


def of_position_and_view(hits: eg.points.Hits, theta: Tensor) -> Tensor:
    return NET(torch.cat([2 * hits.position, hits.view], 1))


def harmonics(hits: eg.points.Hits, theta: Tensor) -> Tensor:
    n = hits.shading_normal
    return torch.cat([torch.ones_like(n[:, :1]), n], 1) @ HARMONICS


def neural_texture(hits: eg.points.Hits, theta: Tensor) -> Tensor:
    return FEATURES(hits.sample(TEXTURE, uv=0.4 * hits.position[:, :2] + 0.5))


def flat_normals(hits: eg.points.Hits, theta: Tensor) -> Tensor:
    return 0.5 + 0.5 * hits.normal


def by_mesh(hits: eg.points.Hits, theta: Tensor) -> Tensor:
    red = torch.stack([0.9 + 0 * hits.depth, 0.2 * hits.depth, 0.1 + 0 * hits.depth], 1)
    return torch.where((hits.mesh == 0)[:, None], red, 0.5 + 0.4 * hits.shading_normal)


def checkerboard(hits: eg.points.Hits, theta: Tensor) -> Tensor:
    """Paint a checkerboard in world space."""
    cells = hits.floor(1.7 * hits.position[:, :2] + 0.6 * hits.position[:, 2:] + 0.4).sum(1, keepdim=True)
    return 0.2 + 0.6 * (cells % 2) * torch.tensor([1.0, 0.7, 0.4], dtype=F64) + 0.1 * hits.position


def disc(hits: eg.points.Hits, theta: Tensor) -> Tensor:
    """Painted on, along the view, and a ring of the same border that must not count twice."""
    s = 0.4 - (hits.position[:, :2] - 0.1).norm(dim=1)
    inside = hits.where(s, torch.tensor([0.9, 0.8, 0.7], dtype=F64), 0.3 + 0.2 * hits.position)
    return inside + hits.where(-3 * s, 0.0, 0.2)


def nearest(hits: eg.points.Hits, theta: Tensor) -> Tensor:
    return hits.sample(TEXTURE[..., :3], uv=0.4 * hits.position[:, :2] + 0.5, filter="nearest")


def step_of_itself(hits: eg.points.Hits, theta: Tensor) -> Tensor:
    return hits.where(hits.position[:, 1] - 0.4 * hits.position[:, 0] - theta, 0.8 * torch.ones(3, dtype=F64), 0.2)


def of_itself(hits: eg.points.Hits, theta: Tensor) -> Tensor:
    return torch.sigmoid((2 + theta) * hits.position + theta)


SHADERS = {
    "network": of_position_and_view,
    "harmonics": harmonics,
    "neural texture": neural_texture,
    "flat normals": flat_normals,
    "by mesh": by_mesh,
    "its own parameter": of_itself,
    "checkerboard": checkerboard,
    "disc": disc,
    "nearest texture": nearest,
    "its own step": step_of_itself,
}
STEPS = {"pose": 0.01, "focal": 0.3, "shape": 0.02}


def case(name: str, of: str) -> Case:
    other = icosphere(2)
    meshes = [bumpy(), other.replace(verts=0.6 * other.verts + 0.45)] if name == "by mesh" else [bumpy()]
    # Nothing straight on: there a few edges would come and go together.
    R = torch.linalg.matrix_exp(torch.tensor([[0, 0.3, -0.2], [-0.3, 0, 0.4], [0.2, -0.4, 0]], dtype=F64))
    scene = eg.Scene(
        [eg.Mesh(mesh.verts @ R.T, mesh.faces) for mesh in meshes], torch.tensor([0.1, 0.3, 0.6], dtype=F64)
    )
    camera = front_camera(SIZE)

    def at(theta: Tensor) -> tuple[eg.Scene, eg.Camera, Callable[[eg.points.Hits], Tensor]]:
        def shader(hits: eg.points.Hits) -> Tensor:
            return SHADERS[name](hits, theta)

        if name.startswith("its own"):
            return scene, camera, shader
        if of == "pose":
            return turned(scene, theta), camera, shader
        if of == "focal":
            K = camera.K.clone() * torch.stack([1 + theta / camera.K[0, 0]] * 2 + [torch.ones_like(theta)])[:, None]
            K = torch.cat(
                [
                    torch.stack([K[0, 0], K[0, 1], camera.K[0, 2]])[None],
                    torch.stack([K[1, 0], K[1, 1], camera.K[1, 2]])[None],
                    camera.K[2:],
                ]
            )
            return scene, camera.replace(K=K), shader
        return (
            eg.Scene(
                [m.replace(verts=m.verts * (1 + theta * torch.sin(3 * m.verts))) for m in scene.meshes],
                scene.background,
            ),
            camera,
            shader,
        )

    return at


def loss(case: Case, theta: Tensor, seed: int, spp: int, **options: object) -> Tensor:
    scene, camera, shader = case(theta)
    image = eg.render(scene, camera, spp=spp, seed=seed, shader=shader, **options)  # type: ignore[arg-type]
    return (image * smooth_adjoint(*camera.size, 3)).sum()


FINER = 24


def differences(case: Case, step: float, seeds: int) -> Estimate:
    """Return differences of images whose samples are the pixels of a finer one: each asks the shader, not one for all on a
    face."""

    def fine_loss(theta: float, seed: int) -> float:
        scene, camera, shader = case(torch.tensor(theta, dtype=F64))
        K = torch.cat([FINER * camera.K[:2], camera.K[2:]])
        fine = camera.replace(K=K, size=(FINER * SIZE, FINER * SIZE))
        image = eg.render(scene, fine, spp=1, seed=seed, shader=shader).movedim(-1, 0)
        image = torch.nn.functional.avg_pool2d(image, FINER).movedim(0, -1)
        return float((image * smooth_adjoint(SIZE, SIZE, 3)).sum())

    with torch.no_grad():
        return estimate([(fine_loss(step, seed) - fine_loss(-step, seed)) / (2 * step) for seed in range(seeds)])


def derivative(case: Case, seeds: int) -> Estimate:
    values = []
    for seed in range(seeds):
        theta = torch.zeros((), dtype=F64, requires_grad=True)
        value = loss(
            case, theta, 1000 + seed, 16, sampling=eg.Sampling(surface=60000, edges=60000, discontinuity_spacing=1 / 16)
        )
        values.append(torch.autograd.grad(value, theta)[0].item())
    return estimate(values)


def check(name: str, of: str, seeds: int) -> None:
    own, stepped = name.startswith("its own"), name in ("checkerboard", "disc", "nearest texture", "its own step")
    step = STEPS["pose" if own else of]
    if stepped and of == "shape":  # borders move much: the second-order error is larger still
        # Of nearest texels less so, and noise is more.
        step, seeds = step / (2 if name == "nearest texture" else 4), 4 * seeds
    at = case(name, of)
    right_ratio(differences(at, step, seeds), derivative(at, 24 if stepped else 6))


def test_flat_normals_against_finite_differences():
    check("flat normals", "pose", 8)


@pytest.mark.slow
@pytest.mark.parametrize("of", STEPS)
@pytest.mark.parametrize("name", SHADERS)
def test_all_against_finite_differences(name: str, of: str):
    check(name, of, 60 if of == "shape" else 40)  # whose step is short, for its second-order error is large


def test_creases_are_found_where_the_shader_jumps():
    """Most of the gradient of flat normals is at creases. A shader that makes its own of positions says so by True."""
    at = case("flat normals", "pose")
    full = derivative(at, 2)

    def own(theta: Tensor) -> tuple[eg.Scene, eg.Camera, Callable[[eg.points.Hits], Tensor]]:
        scene, camera, _ = at(theta)
        faces = scene.meshes[0].faces

        def shader(hits: eg.points.Hits) -> Tensor:
            corner = scene.meshes[0].verts[faces][hits._face]
            normal = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
            return 0.5 + 0.5 * torch.nn.functional.normalize(normal, dim=-1)

        return scene, camera, shader

    def found(creases: bool | str) -> float:
        theta = torch.zeros((), dtype=F64, requires_grad=True)
        options = {"sampling": eg.Sampling(surface=60000, edges=60000, creases=creases)}
        return torch.autograd.grad(loss(own, theta, 7, 16, **options), theta)[0].item()

    assert abs(found(True) - full.mean) < 0.03 * abs(full.mean)
    assert abs(found("auto") - full.mean) > 0.05 * abs(full.mean)
