"""Points of environments for derivatives of glossy surfaces: antithetic sets of four directions.

The density is that of all four. The estimates are unbiased, and parts of a lobe's derivatives of both signs cancel."""

from __future__ import annotations

import math

import pytest
import torch
from lit_scenes import F64, ball, directions, plane, vector
from oracles import shading
from oracles.antithetic import antithetic_set
from oracles.lobes import Lobes
from oracles.resampled import Glossy, resampled
from scipy.stats import chi2
from torch import Tensor
from torch.nn.functional import normalize

import edgegrad as eg
from edgegrad.light import in_kernel
from edgegrad.light.bsdf import Scattering, dot
from edgegrad.points.hits import Hits
from edgegrad.scene.lights import LightPoints

pytestmark = pytest.mark.watched

N = normalize(vector(0.2, -0.3, 0.8), dim=0)
ACROSS = normalize(torch.linalg.cross(N, vector(1, 0, 0)), dim=0)
AXES = torch.stack([ACROSS, torch.linalg.cross(N, ACROSS), N])
V = math.cos(0.6) * N + math.sin(0.6) * ACROSS


def uniform(count: int, columns: int) -> Tensor:
    return torch.rand((count, columns), dtype=F64, generator=torch.Generator().manual_seed(3))


def four(l: Tensor, alpha: float) -> tuple[Tensor, Tensor]:
    return antithetic_set(V.expand_as(l), N.expand_as(l), l.new_full((1, 1), alpha), l)


def test_each_of_four_has_the_same_antithetic_set():
    """And their solid angles are what small changes of the half vector make of them."""
    alpha, step = 0.2, 1e-6
    l = Lobes.of(V[None], N[None], vector(0.45)[None]).repeated(200).draw(uniform(200, 2))
    all, measure = four(l, alpha)
    for k in range(4):
        again, other = four(all[:, k], alpha)
        rows = (measure.amin(1) > 1e-6).nonzero()[:, 0]
        order = [k, k ^ 1, k ^ 2, k ^ 3]
        assert float((again[rows] - all[rows][:, order]).abs().max()) < 1e-6
        ratio = measure[rows][:, order] / measure[rows][:, k : k + 1] * other[rows, :1]
        assert torch.allclose(ratio, other[rows], rtol=1e-6)
    x = normalize(torch.linalg.cross(l, V.expand_as(l)), dim=1)
    y = torch.linalg.cross(l, x)
    moved = [four(normalize(l + s * d, dim=1), alpha)[0] for d in (x, y) for s in (step, -step)]
    by_x, by_y = (moved[0] - moved[1]) / (2 * step), (moved[2] - moved[3]) / (2 * step)
    area = torch.linalg.cross(by_x, by_y).norm(dim=2)
    known = measure > 0
    assert torch.allclose((area * measure[:, :1])[known], measure[known], rtol=1e-3)


@pytest.mark.parametrize("roughness", [0.1, 0.5])
def test_antithetic_sets_have_their_density(roughness: float):
    """χ² of the one of four that has tan θ ≤ α and an azimuth in [0, π), in rings and sectors, of directions that the lobe draws
    above the surface."""
    lobe, alpha = Lobes.of(V[None], N[None], vector(roughness)[None]), roughness**2
    count, rings, sectors, fine = 40_000, 8, 8, 24
    drawn = lobe.repeated(count).draw(uniform(count, 2))
    h, above = normalize(V + drawn, dim=1) @ AXES.T, drawn @ N > 0
    t = (h[:, :2].norm(dim=1) / h[:, 2] / alpha)[above]
    phi = (torch.atan2(h[:, 1], h[:, 0])[above] / math.pi) % 1
    ring = (torch.minimum(t, 1 / t) * rings).long().clamp(max=rings - 1)
    sector = (phi * sectors).long().clamp(max=sectors - 1)
    observed = torch.bincount(ring * sectors + sector, minlength=rings * sectors).double()

    def centres(n: int) -> Tensor:
        return (torch.arange(n, dtype=F64) + 0.5) / n

    t, phi = (x.flatten() for x in torch.meshgrid(centres(rings * fine), centres(sectors * fine), indexing="ij"))
    cosine = 1 / (1 + (alpha * t) ** 2).sqrt()
    h = torch.stack([cosine * alpha * t * (math.pi * phi).cos(), cosine * alpha * t * (math.pi * phi).sin(), cosine], 1)
    h = h @ AXES
    solid = cosine**3 * alpha**2 * t / (rings * fine) * math.pi / (sectors * fine)
    l = normalize(2 * dot(V.expand_as(h), h) * h - V, dim=1)
    all, measure = four(l, alpha)
    density = lobe.repeated(4 * len(l)).density(all.reshape(-1, 3)).reshape(-1, 4)
    density = torch.where(all @ N > 0, density, 0.0)
    chance = ((density * measure).sum(1) * solid).reshape(rings, fine, sectors, fine).sum((1, 3)).flatten()
    expected = count * chance
    assert float(chance.sum()) == pytest.approx(float(above.double().mean()), abs=0.002)
    assert float(((observed - expected) ** 2 / expected).sum()) < chi2.ppf(1 - 1e-4, rings * sectors)


def sky(emitters: bool) -> eg.lights.Environment:
    """A smooth one, or with lights, of which one lies where the point mirrors."""
    image = torch.linspace(0.4, 1.2, 16, dtype=F64)[:, None, None].expand(16, 32, 3).clone()
    turn = torch.linalg.qr(uniform(3, 3))[0]
    if emitters:
        light = eg.lights.Environment(image, rotation=turn)
        mirror = light.points_at(2 * dot(V[None], N[None]) * N - V)
        image.reshape(-1, 3)[mirror.index] = 40.0
        image[3:5, 20:22] = 20.0
    return eg.lights.Environment(image, rotation=turn)


PARAMETERS = ["normal", "normal across", "roughness", "metallic", "base color", "texel"]


def derivatives(l: Tensor, arriving: Tensor, roughness: float) -> Tensor:
    """(M, 6) of f max(0, n·l) E of directions (M, 3), by the parameters, by central differences; the last by the level of the
    sky."""

    def value(x: Tensor) -> Tensor:
        n = normalize(N + x[0] * AXES[0] + x[1] * AXES[1], dim=0).expand_as(l)
        scattering = Scattering(0.8 + x[4].expand(1, 1), 0.8 + x[3].expand(1, 1), roughness + x[2].expand(1, 1))
        lit = (l @ N > 0).to(F64)
        return lit * (scattering.evaluate(V.expand_as(l), n, l) * dot(n, l) * arriving[:, :1])[:, 0]

    steps = 1e-5 * torch.eye(5, dtype=F64)
    return torch.stack([*((value(step) - value(-step)) / 2e-5 for step in steps), value(torch.zeros(5, dtype=F64))], 1)


def estimates(light: eg.lights.Environment, roughness: float, seeds: int, antithetic: bool) -> Tensor:
    """(seeds, 6) of the derivatives from four directions, or from one."""
    material = Scattering(vector(0.8)[None], vector(0.8)[None], vector(roughness)[None])
    one = Glossy.of(V[None], N[None], N[None], material, torch.zeros(1, dtype=torch.int64))
    seed = torch.arange(seeds) * 7919 + 13
    drawn = resampled(light, 5, one.repeated(seeds)._replace(seed=seed), 1, antithetic=antithetic)
    total = torch.zeros((seeds, len(PARAMETERS)), dtype=F64)
    for points in drawn:
        known = torch.isfinite(points.density)
        points = LightPoints(points.index, points.uv, torch.where(known, points.density, 1.0))
        l = light.place(points)
        total += torch.where(known[:, None], derivatives(l, light.arriving(points, l), roughness), 0.0) / len(drawn)
    return total


@pytest.mark.slow
@pytest.mark.unwatched
@pytest.mark.parametrize("emitters", [False, True], ids=["smooth", "emitters"])
@pytest.mark.parametrize("roughness", [0.2, 0.5])
def test_derivatives_are_unbiased(roughness: float, emitters: bool):
    """The mean over draws against quadrature."""
    light, seeds = sky(emitters), 10_000
    found = estimates(light, roughness, seeds, antithetic=True)
    l, solid = directions(350)
    l = l @ AXES
    expected = (derivatives(l, light.towards(l), roughness)).sum(0) * solid
    error = found.std(0) / math.sqrt(seeds)
    off = (found.mean(0) - expected).abs()
    assert bool((off < 4 * error + 3e-3 * expected.abs()).all()), (found.mean(0), expected, error)
    # Known well enough, but for what is nearly zero; of metals the diffuse share and the lobe change against one another.
    size = expected.abs()
    size[:2] = expected[:2].norm()
    most = vector(0.025, 0.025, 0.025, 0.05, 0.01, 0.01)
    assert bool((error < most * size)[size > 0.3 * size.max()].all()), error / size


def test_what_has_both_signs_cancels():
    """At as many rays, under a smooth sky; without antithetic_set the first two ratios are one."""
    light = sky(False)
    alone, together = (estimates(light, 0.2, 3000, antithetic=antithetic).var(0) for antithetic in (False, True))
    gain = dict(zip(PARAMETERS, (alone / (4 * together)).tolist(), strict=True))
    assert gain["normal"] > 10 and gain["normal across"] > 10 and gain["roughness"] > 3, gain
    assert gain["base color"] > 0.1 and gain["texel"] > 0.1, gain


def test_kernel_and_twin_draw_the_same_points():
    """Derivatives by all that is lit, where only these are wanted."""

    def leaves() -> dict[str, Tensor]:
        mesh = ball(2)
        assert mesh.normals is not None
        image = sky(True).radiance.clone()
        found = {
            "verts": mesh.verts.double(),
            "normals": mesh.normals.double(),
            "roughness": 0.2 + 0.7 * uniform(len(mesh.verts), 1),
        }
        found |= {
            "base": uniform(len(mesh.verts), 3),
            "metallic": vector(0.6),
            "sky": image,
            "turn": torch.eye(3, dtype=F64),
        }
        return {name: value.clone().requires_grad_() for name, value in found.items()}

    def gradients(shade: object) -> dict[str, Tensor]:
        of = leaves()
        material = eg.Material(of["base"], metallic=of["metallic"][0], roughness=of["roughness"])
        mesh = ball(2).replace(verts=of["verts"], normals=of["normals"], material=material)
        ground = plane(material=eg.Material()).transformed(t=vector(0, 0, -1.2))
        lights = [
            eg.lights.Environment(of["sky"], rotation=of["turn"]),
            eg.lights.PointLight(vector(2.0, 1.0, 3.0), 9.0),
        ]
        scene = eg.Scene([mesh, ground], lights=lights)
        camera = eg.Camera.look_at((0.0, -2.0, 2.5), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 50.0, (16, 16))
        hits = eg.points.surface_samples(eg.points.primary_hits(scene, camera, seed=0)).hits
        hits._needs_values = False
        bar = torch.randn((len(hits), 3), dtype=F64, generator=torch.Generator().manual_seed(1))
        L = shade(hits, True, 2)  # type: ignore[operator]
        found = torch.autograd.grad((L * bar).sum(), list(of.values()))
        return dict(zip(of, found, strict=True))

    wanted, got = gradients(shading.reference), gradients(in_kernel.radiance)
    for name, value in wanted.items():
        assert float(value.abs().max()) > 0, name
        assert float((value - got[name]).abs().max()) <= 1e-8 * float(value.abs().max()), name


def test_values_take_no_antithetic_sets():
    """Shaders see the points that images do."""
    scene = eg.Scene([ball(2, material=eg.Material(metallic=1.0, roughness=0.2))], lights=[sky(True)])
    camera = eg.Camera.look_at((0.0, -2.0, 2.5), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 50.0, (16, 16))
    hits: Hits = eg.points.primary_hits(scene, camera, seed=0).hits
    assert torch.allclose(shading.reference(hits, True, 2), in_kernel.radiance(hits, True, 2), rtol=1e-10)
