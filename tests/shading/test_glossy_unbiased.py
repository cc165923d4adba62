"""Images and gradients of ten glossy scenes, few samples each, against references that draw no light as they do.

The image and its derivatives by materials, normals and brightness are compared with those of light_oracle.py, derivatives by what
moves with finite differences. z = (mean − reference) / standard error of both, tested by Holm's method: with a probability of 1 %
or less a run of all scenes without bias has a rejection.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from light_oracle import Ball, Oracle, around
from sampling_options import with_sampling
from scipy.stats import t as student
from torch import Tensor

import edgegrad as eg
from benchmarks.stability.cases.case import Parts, Problem
from benchmarks.stability.cases.glossy import GLOSSY, LIGHTS
from benchmarks.stability.cases.measure import Effort as Seeds
from benchmarks.stability.cases.measure import Running, differences
from benchmarks.stability.statistics import holm
from edgegrad.kernel.request import make_request
from edgegrad.shader import ShadingTraits, render_shaded

F64 = torch.float64
ALPHA = 0.01 / len(GLOSSY)
SUMS = 16  # random, of pixels
SEEDS, ORACLES, DIFFERENCES = 256, 32, 8
FEW: dict[str, Any] = {"spp": 16, "sampling": eg.Sampling(surface=1_000, edges=1_000)}
MANY: dict[str, Any] = {"spp": 64, "sampling": eg.Sampling(surface=4_000, edges=100)}
STILL = ("brightness", "base colour", "roughness", "metallic", "normals", "alpha")  # what moves nothing


Render = Callable[[eg.Scene, eg.Camera, int], Tensor]


def few(scene: eg.Scene, camera: eg.Camera, seed: int) -> Tensor:
    return eg.render(scene, camera, seed=seed, **with_sampling(FEW, lights=1))


def sky_emitters() -> list[Ball]:
    """Far away, around the middles of the lights of a sky."""
    found = []
    for row, column, _ in LIGHTS:
        polar, turn = math.pi * (row + 1) / 16, math.pi * (column + 1) / 16 - math.pi
        across = math.sin(polar)
        d = torch.tensor([across * math.sin(turn), math.cos(polar), -across * math.cos(turn)], dtype=F64)
        found.append(Ball(1e4 * d, 1e4 * math.sin(math.radians(20))))
    return found


def by_oracle(scene: eg.Scene, camera: eg.Camera, seed: int) -> Tensor:
    shining = [m for m in scene.meshes if m.material is not None and m.material.emission is not None]
    skies = any(isinstance(light, eg.lights.Environment) for light in scene.lights)
    oracle = Oracle([around(mesh) for mesh in shining] + sky_emitters() * skies, seed)
    traits = ShadingTraits(points=16, blended=scene.blends, glossy=True)
    return render_shaded(scene, camera, oracle, make_request(scene, camera, seed=seed, **MANY), "auto", False, traits)


def sums_and_gradients(problem: Problem, parts: list[str], render: Render, seed: int) -> Tensor:
    """Random sums of pixels, and the gradient of the loss by these parts."""
    leaves: Parts = {name: value.clone().requires_grad_(name in parts) for name, value in problem.parts.items()}
    image = render(*problem.make(leaves), seed).double()
    signs = torch.randn((SUMS, image.numel()), dtype=F64, generator=torch.Generator().manual_seed(0))
    wanted = [leaves[name] for name in parts]
    grads = torch.autograd.grad((image * problem.cotangent(image)).sum(), wanted, materialize_grads=True)
    return torch.cat([signs @ image.detach().reshape(-1), *(g.double().reshape(-1) for g in grads)])


class Component(NamedTuple):
    """A component of the image or of the gradient by a part."""

    part: str
    z: float
    freedom: float  # degrees of freedom (Welch 1947)
    noise: float  # standard errors of both sides, relative
    of_reference: float


def components(problem: Problem) -> list[Component]:
    still = [name for name in problem.parts if name in STILL]
    moving = [name for name in problem.parts if name not in STILL]
    found, oracle = Running(), Running()
    for seed in range(SEEDS):
        found.add(sums_and_gradients(problem, still + moving, few, seed))
    for seed in range(ORACLES):
        oracle.add(sums_and_gradients(problem, still, by_oracle, 10_000 + seed))
    seeds, adjoint = Seeds(difference_seeds=(DIFFERENCES,), difference_spp=512), problem.cotangent(torch.empty(0))
    runs = [oracle, *(differences(problem, adjoint, name, 1.0, seeds) for name in moving)]
    counts = torch.cat([torch.full_like(run.mean, run.count) for run in runs])
    wanted = torch.cat([run.mean for run in runs])
    other = torch.cat([run.squares for run in runs]) / (counts - 1) / counts
    own = found.squares / (SEEDS - 1) / SEEDS
    freedom = (own + other) ** 2 / (own**2 / (SEEDS - 1) + other**2 / (counts - 1))
    names = ["image"] * SUMS + [name for name in still + moving for _ in range(problem.parts[name].numel())]
    columns = (found.mean - wanted) / (own + other).sqrt(), freedom, *(v.sqrt() / wanted.abs() for v in (own, other))
    return [Component(*row) for row in zip(names, *(column.tolist() for column in columns), strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("name", GLOSSY)
def test_few_samples_are_unbiased(name: str) -> None:
    found = components(GLOSSY[name]())
    z, freedom = torch.tensor([[c.z, c.freedom] for c in found], dtype=F64).T
    assert bool(z.isfinite().all()), found
    p = torch.from_numpy(2 * student.sf(z.abs().numpy(), freedom.numpy()))
    print(f"{name}: {len(z)} components, largest |z| {float(z.abs().max()):.2f}, {int((z.abs() > 3).sum())} beyond 3")
    assert not bool(holm(p, ALPHA).any()), found
