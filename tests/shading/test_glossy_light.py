"""Points of environments drawn by what they give to glossy surfaces: densities, unbiasedness, noise, and derivatives."""

from __future__ import annotations

import math

import pytest
import torch
from lit_scenes import F64, ball, directions, vector
from oracles.lobes import Lobes
from oracles.resampled import Glossy, resampled
from scipy.stats import chi2
from torch import Tensor
from torch.nn.functional import normalize

import edgegrad as eg
from edgegrad.library import core
from edgegrad.light.bsdf import Scattering

pytestmark = pytest.mark.watched

N = normalize(vector(0.2, -0.3, 0.8), dim=0)
ACROSS = normalize(torch.linalg.cross(N, vector(1, 0, 0)), dim=0)


def viewer(angle: float) -> Tensor:
    return math.cos(angle) * N + math.sin(angle) * ACROSS


def uniform(count: int, columns: int) -> Tensor:
    return torch.rand((count, columns), dtype=F64, generator=torch.Generator().manual_seed(3))


@pytest.mark.unwatched
@pytest.mark.parametrize("angle", [0.0, 0.8, 1.5, 1.7], ids=["head-on", "oblique", "grazing", "behind"])
@pytest.mark.parametrize("roughness", [0.05, 0.3, 0.6])
def test_directions_have_the_density_that_is_said(roughness: float, angle: float):
    """χ² of half vectors in rings and sectors around the normal, as wide as the lobe, of directions above the surface."""
    lobe = Lobes.of(viewer(angle)[None], N[None], vector(roughness)[None])
    count, rings, sectors, fine = 50_000, 12, 8, 32
    v, alpha = lobe.v[0], roughness**2
    axes = torch.stack([ACROSS, torch.linalg.cross(N, ACROSS), N])
    drawn = lobe.repeated(count).draw(uniform(count, 2))
    above = drawn @ N > 0
    # Rings are even in s: tan θ = α s / (1 − s).
    h = normalize(v + drawn[above], dim=1) @ axes.T
    t = h[:, :2].norm(dim=1) / h[:, 2] / alpha
    phi = torch.atan2(h[:, 1], h[:, 0]) / (2 * math.pi) + 0.5
    ring, sector = (t / (1 + t) * rings).long().clamp(max=rings - 1), (phi * sectors).long().clamp(max=sectors - 1)
    observed = torch.bincount(ring * sectors + sector, minlength=rings * sectors).double()

    def centres(n: int) -> Tensor:
        return (torch.arange(n, dtype=F64) + 0.5) / n

    s, phi = (x.flatten() for x in torch.meshgrid(centres(rings * fine), centres(sectors * fine), indexing="ij"))
    t, turn = alpha * s / (1 - s), 2 * math.pi * (phi - 0.5)
    cosine = 1 / (1 + t * t).sqrt()
    h = torch.stack([cosine * t * turn.cos(), cosine * t * turn.sin(), cosine], 1) @ axes
    # dω_l = 4 (v·h) dω_h, dω_h = cos³θ t dt dφ
    solid = cosine**3 * t * alpha / (1 - s) ** 2 / (rings * fine) * 2 * math.pi / (sectors * fine)
    vh = h @ v
    l = 2 * vh[:, None] * h - v
    density = torch.where((vh > 0) & (l @ N > 0), lobe.repeated(len(l)).density(l) * 4 * vh, 0.0)
    chance = (density * solid).reshape(rings, fine, sectors, fine).sum((1, 3)).flatten()
    assert 0.6 < chance.sum() < 1.001 and float(above.double().mean()) == pytest.approx(float(chance.sum()), abs=0.01)
    expected = count * chance
    many = expected > 20
    statistic = float(((observed - expected)[many] ** 2 / expected[many]).sum())
    assert int(many.sum()) > 20 and statistic < chi2.ppf(1 - 1e-4, int(many.sum()))


def sky(dark: float) -> eg.lights.Environment:
    image = torch.full((16, 32, 3), 0.2, dtype=F64)
    image[3:5, 20:22], image[7:12], image[14, 4:9] = 30.0, 0.0, dark
    return eg.lights.Environment(image, rotation=torch.linalg.qr(uniform(3, 3))[0])


MATERIALS = {
    "gold": (vector(1.0, 0.7, 0.3), 1.0), "plastic": (vector(0.1, 0.4, 0.8), 0.0), "black": (vector(0, 0, 0), 0.5),
    "brighter than white": (vector(1.5, 0.2, 1.3), 0.9), "negative": (vector(-0.4, 0.6, 0.2), 0.7),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.unwatched
@pytest.mark.parametrize("roughness", [0.3, 0.9])
@pytest.mark.parametrize("name", MATERIALS)
def test_points_are_unbiased(name: str, roughness: float):
    """The mean over draws against quadrature: of radiance, of what the diffuse share alone would give, of which a metal has
    only derivatives, and of where the sky is black."""
    base, metallic = MATERIALS[name]
    assert 0.3 < core.WIDEST_LOBE < 0.9
    scattering = Scattering(base[None], vector(metallic)[None], vector(roughness)[None])
    light, v, g = sky(0.0), viewer(0.7), normalize(N + 0.1 * ACROSS, dim=0)
    seeds, count = 8_000, 3
    one = Glossy.of(v[None], N[None], g[None], scattering, torch.zeros(1, dtype=torch.int64))
    points = resampled(light, 5, one.repeated(seeds)._replace(seed=torch.arange(seeds) * 7919 + 13), count)

    def integrands(l: Tensor, radiance: Tensor) -> Tensor:
        """(M, 5): of the channels, and of the other two."""
        above = ((l @ N > 0) & (l @ g > 0)).to(F64)[:, None] * (l @ N)[:, None]
        f = scattering.evaluate(v.expand(len(l), 3), N.expand(len(l), 3), l)
        black = (radiance[:, :1] == 0).to(F64)
        return above * torch.cat([f * radiance, radiance[:, :1] / math.pi, black * f[:, :1]], 1)

    found = torch.zeros((seeds, 5), dtype=F64)
    for some in points:
        l = light.place(some)
        value = integrands(l, light.arriving(some, l) * some.density[:, None]) / some.density[:, None]
        found += torch.where(torch.isfinite(some.density)[:, None], value, 0.0) / count
    l, solid = directions(500)
    axes = torch.stack([ACROSS, torch.linalg.cross(N, ACROSS), N])
    expected = integrands(l @ axes, light.towards(l @ axes)).sum(0) * solid
    error = found.std(0) / math.sqrt(seeds)
    assert bool(((found.mean(0) - expected).abs() < 4 * error + 2e-3 * expected.abs()).all()), (
        found.mean(0),
        expected,
        error,
    )
    used = (expected.abs() > 1e-6)[:4]  # of what is black little is drawn
    assert bool((error[:4] < 0.015 * expected[:4].abs())[used].all()), error / expected


def test_nothing_arrives_from_a_black_sky_of_one_texel_but_derivatives():
    radiance = torch.zeros(3, requires_grad=True)
    scene, camera = metal(eg.lights.Environment(radiance), 0.3), from_front(16)
    image = eg.render(scene, camera, spp=16, seed=0)
    assert float(image.detach().abs().max()) == 0
    image.sum().backward()
    white = float(eg.render(metal(eg.lights.Environment(torch.ones(3)), 0.3), camera, spp=64, seed=0).sum())
    assert radiance.grad is not None and float(radiance.grad.sum()) == pytest.approx(white, rel=0.03)


def metal(light: eg.lights.Environment, roughness: float) -> eg.Scene:
    material = eg.Material(torch.ones(3), metallic=1.0, roughness=roughness)
    return eg.Scene([ball(3, material=material)], lights=[light])


def from_front(size: int) -> eg.Camera:
    return eg.Camera.look_at((0.0, 0.3, 3.2), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, (size, size))


@pytest.mark.parametrize(("roughness", "most"), [(0.5, 0.05), (0.2, 0.03), (0.05, 0.02)])
def test_noise_under_an_even_sky(roughness: float, most: float):
    scene, camera = metal(eg.lights.Environment(torch.ones(32, 64, 3)), roughness), from_front(32)
    images = torch.stack(
        [eg.render(scene, camera, spp=16, sampling=eg.Sampling(lights=4), seed=seed) for seed in range(8)]
    )
    inside = images[:, 10:22, 10:22].double()
    assert 0 < float((inside.std(0) / inside.mean(0)).mean()) < most
    # White metal gives back all but what it would scatter more than once.
    assert 0.85 < float(inside.mean()) < 1.001
