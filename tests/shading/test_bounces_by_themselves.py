"""Gradients of what shadows itself and is lit by its neighbours, as a whole: a cube under an even sky, and a cube over a floor
that is nearly a mirror, by two bounces. Samplers that look for borders of shadows from few places find them hard."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from bounce_scenes import GAUSS, SIZE, Y, adjoint, panel, under_sky
from finite_differences import Estimate, estimate, right_ratio
from room_scenes import F64, vector
from torch import Tensor

import edgegrad as eg

STEP, SEEDS = 0.05, 6
SAMPLES: dict[str, Any] = {"sampling": eg.Sampling(surface=150_000, edges=50_000)}


def moved(theta: Tensor, floor: str) -> tuple[eg.Scene, eg.Camera]:
    """The cube by θ upwards."""
    scene = under_sky()
    block, ground = scene.meshes["block"], scene.meshes["ground"]
    block = block.replace(verts=block.verts + theta * vector(*Y))
    if floor == "even sky":
        return eg.Scene([block, ground], lights=list(scene.lights)), scene.camera
    metal = eg.Material(vector(0.9), metallic=1.0, roughness=0.2)
    emitter = panel((0.3, 2.0, 0.3), (0.5, 0.5))
    return eg.Scene([block, ground.replace(face_colors=None, material=metal), emitter]), scene.camera


def loss(theta: Tensor, floor: str, spp: int, seed: int, **samples: Any) -> Tensor:
    image = eg.render(*moved(theta, floor), spp, seed, bounces=2, **samples)
    return (adjoint()[:, :, None] * image).sum() / SIZE**2


def change(floor: str, spp: int) -> Estimate:
    values = []
    with torch.no_grad():
        for seed in range(SEEDS):
            high, low = (float(loss(torch.tensor(h, dtype=F64), floor, spp, seed)) for h in (STEP, -STEP))
            values.append((high - low) / (2 * STEP))
    return estimate(values)


def mean_gradient(floor: str) -> Estimate:
    values = []
    for seed in range(SEEDS):
        slopes = []
        for at, share in GAUSS:
            theta = torch.tensor(at * STEP, dtype=F64, requires_grad=True)
            found = torch.autograd.grad(loss(theta, floor, 1, 1000 + seed, **SAMPLES), theta)
            slopes.append(share * float(found[0]))
        values.append(sum(slopes))
    return estimate(values)


@pytest.mark.slow
@pytest.mark.parametrize(("floor", "spp"), [("even sky", 1024), ("nearly a mirror", 512)])
def test_gradient_of_a_cube_that_shadows_itself(floor: str, spp: int) -> None:
    found, expected = mean_gradient(floor), change(floor, spp)
    print(found, expected)
    print(right_ratio(expected, found))
