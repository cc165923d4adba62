"""The kernel against exact pixel integrals: image and gradients within their statistical error, and the error falls with the
number of samples as the theory says. The oracle (tests/oracles/exact.py) has no sampling error.

The statistical error is measured, not assumed: S estimates with seeds of their own give a mean and its standard error for
each component, and z = (mean − exact) / standard error follows Student's t with S − 1 degrees of freedom if there is no bias.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import pytest
import torch
from oracles.exact import exact_image
from scenes import front_camera, icosphere, occluded_triangle, one_triangle, random_slivers, smooth_adjoint
from torch import Tensor

import edgegrad as eg

pytestmark = pytest.mark.quick

SIZE = 64
SEEDS = 16
BACKGROUND = torch.tensor([0.15, 0.25, 0.4], dtype=torch.float64)
SCENES = {
    "triangle": one_triangle,
    "occluded triangle": occluded_triangle,
    "sphere": lambda: eg.Scene([icosphere(3)], BACKGROUND),
    "slivers": lambda: eg.Scene([random_slivers(100, 0, front_camera(SIZE))], BACKGROUND),
}
# The slivers are laid out for the perspective camera.
CASES = [
    pytest.param(name, p, marks=[pytest.mark.slow] if (name, p) == ("sphere", "orthographic") else [])
    for name in SCENES
    for p in ("perspective", "orthographic")
    if (name, p) != ("slivers", "orthographic")
]
Render = Callable[[eg.Scene, eg.Camera], Tensor]


def gradients(scene: eg.Scene, camera: eg.Camera, render: Render) -> dict[str, Tensor]:
    """Gradient of image · adjoint for all that may require one. K's last row is fixed, so it is left out."""
    leaves: dict[str, Tensor] = {}

    def leaf(name: str, value: Tensor) -> Tensor:
        return leaves.setdefault(name, value.detach().clone().requires_grad_())

    meshes = []
    for i, mesh in enumerate(scene.meshes):
        kind = "colors" if mesh.colors is not None else "face_colors"
        colors = {kind: leaf(f"colors {i}", getattr(mesh, kind))}
        meshes.append(mesh.replace(verts=leaf(f"verts {i}", mesh.verts), **colors))
    scene = eg.Scene(meshes, leaf("background", scene.background))
    camera = camera.replace(world_to_camera=leaf("world_to_camera", camera.world_to_camera), K=leaf("K", camera.K))
    loss = (render(scene, camera) * smooth_adjoint(*camera.size, 3)).sum()
    grads = dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values())), strict=True))
    grads["K"] = grads["K"][:2]
    return grads


def mean_z2(samples: list[Tensor], exact: Tensor) -> float:
    """Mean over the components of ((mean − exact) / standard error)²."""
    x = torch.stack(samples).reshape(len(samples), -1)
    deviation, error = x.mean(0) - exact.reshape(-1), x.std(0) / math.sqrt(len(samples))
    varies = error > 0
    assert (deviation[~varies] == 0).all()
    return (deviation[varies] / error[varies]).square().mean().item()


@pytest.mark.parametrize(
    ("name", "projection"),
    [pytest.param(*case.values, marks=pytest.mark.slow) if "slivers" in case.values else case for case in CASES],
)
def test_image(name: str, projection: str) -> None:
    scene, camera = SCENES[name](), front_camera(SIZE, projection)
    exact = exact_image(scene, camera)
    # 64 random combinations of all pixels: each is a sum of many independent errors, and they are nearly independent.
    signs = torch.randn((64, exact.numel()), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    errors = {}
    for spp in (4, 16, 64):
        images = [eg.render(scene, camera, spp=spp, seed=seed) for seed in range(SEEDS)]
        # The mean of 64 squares of t₁₅ is 1.15 ± 0.23; 4 standard deviations are allowed. A bias of one standard
        # deviation of a single image would give 17.
        assert mean_z2([signs @ image.reshape(-1) for image in images], signs @ exact.reshape(-1)) < 2.1
        errors[spp] = torch.stack([(image - exact).square().mean() for image in images]).mean().sqrt().item()
    # A lattice falls like 1/n^(3/4) at edges in each pixel; of 8; 1/√n would be one of 4, and 5.5 tells them apart.
    assert errors[4] / errors[64] > 5.5, errors


@pytest.mark.parametrize(("name", "projection"), CASES)
def test_gradients(name: str, projection: str) -> None:
    scene, camera = SCENES[name](), front_camera(SIZE, projection)
    exact = gradients(scene, camera, exact_image)
    previous: dict[str, float] = {}
    for surface, edge in ((4_000, 2_000), (16_000, 8_000)):
        samples: dict[str, list[Tensor]] = {key: [] for key in exact}
        for seed in range(SEEDS):
            options = {"spp": 16, "seed": seed, "sampling": eg.Sampling(surface=surface, edges=edge)}
            got = gradients(scene, camera, partial(eg.render, **options))
            for key, value in got.items():
                samples[key].append(value)
        for key, values in samples.items():
            # All components hang on the few random shifts of one estimate, so they count as a single one: 16.6 is the
            # 99.9 % quantile of the square of t₁₅. A bias of one standard deviation of an estimate would give 17.
            assert mean_z2(values, exact[key]) < 16.6, (key, surface)
            square = (torch.stack(values) - exact[key]).square().sum().item() / SEEDS
            error = math.sqrt(square) / exact[key].norm().item()
            if key in previous and key != "background":  # the background's error is that of the image
                assert error < 0.6 * previous[key], (key, surface, error, previous[key])
            previous[key] = error


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name != "occluded triangle" else name for name in SCENES]
)
def test_boundary_error_falls_like_one_over_n(name: str) -> None:
    scene, camera = SCENES[name](), front_camera(SIZE)

    def verts_gradient(edge: int, seed: int, visibility: bool = True, surface: int = 64) -> Tensor:
        options = {"sampling": eg.Sampling(seed=seed, surface=surface, edges=edge), "visibility": visibility}
        grads = gradients(scene, camera, partial(eg.render, spp=1, seed=0, **options))
        return torch.cat([g for key, g in grads.items() if key.startswith("verts")])

    # With the same seed the interior part has the same bits with and without the boundary term: the difference is the
    # boundary term. Its exact value is the exact gradient less an interior part whose own error is below 10⁻⁴ of it.
    exact = gradients(scene, camera, exact_image)
    whole = torch.cat([g for key, g in exact.items() if key.startswith("verts")])
    interior = torch.stack([verts_gradient(64, 70 + s, False, 2_000_000) for s in range(4)]).mean(0)
    boundary = whole - interior

    counts = [1_000, 4_000, 16_000] if name != "slivers" else [16_000, 64_000, 256_000]
    errors = []
    for n in counts:
        e2 = [(verts_gradient(n, s) - verts_gradient(n, s, False) - boundary).square().sum() for s in range(8)]
        errors.append((torch.stack(e2).mean().sqrt() / whole.norm()).item())
    x, y = torch.tensor(counts).double().log(), torch.tensor(errors).double().log()
    slope = ((x - x.mean()) * (y - y.mean())).sum() / (x - x.mean()).square().sum()
    assert slope <= -0.9, (slope, dict(zip(counts, errors, strict=True)))


def test_a_wrong_gradient_is_rejected() -> None:
    """The interior alone, and an answer off by one standard error of a single estimate, fail the test of z²."""
    scene, camera = one_triangle(), front_camera(SIZE)
    exact = gradients(scene, camera, exact_image)["verts 0"]
    samples = [
        gradients(
            scene, camera, lambda s, c, seed=seed: eg.render(s, c, spp=1, sampling=eg.Sampling(seed=seed), seed=0)
        )["verts 0"]
        for seed in range(SEEDS)
    ]
    assert mean_z2(samples, exact) < 3
    assert mean_z2([s + torch.stack(samples).std(0) for s in samples], exact) > 10
    interior = [
        gradients(
            scene,
            camera,
            lambda s, c, seed=seed: eg.render(s, c, spp=1, sampling=eg.Sampling(seed=seed), visibility=False, seed=0),
        )["verts 0"]
        for seed in range(SEEDS)
    ]
    assert mean_z2(interior, exact) > 100
