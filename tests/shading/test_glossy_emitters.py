"""Points of meshes that emit, drawn by what they give to glossy surfaces: trees, unbiasedness, noise, and derivatives."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from lit_scenes import F64, ball, from_above, plane, vector
from lit_words import hits_of
from oracles import shading
from oracles.lobes import Lobes, sobol_parts
from oracles.mesh_light_sampling import EmissiveMeshSampler
from oracles.resampled import Glossy, resampled
from scenes import icosphere, soup
from torch import Tensor
from torch.nn.functional import normalize

import edgegrad as eg
from edgegrad.light import in_kernel
from edgegrad.light.bsdf import Scattering
from edgegrad.light.sampling import tree_of
from edgegrad.scene.mesh_light import MeshLight


def crossings(corner: Tensor, origins: Tensor, directions: Tensor) -> Tensor:
    """(N, F): the distances at which rays cross triangles (F, 3, 3), infinite where they do not."""
    e1, e2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    normal = torch.linalg.cross(e1, e2)
    t = ((corner[:, 0] - origins[:, None]) * normal).sum(2) / (directions @ normal.T)
    p = origins[:, None] + t[..., None] * directions[:, None] - corner[:, 0]
    squared = (normal * normal).sum(1)
    u = (torch.linalg.cross(p, e2.expand_as(p)) * normal).sum(2) / squared
    v = (torch.linalg.cross(e1.expand_as(p), p) * normal).sum(2) / squared
    return torch.where((t > 0) & (u >= 0) & (v >= 0) & (u + v <= 1), t, math.inf)


def test_a_tree_finds_what_rays_cross():
    draw = torch.Generator().manual_seed(2)
    verts = torch.randn((90, 3), dtype=F64, generator=draw)
    verts[::3, 2] = 0.25
    faces = torch.randint(0, 90, (150, 3), generator=draw)
    light = MeshLight(eg.Mesh(verts, faces).replace(material=eg.Material(base_color=0.0, emission=1.0)))
    origins = 2 * torch.randn((400, 3), dtype=F64, generator=draw)
    directions = normalize(-origins + torch.randn((400, 3), dtype=F64, generator=draw), dim=1)
    directions[:3] = torch.eye(3, dtype=F64)
    inside = torch.zeros(400, dtype=F64).numpy(), np.full(400, np.inf)
    which, where = tree_of(light).crossings(origins.numpy(), directions.numpy(), *inside)
    found = torch.full((400, 150), math.inf, dtype=F64)
    found[which[:, 0], which[:, 1]] = torch.from_numpy(where[:, 2])
    expected = crossings(verts[faces], origins, directions)
    assert 500 < len(which) == int(expected.isfinite().sum())
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
    place = origins[which[:, 0]] + torch.from_numpy(where[:, 2:]) * directions[which[:, 0]]
    b = torch.from_numpy(where[:, :2])
    b = torch.cat([1 - b.sum(1, keepdim=True), b], 1)
    torch.testing.assert_close((b[:, :, None] * verts[faces[which[:, 1]]]).sum(1), place, rtol=0, atol=1e-9)


def open_ball() -> eg.Mesh:
    mesh = icosphere(2)
    return eg.Mesh(mesh.verts, mesh.faces[mesh.verts[mesh.faces].mean(1)[:, 1] < 0.3])


def two_balls() -> eg.Mesh:
    mesh = icosphere(1)
    return eg.Mesh(torch.cat([mesh.verts, mesh.verts + 3]), torch.cat([mesh.faces, mesh.faces + len(mesh.verts)]))


def inside_out(mesh: eg.Mesh) -> eg.Mesh:
    return eg.Mesh(mesh.verts, mesh.faces.flip(1))


SHAPES = {
    "rectangle": (plane(), True, False), "ball": (icosphere(2), False, True), "soup": (soup(icosphere(2)), False, True),
    "open": (open_ball(), False, False), "two balls": (two_balls(), False, False),
    "inside out": (inside_out(icosphere(1)), False, False),
}  # fmt: skip


@pytest.mark.parametrize("name", SHAPES)
def test_the_shape_of_an_emitter(name: str):
    mesh, flat, convex = SHAPES[name]
    tree = tree_of(MeshLight(mesh.replace(material=eg.Material(base_color=0.0, emission=1.0))))
    assert (tree.is_flat, tree.is_convex) == (flat, convex)


def block(*sides: float) -> eg.Mesh:
    corners = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=F64)
    quads = torch.tensor([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return eg.Mesh(corners * vector(*sides), torch.cat([quads[:, :3], quads[:, [0, 2, 3]]]))


def test_what_is_round():
    """Closed and convex, about as wide in all directions, and emits alike."""

    def is_round(mesh: eg.Mesh, emission: Any = 1.0) -> bool:
        light = MeshLight(mesh.replace(material=eg.Material(0.0, emission=emission)))
        return tree_of(light).is_round(np.ascontiguousarray(light.density.numpy()))

    sphere = icosphere(2)
    assert is_round(sphere) and is_round(soup(sphere)) and is_round(block(1, 1, 1))
    assert not any(is_round(mesh) for mesh in (plane(), open_ball(), two_balls(), block(4, 1, 1)))
    spot = torch.zeros((8, 8, 1), dtype=F64)
    spot[4, 4] = 1.0
    uvs = (sphere.verts[:, :2].double() + 1) / 2
    assert not is_round(sphere, eg.Texture(spot, uvs, sphere.faces))
    assert is_round(sphere, eg.Texture(spot + 0.5, uvs, sphere.faces))


def solid_angles(corner: Tensor) -> Tensor:
    """(F,) of triangles (F, 3, 3) seen from the origin, positive from the front (Van Oosterom and Strackee 1983)."""
    a, b, c = corner.unbind(1)
    r = corner.norm(dim=2)
    triple = -(a * torch.linalg.cross(b, c)).sum(1)
    pairs = (a * b).sum(1) * r[:, 2] + (b * c).sum(1) * r[:, 0] + (c * a).sum(1) * r[:, 1]
    return 2 * torch.atan2(triple, r.prod(1) + pairs)


@pytest.mark.parametrize("distance", [1.1, 2.0, 9.0])
def test_directions_to_a_ball_have_their_density(distance: float):
    """How often faces are met, against their solid angles; and densities by area against those by solid angle."""
    mesh, n = icosphere(1), 40_000
    mesh = eg.Mesh(mesh.verts.double() + distance * normalize(vector(0.3, -0.5, 0.8), dim=0), mesh.faces)
    light = MeshLight(mesh.replace(material=eg.Material(base_color=0.0, emission=1.0)))
    meets = EmissiveMeshSampler.of(light, torch.zeros((n, 3), dtype=F64), torch.full((n,), -1))
    ray, points = meets.towards(meets.draw_by_ball(sobol_parts(torch.arange(n), 5, 1)))
    assert len(ray.unique()) == len(ray)  # of a convex light only what lies in front
    cone = 2 * math.pi * (1 - math.sqrt(1 - 1 / distance**2))
    chance = solid_angles(mesh.verts[mesh.faces]).clamp(min=0) / cone
    assert 0.6 < float(chance.sum()) < 1
    found = torch.bincount(points.index, minlength=len(mesh.faces))
    assert int(found[chance == 0].sum()) == 0
    expected = torch.cat([chance, 1 - chance.sum()[None]]) * n
    counts = torch.cat([found, n - found.sum()[None]])
    some = expected > 5
    chi2 = ((counts - expected)[some] ** 2 / expected[some]).sum()
    assert float(chi2) < int(some.sum()) + 4 * math.sqrt(2 * int(some.sum()))  # more even than random ones
    # One over the density by area is what a point stands for: their mean is the area that is met.
    density = meets.select(ray).with_ball_density(points).density
    area = light._area(points.index).norm(dim=1)
    for face in chance.argsort()[-3:].tolist():
        of_face = points.index == face
        stands_for = (1 / density[of_face]).sum() / n
        torch.testing.assert_close(stands_for, area[of_face][0], rtol=4 / math.sqrt(int(of_face.sum())), atol=0)


def test_all_directions_may_miss_an_emitter():
    """There is nothing then; one surface at a time, for what others meet would hide it."""
    emitter = MeshLight(
        together(moved(block(1, 1, 1), 1.0, 0, 0, 3)).replace(material=eg.Material(base_color=0.0, emission=1.0))
    )
    n, y = vector(0, 0, 1)[None], vector(0.1, 0.2, 0)[None]
    rough = Scattering(vector(0.5)[None], vector(1.0)[None], vector(0.9)[None])
    drawn = []
    for seed in range(40):
        one = Glossy.of(n, n, n, rough, torch.tensor([seed * 7919]))
        (points,) = resampled(emitter, 5, one, 1, EmissiveMeshSampler.of(emitter, y, torch.tensor([-1])))
        drawn.append(bool(points.density.isfinite()))
    assert 5 < sum(drawn) < 35


def test_the_kernel_draws_what_pytorch_draws():
    """A ball emits, for surfaces where the lobe is asked and where it is not."""
    metal = eg.Material(torch.ones(3, dtype=F64), metallic=1.0, roughness=0.3)
    rough = eg.Material(torch.ones(3, dtype=F64), metallic=1.0, roughness=0.9)
    emitter = eg.Mesh(icosphere(1).verts * 0.6 + vector(1.7, 0.1, 0.8), icosphere(1).faces).replace(
        material=eg.Material(base_color=0.0, emission=3.0)
    )
    floor = plane(2.0, material=rough).replace(verts=plane(2.0).verts - vector(0, 0, 1.2))
    scene = eg.Scene([ball(2, material=metal), floor, emitter])
    hits = hits_of(scene, from_above(20))
    (light,) = hits.lights
    assert isinstance(light, MeshLight)
    position, own = hits.position.detach().double(), torch.full_like(hits.mesh, -1)
    lobes = Lobes.of(hits.view, hits.shading_normal, vector(0.3)[None])
    asked = EmissiveMeshSampler.of(light, position, own).is_drawn_by(lobes)[hits.mesh == 0]
    assert bool(asked.any()) and not bool(asked.all())
    for a, b in zip(shading.points_by_material(hits, light, 3), in_kernel.light_points(hits, light, 3), strict=True):
        some = a.density.isfinite()
        assert torch.equal(some, b.density.isfinite()) and int(some.sum()) > 200
        assert torch.equal(a.index[some], b.index[some])
        torch.testing.assert_close(a.uv[some], b.uv[some], rtol=0, atol=1e-9)
        torch.testing.assert_close(a.density[some], b.density[some], rtol=1e-9, atol=0)


def quad(height: float, size: float, tilt: float = 0.0) -> tuple[Tensor, Tensor]:
    corner = size * torch.tensor([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=F64)
    corner[:, 2] = height + tilt * corner[:, 0]
    return corner, torch.tensor([[0, 2, 1], [0, 3, 2]])


def together(*parts: tuple[Tensor, Tensor]) -> eg.Mesh:
    first = np.cumsum([0, *(len(verts) for verts, _ in parts)])
    faces = [part + int(start) for (_, part), start in zip(parts, first[:-1], strict=True)]
    return eg.Mesh(torch.cat([verts for verts, _ in parts]), torch.cat(faces))


def moved(mesh: eg.Mesh, scale: float, *by: float) -> tuple[Tensor, Tensor]:
    return mesh.verts.double() * scale + vector(*by), mesh.faces


EMITTERS = {
    "softbox": (together(quad(1.5, 1.2, 0.3)), False),
    "one behind the other": (together(quad(1.5, 0.7), quad(2.0, 2.0, 0.2)), True),
    "twice": (together(quad(1.5, 0.9), quad(1.5, 0.9)), True),
    "ball": (together(moved(icosphere(1), 0.8, 0.4, 0.2, 1.6)), True),
    "bowl": (together(moved(open_ball(), 0.8, -0.2, 0.3, 1.6)), True),
    "room": (together(moved(icosphere(1), 3.0, 0.5, 0.0, 0.5)), True),
    "small": (together(quad(2.0, 0.1)), False),
}


def seen_from_origin(corner: Tensor, there: Tensor) -> Tensor:
    """(N,) whether no triangle (F, 3, 3) lies between the origin and places (N, 3): the plane of each, and those through the
    origin and its edges."""
    sides = [there @ torch.linalg.cross(corner[:, i], corner[:, (i + 1) % 3]).T for i in range(3)]
    inside = torch.stack(sides)
    crossed = (inside > 0).all(0) | (inside < 0).all(0)
    normal = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    t = (corner[:, 0] * normal).sum(1) / (there @ normal.T)  # in lengths of `there`
    return ~(crossed & (t > 0) & (t < 1 - 1e-9)).any(1)


@pytest.mark.slow
@pytest.mark.parametrize("name", EMITTERS)
def test_points_are_unbiased(name: str):
    """The mean over draws against quadrature over the light's faces, of what reaches the origin past the light itself."""
    mesh, two_sided = EMITTERS[name]
    light = MeshLight(mesh.replace(material=eg.Material(base_color=0.0, emission=1.0, two_sided=two_sided)))
    n, v, y = vector(0, 0, 1), normalize(vector(0.5, -0.2, 0.9), dim=0), vector(0, 0, 0)
    corner = mesh.verts.double()[mesh.faces]

    def arriving(points: eg.lights.LightPoints) -> tuple[Tensor, Tensor]:
        """(M, 3) the direction l, and max(0, n·l) V cos θ / r²."""
        there = light.place(points)
        l = normalize(there, dim=1)
        found = (l @ n).clamp(min=0)[:, None] * light.facing(points.index, light._weights(points), y.expand(len(l), 3))
        some = found[:, 0] > 0
        found[some] *= seen_from_origin(corner, there[some])[:, None]
        return l, found

    fine = max(4, int((80_000 / len(mesh.faces)) ** 0.5))
    i, j = (x.flatten() for x in torch.meshgrid(torch.arange(fine), torch.arange(fine), indexing="ij"))
    # The centres of equal triangles.
    lower, upper = i + j < fine, i + j < fine - 1
    uv = torch.cat([torch.stack([i, j], 1)[lower] + 1 / 3, torch.stack([i, j], 1)[upper] + 2 / 3]).double() / fine
    F = len(mesh.faces)
    every = eg.lights.LightPoints(
        torch.arange(F).repeat_interleave(len(uv)), uv.repeat(F, 1), torch.ones(F * len(uv), dtype=F64)
    )
    l, all_arriving = arriving(every)
    all_arriving *= light._area(every.index).norm(dim=1, keepdim=True) / len(uv)

    seeds, count = 6_000, 2
    seed = torch.arange(seeds) * 7919 + 13
    meets = EmissiveMeshSampler.of(light, y.expand(seeds, 3), torch.full((seeds,), -1))
    for roughness in (0.15, 0.4, 0.9):
        scattering = Scattering(vector(0.3, 0.6, 0.9)[None], vector(0.6)[None], vector(roughness)[None])

        def scattered(l: Tensor, scattering: Scattering = scattering) -> Tensor:
            return scattering.evaluate(v.expand(len(l), 3), n.expand(len(l), 3), l)

        expected = (scattered(l) * all_arriving).sum(0)
        one = Glossy.of(v[None], n[None], n[None], scattering, torch.zeros(1, dtype=torch.int64))
        found = torch.zeros((seeds, 3), dtype=F64)
        for points in resampled(light, 5, one.repeated(seeds)._replace(seed=seed), count, meets):
            towards, light_there = arriving(points)
            value = scattered(towards) * light_there / points.density[:, None]
            found += torch.where(torch.isfinite(points.density)[:, None], value, 0.0) / count
        error = found.std(0) / math.sqrt(seeds)
        off = (found.mean(0) - expected).abs()
        assert bool((off < 4 * error + 2e-3 * expected).all()), (roughness, found.mean(0), expected, error)
        assert bool((error < 0.015 * expected).all()), (roughness, error / expected)


def test_lobes_draw_only_where_they_gain():
    """They do by the light's size against the lobe's, and by where it lies."""
    n, v = vector(0, 0, 1), normalize(vector(0.3, 0.0, 1.0), dim=0)

    def asked(size: float, roughness: float, x: float) -> bool:
        verts, faces = quad(2.0, size)
        light = MeshLight(
            eg.Mesh(verts + vector(x, 0, 0), faces).replace(material=eg.Material(base_color=0.0, emission=1.0))
        )
        meets = EmissiveMeshSampler.of(light, torch.zeros((1, 3), dtype=F64), torch.tensor([-1]))
        return bool(meets.is_drawn_by(Lobes.of(v[None], n[None], vector(roughness)[None])))

    assert asked(1.0, 0.2, -0.6) and asked(0.3, 0.1, -0.6) and asked(5.0, 0.6, 0.0)
    assert not asked(0.05, 0.3, -0.6)  # all of it lies within the lobe
    assert not asked(0.5, 0.1, 6.0)  # the lobe points elsewhere
    assert not asked(5.0, 0.9, 0.0)  # the lobe is too wide


def studio(kind: str, roughness: float) -> tuple[eg.Scene, eg.Camera]:
    metal = eg.Material(torch.ones(3), metallic=1.0, roughness=roughness)
    if kind == "softbox":
        corners = vector(0, 2.5, -3), vector(2.5, 0, 0), vector(0, 1.6, 0.8)
        emitter = eg.shapes.rectangle(*corners, material=eg.Material(base_color=0.0, emission=2.0, two_sided=False))
    else:
        emitter = eg.Mesh(icosphere(2).verts * 0.5 + vector(-1.2, 2.0, 1.5), icosphere(2).faces).replace(
            material=eg.Material(base_color=0.0, emission=10.0)
        )
    camera = eg.Camera.look_at((0.0, 1.6, 3.6), (0.0, 0.2, 0.0), (0.0, 1.0, 0.0), 36.0, (32, 32))
    return eg.Scene([ball(3, material=metal), emitter]), camera


# Relative noise of the image as it was measured, and three tenths more. Drawn by the light alone it was 2.4, 0.135, 3.3, 0.28.
MOST = {("softbox", 0.2): 0.14, ("softbox", 0.6): 0.126, ("ball", 0.3): 0.577, ("ball", 1.0): 0.089}


@pytest.mark.parametrize(("kind", "roughness"), MOST)
def test_noise_of_emitters_is_bounded(kind: str, roughness: float):
    scene, camera = studio(kind, roughness)
    images = torch.stack(
        [eg.render(scene, camera, spp=16, sampling=eg.Sampling(lights=4), seed=seed) for seed in range(8)]
    ).double()
    found = float(images.var(0).mean().sqrt() / images.mean())
    assert 0 < found < MOST[kind, roughness], found


def test_the_plan_says_how_light_is_drawn():
    def said(*lights: Any, **material: Any) -> str:
        mesh = ball(1, material=eg.Material(**material))
        return eg.plan(eg.Scene([mesh], lights=list(lights)), studio("ball", 0.3)[1])["lights"].why

    emitter, sky = (
        plane().replace(material=eg.Material(base_color=0.0, emission=1.0)),
        eg.lights.Environment(torch.ones(3)),
    )
    assert "drawn by the light, for no surface is glossy" in said(emitter, sky)
    glossy = said(emitter, sky, metallic=1.0, roughness=0.3)
    assert "8 candidates" in glossy and "(skies, meshes that emit)" in glossy and "by the light alone" in glossy
    assert "by the light alone" not in said(sky, metallic=1.0, roughness=0.3)
    assert "candidates" not in said(eg.lights.PointLight(vector(0, 0, 1)), metallic=1.0, roughness=0.3)
