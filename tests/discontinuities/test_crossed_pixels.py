"""Pixels that a shader's discontinuities cross, shaded at several points: unbiased, with less noise, and nothing else changes."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from alpha_masks import F64, quad
from scenes import front_camera
from torch import Tensor

import edgegrad as eg
from benchmarks.stability.painted import PAINTED
from edgegrad.points import discontinuous_pixels

pytestmark = pytest.mark.quick

SIZE = 24
FLAT = eg.Camera(
    torch.eye(4, dtype=F64),
    torch.tensor([[12.0, 0, 12], [0, 12, 12], [0, 0, 1]], dtype=F64),
    (SIZE, SIZE),
    "orthographic",
)


def images(
    seeds: int, shader: Callable[[eg.points.Hits], Tensor], mesh: eg.Mesh | eg.Scene, camera: eg.Camera, spp: int
) -> Tensor:
    with torch.no_grad():
        return torch.stack([eg.render(mesh, camera, spp=spp, seed=seed, shader=shader) for seed in range(seeds)])


def without_borders(monkeypatch: pytest.MonkeyPatch) -> None:
    nowhere = torch.zeros((SIZE, SIZE), dtype=torch.bool)
    monkeypatch.setattr(discontinuous_pixels.DiscontinuousPixels, "found", lambda self: (nowhere, 1))


def dots(hits: eg.points.Hits) -> Tensor:
    """Paint a dot of 0.6 px in the middle of every third pixel: no other pixel knows of it."""
    x = hits.pixel % 3 - 1.5
    return hits.where(0.3 - x.norm(dim=1), 1.0, 0.0)


@pytest.mark.parametrize("spp", [2, pytest.param(16, marks=pytest.mark.slow)])
def test_what_one_pixel_alone_shows_keeps_its_mean(spp: int):
    found = images(300, dots, quad(), FLAT, spp)[:, 1::3, 1::3, 0]
    found = found.mean((1, 2))
    error = float(found.std()) / len(found) ** 0.5
    assert error < 0.005
    assert float(found.mean()) == pytest.approx(torch.pi * 0.09, abs=4 * error)


def test_means_are_exact_and_noise_is_less(monkeypatch: pytest.MonkeyPatch):
    camera = front_camera(SIZE)
    problem = PAINTED["floor of a shader"](camera)
    scene, _ = problem.make(problem.parts)
    assert problem.exact is not None
    wanted = problem.exact(problem.parts).detach()
    several = images(256, problem.options["shader"], scene, camera, 16)
    variance = several.var(0)
    z = ((several.mean(0) - wanted) / (variance / 256).sqrt())[variance > 1e-8]
    assert len(z) > 250 and float(z.square().mean()) == pytest.approx(1.0, abs=0.25)
    without_borders(monkeypatch)
    once = images(64, problem.options["shader"], scene, camera, 16).var(0)
    assert float(variance.mean()) < 0.2 * float(once.mean())


def test_shaders_without_discontinuities_keep_their_bits(monkeypatch: pytest.MonkeyPatch):
    camera = front_camera(SIZE)
    one = images(1, lambda hits: hits.position, quad(), camera, 16)
    without_borders(monkeypatch)
    assert torch.equal(one, images(1, lambda hits: hits.position, quad(), camera, 16))


def test_a_bound_of_what_is_shaded():
    """Every pixel is a border, so at most four times the points of the first pass are shaded more."""
    counts = []

    def shader(hits: eg.points.Hits) -> Tensor:
        counts.append(len(hits))
        return hits.where(torch.cos(50.0 * hits.position.sum(1)), 1.0, 0.0)

    images(1, shader, quad(), FLAT, 16)
    first, again = counts
    assert first < again <= 4 * first + SIZE
