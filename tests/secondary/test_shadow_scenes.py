"""Gradients of lit scenes with shadows, against central finite differences of the renderer."""

from __future__ import annotations

import pytest
import torch
from finite_differences import Estimate, estimate, right_ratio
from sampling_options import with_sampling
from shadow_scenes import CASES, Case
from torch import Tensor

import edgegrad as eg

FINE = 24  # rays a pixel, each way: all are shaded


def adjoint() -> Tensor:
    """Smooth, and of one sign."""
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
    return (1.3 + 0.9 * torch.sin(0.05 * x - 1.6) + 0.3 * torch.cos(0.11 * y)).double()[:, :, None] / 100


def loss(case: Case, theta: float, seed: int) -> float:
    scene, camera = case.at(torch.tensor(theta, dtype=torch.float64))
    scale = torch.tensor([[FINE], [FINE], [1.0]], dtype=torch.float64)
    fine = camera.replace(K=camera.K * scale, size=tuple(FINE * n for n in camera.size))
    image = eg.render(scene, fine, spp=1, seed=seed)
    h, w = camera.size
    return float((image.reshape(h, FINE, w, FINE, -1).mean((1, 3)) * adjoint()).sum())


def finite_difference(case: Case, seeds: int) -> Estimate:
    with torch.no_grad():
        return estimate(
            [(loss(case, case.step, s) - loss(case, -case.step, s)) / (2 * case.step) for s in range(seeds)]
        )


def gradient(case: Case, seeds: int) -> Estimate:
    found = []
    for seed in range(seeds):
        theta = torch.zeros((), dtype=torch.float64, requires_grad=True)
        scene, camera = case.at(theta)
        many = {"sampling": eg.Sampling(surface=30_000, edges=30_000)}
        image = eg.render(scene, camera, spp=64, seed=1000 + seed, **with_sampling(many, lights=4))
        found.append(torch.autograd.grad((image * adjoint()).sum(), theta)[0].item())
    return estimate(found)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_gradient_with_shadows(name: str) -> None:
    case = CASES[name]
    right_ratio(finite_difference(case, 8 * case.samples), gradient(case, 8 * case.samples))
