"""The kernel's shading of lit scenes against the same in PyTorch: values, cotangents of all tensors, tangents."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from lit_words import CAMERAS, F64, SCENES, Leaves, cotangents, hits_of, number, numbers_of, scene_of
from oracles import shading
from scenes import icosphere
from threads import check_threads
from torch import Tensor

import edgegrad as eg
from edgegrad.kernel.derivatives import transformed
from edgegrad.kernel.first_order import unreached
from edgegrad.kernel.request import make_request
from edgegrad.light import creases, in_kernel, radiance
from edgegrad.points.hits import Hits
from edgegrad.points.image_context import ImageContext
from edgegrad.points.shadow_rays import Forced
from edgegrad.scene.lights import LightPoints

pytestmark = pytest.mark.watched


def both(words: str, view: str, samples: int, leaves: Leaves, w2c: Tensor) -> tuple[Hits, Hits, Tensor, Tensor]:
    hits = [hits_of(scene_of(words, leaves), CAMERAS[view].replace(world_to_camera=w2c)) for _ in range(2)]
    return hits[0], hits[1], shading.reference(hits[0], True, samples), in_kernel.radiance(hits[1], True, samples)


@pytest.mark.parametrize(
    ("words", "view"),
    [*((words, "perspective") for words in SCENES), *((words, "orthographic") for words in SCENES[-2:])],
)
def test_values_and_cotangents(words: str, view: str) -> None:
    leaves = {name: value.clone().requires_grad_() for name, value in numbers_of(words).items()}
    w2c = CAMERAS[view].world_to_camera.double().clone().requires_grad_()
    hits, found, expected, radiance = both(words, view, 2, leaves, w2c)
    assert len(hits) > 200 and float(expected.detach().abs().max()) > 0.05
    assert torch.allclose(radiance, expected, rtol=1e-12, atol=1e-12)
    asked = [light for light in hits._lit if light in found._lit]
    assert all(torch.equal(hits._lit[k], found._lit[k]) for k in asked)
    assert hits._surfaces.shadowing == found._surfaces.shadowing
    tensors = {**leaves, "w2c": w2c}
    for name, a, b in zip(tensors, cotangents(expected, tensors), cotangents(radiance, tensors), strict=True):
        # Where one light comes from all around and nothing is interpolated, place and view do not matter.
        # Nor do coordinates within a texel.
        still = ("uvs", "base_uvs") if "nearest" in words else ()
        assert float(a.abs().max()) > 0 or name in ("verts", "ground", "w2c", *still), name
        assert float((a - b).abs().max()) <= 1e-9 * float(a.abs().max()), name


@pytest.mark.parametrize("grey", [0.5, 128 / 255, 127 / 255], ids=["half", "128", "127"])
@pytest.mark.parametrize("noise", [0.0, 1e-15])
def test_a_grey_normal_map_changes_nothing(grey: float, noise: float) -> None:
    """The kernel and PyTorch shade as without the map, and so are derivatives, which rounding would make as large as 1e15."""
    words, found = "normals normal_map microfacets point", []
    draw = torch.Generator().manual_seed(5)
    image = grey + noise * (torch.rand(8, 8, 3, dtype=F64, generator=draw) - 0.5)
    for mapped in (True, False):
        numbers = numbers_of(words) | ({"map": image, "map_factor": number(1.0)} if mapped else {})
        leaves = {
            name: value.clone().requires_grad_() for name, value in numbers.items() if mapped or "map" not in name
        }
        hits = [hits_of(scene_of(words, leaves), CAMERAS["perspective"]) for _ in range(2)]
        for own, shade in zip(hits, (in_kernel.radiance, shading.reference), strict=True):
            L = shade(own, True, 1)
            grads = torch.autograd.grad(L.sum(), list(leaves.values()), materialize_grads=True)
            found.append({"": L, **dict(zip(leaves, grads, strict=True))})
    *those_mapped, kernels, twins = found
    for one, without in zip(those_mapped, (kernels, twins), strict=True):
        assert all(float(one.pop(name).abs().max()) == 0 for name in ("map", "map_factor", "map_scale"))
        assert all(torch.allclose(one[name], without[name], rtol=1e-9, atol=1e-9) for name in without)
    assert float(kernels["normals"].abs().max()) > 0.1


@pytest.mark.parametrize("words", SCENES)
def test_tangents_are_cotangents(words: str) -> None:
    leaves = numbers_of(words)
    w2c = CAMERAS["perspective"].world_to_camera.double()
    draw = torch.Generator().manual_seed(3)
    values = {**leaves, "w2c": w2c}
    tangents = {name: torch.randn(v.shape, dtype=F64, generator=draw) for name, v in values.items()}

    def radiance(given: Leaves) -> Tensor:
        scene = scene_of(words, {name: v for name, v in given.items() if name != "w2c"})
        return in_kernel.radiance(hits_of(scene, CAMERAS["perspective"].replace(world_to_camera=given["w2c"])), True, 1)

    found, moved = torch.func.jvp(radiance, (values,), (tangents,))[:2]
    assert not transformed()
    bar = torch.randn(found.shape, dtype=F64, generator=draw)
    (grads,) = torch.func.vjp(radiance, values)[1](bar)
    forward = float((bar * moved).sum())
    reverse = sum(float((grads[name] * tangents[name]).sum()) for name in values)
    size = sum(float((grads[name] * tangents[name]).abs().sum()) for name in values)
    assert abs(forward - reverse) < 1e-10 * size


def test_points_of_a_light_that_are_given() -> None:
    leaves = numbers_of("area environment point")
    scene = scene_of("area environment point", leaves)
    for light in range(3):
        hits = hits_of(scene, CAMERAS["perspective"])
        n = len(hits)
        points = scene.casting[light].draw(torch.rand(n, 3, dtype=F64, generator=torch.Generator().manual_seed(2)))
        lit = (torch.arange(n) % 2).double()
        forced = Forced(light, LightPoints(*points), lit, torch.ones(n, dtype=torch.bool))
        found = []
        for shade in (shading.reference, in_kernel.radiance):
            given = Hits(
                hits._surfaces, hits._view, hits._face, hits._exact, hits._pixel, seed=hits._seed, forced=forced
            )
            found.append(shade(given, True, 1))
        assert torch.allclose(*found, rtol=1e-12, atol=1e-12)


def test_what_one_light_adds() -> None:
    """Values and derivatives are those with the light less those in its shadow."""
    words = SCENES[-1].replace("microfacets ", "") + " area"
    for light in (0, 2, 4):
        of = []
        for lit, only in ((1, False), (0, False), (1, True)):
            leaves = {name: value.clone().requires_grad_() for name, value in numbers_of(words).items()}
            scene = scene_of(words, leaves)
            hits = hits_of(scene, CAMERAS["perspective"])
            n = len(hits)
            points = scene.casting[light].draw(torch.rand(n, 3, dtype=F64, generator=torch.Generator().manual_seed(2)))
            forced = Forced(light, points, torch.full((n,), lit, dtype=F64), torch.ones(n, dtype=torch.bool), only)
            place = hits._face, hits._exact, hits._pixel
            given = [Hits(hits._surfaces, hits._view, *place, seed=hits._seed, forced=forced) for _ in range(2)]
            L = in_kernel.radiance(given[0], True, 2)
            assert torch.allclose(shading.reference(given[1], True, 2), L, rtol=1e-12, atol=1e-12)
            of.append([L, *torch.autograd.grad(L.sum(), list(leaves.values()), materialize_grads=True)])
        for with_light, without, alone in zip(*of, strict=True):
            assert torch.allclose(
                with_light - without, alone, rtol=1e-9, atol=1e-9 * float(with_light.detach().abs().max())
            )
        assert float(of[2][0].detach().abs().max()) > 0.01


def test_tensors_from_which_no_graph_leads_to_a_result() -> None:
    """It may be the other of two outputs of one operation that leads there."""
    leaf, other = (torch.ones(4, 2, requires_grad=True) for _ in range(2))
    used, unused = (2 * leaf).unbind(1)
    left = unreached(3 * used, [used, unused, leaf, other, torch.ones(2)])
    assert [id(tensor) for tensor in left] == [id(unused), id(other)]


@pytest.mark.parametrize("view", CAMERAS)
def test_light_on_flat_faces(view: str) -> None:
    """E max(0, n·l) at corners, with the normal on the viewer's side; over the greatest."""
    leaves = numbers_of("point directional")
    scene = scene_of("point directional", leaves).replace(meshes=scene_of("point", leaves).meshes[:1])
    frame = ImageContext(scene, make_request(scene, CAMERAS[view], 2, 0))
    found = creases._flat_radiance(frame.fixed, 0, frame.fixed_view, indirect=False)
    (mesh,) = scene.meshes
    corner = mesh.verts[mesh.faces.long()]
    n = torch.nn.functional.normalize(
        torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), dim=1
    )
    towards = (n * frame.fixed_view.to_viewer(corner[:, 0])).sum(1, keepdim=True)
    n, told = torch.where(towards < 0, -n, n)[:, None], towards[:, 0].abs() > 1e-3  # of others the side is left open
    to_point = leaves["point"] - corner
    distance = to_point.norm(dim=-1)
    power = leaves["point_power"] * leaves["point_color"].mean()
    sun = -torch.nn.functional.normalize(leaves["sun"], dim=0)
    expected = torch.stack(
        [power / distance**3 * (n * to_point).sum(-1), leaves["sun_power"] * (n @ sun).expand(-1, 3)], -1
    ).clamp(min=0)
    assert found.shape == expected.shape
    assert int(told.sum()) > 250
    assert float((found - expected / expected.max())[told].abs().max()) < 1e-12


def test_without_shadows() -> None:
    words = SCENES[-1]
    scene = scene_of(words, numbers_of(words))
    dark, lit = (in_kernel.radiance(hits_of(scene, CAMERAS["perspective"]), shadows, 1) for shadows in (True, False))
    assert bool((lit >= dark - 1e-12).all()) and float((lit - dark).max()) > 0.01
    expected = shading.reference(hits_of(scene, CAMERAS["perspective"]), False, 1)
    assert torch.allclose(lit, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("known", [True, False])
def test_derivatives_without_values(known: bool) -> None:
    """Nothing is computed ahead of them where it is known of which lights shadows are asked; else that is found. Without an
    environment, whose points are others where only derivatives are wanted."""
    words = SCENES[-1].replace("environment ", "")
    found = []
    for values in (True, False):
        leaves = {name: value.clone().requires_grad_() for name, value in numbers_of(words).items()}
        hits = hits_of(scene_of(words, leaves), CAMERAS["perspective"])
        hits._needs_values = values
        lights = set(range(len(hits._surfaces.scene.casting)))
        hits._surfaces.shadowing.update(lights if known else ())
        radiance = in_kernel.radiance(hits, True, 1)
        assert hits._surfaces.shadowing == lights
        weights = torch.rand(radiance.shape, dtype=F64, generator=torch.Generator().manual_seed(3))
        found.append((radiance, torch.autograd.grad((weights * radiance).sum(), list(leaves.values()))))
    assert float(found[0][0].detach().abs().max()) > 0.1
    assert bool(found[1][0].detach().any()) != known
    assert all(torch.equal(a, b) for a, b in zip(found[0][1], found[1][1], strict=True))


def test_the_same_bits_on_any_number_of_threads() -> None:
    leaves = {name: value.clone().requires_grad_() for name, value in numbers_of(SCENES[-1]).items()}
    camera = CAMERAS["perspective"].resized((48, 48))

    def compute() -> list[Tensor]:
        radiance = in_kernel.radiance(hits_of(scene_of(SCENES[-1], leaves), camera), True, 1)
        return [radiance, *torch.autograd.grad(radiance.sum(), list(leaves.values()))]

    assert len(check_threads(compute)[0]) > 1024


def many_channels(leaves: Leaves, **material: Any) -> eg.Scene:
    mesh, C = icosphere(2), len(leaves["base"])
    mesh = eg.Mesh(mesh.verts.double(), mesh.faces, material=eg.Material(leaves["base"], **material))
    corner, across = torch.tensor([-0.5, 1.5, 1.0]).double(), torch.eye(3).double()
    emitter = eg.shapes.rectangle(
        corner,
        across[0],
        across[2],
        material=eg.Material(base_color=0.0, emission=torch.linspace(3.0, 1.0, C, dtype=F64)),
    )
    lights = [
        eg.lights.PointLight(torch.tensor([1.0, 2.0, 3.0]).double(), 9.0, leaves["color"]),
        eg.lights.Environment(leaves["sky"]),
    ]
    return eg.Scene([mesh, emitter], lights=lights)


def colors_of_many(channels: int) -> Leaves:
    wave = torch.arange(channels, dtype=F64)
    sky = 0.5 + 0.4 * torch.sin(wave + torch.arange(32, dtype=F64)[:, None]).reshape(4, 8, channels)
    return {"base": 0.5 + 0.4 * torch.cos(wave), "color": 1.5 + torch.sin(wave), "sky": sky}


def test_more_channels_than_the_kernel_takes_at_once() -> None:
    found = []
    for shade in (in_kernel.radiance, shading.reference):
        leaves = {name: value.requires_grad_() for name, value in colors_of_many(37).items()}
        L = shade(hits_of(many_channels(leaves), CAMERAS["perspective"]), True, 2)
        assert L.shape[1] == 37 and float(L.detach().min(0).values.max()) > 0
        found.append([L, *torch.autograd.grad(L.square().sum(), list(leaves.values()))])
    assert all(torch.allclose(a, b, rtol=1e-10, atol=1e-12) for a, b in zip(*found, strict=True))


def test_glossy_surfaces_of_many_channels_are_those_of_few() -> None:
    """Images and gradients, within their noise."""
    found = []
    for few in (False, True):
        leaves = {name: value[..., :3] if few else value for name, value in colors_of_many(20).items()}
        leaves = {name: value.clone().requires_grad_() for name, value in leaves.items()}
        scene = many_channels(leaves, metallic=0.8, roughness=0.15)
        if few:  # the area light's colour is that of the first channels
            emitter = (
                scene.meshes[1]
                .replace(material=None)
                .replace(material=eg.Material(base_color=0.0, emission=torch.linspace(3.0, 1.0, 20, dtype=F64)[:3]))
            )
            scene = scene.replace(meshes=[scene.meshes[0], emitter])
        image = eg.render(scene, CAMERAS["perspective"], spp=64, sampling=eg.Sampling(lights=4), seed=0)[..., :3]
        grads = torch.autograd.grad(image.mean(), list(leaves.values()))
        found.append([image.mean((0, 1)), grads[0][:3], grads[1][:3], grads[2][..., :3].sum((0, 1))])
    for a, b in zip(*found, strict=True):
        assert float((a - b).norm()) < 0.02 * float(b.norm()), (a, b)


def test_transparent_nearest_texels_are_shaded_as_in_pytorch() -> None:
    """So are their discontinuities, in the same order."""
    leaves = numbers_of("nearest texture base point area")
    scene = scene_of("nearest texture base point area", leaves)
    mesh, *others = scene.meshes
    assert mesh.material is not None
    material, alpha = dataclasses.replace(mesh.material, alpha_mode="BLEND"), torch.full((2, 2), 0.5, dtype=F64)
    scene = scene.replace(meshes=[mesh.replace(material=material, alpha=alpha), *others])
    assert not in_kernel.is_fused(scene)
    kernel, twin = (hits_of(scene, CAMERAS["perspective"]) for _ in range(2))
    assert torch.allclose(radiance.radiance(kernel), shading.reference(twin), rtol=1e-12, atol=1e-12)
    assert kernel._discontinuities.kinds == twin._discontinuities.kinds != []
    for a, b in zip(kernel._discontinuities.values, twin._discontinuities.values, strict=True):
        assert torch.equal(a.nan_to_num(), b.nan_to_num())


def test_which_scenes_the_kernel_shades() -> None:
    scene = scene_of("texture point", numbers_of("texture point"))
    mesh, ground = scene.meshes
    assert in_kernel.is_fused(scene)
    nearest = mesh.replace(filter="nearest")
    assert in_kernel.is_fused(scene.replace(meshes=[nearest, ground]))
    seen_through = nearest.replace(material=eg.Material(alpha_mode="BLEND"), alpha=torch.full((2, 2), 0.5, dtype=F64))
    assert not in_kernel.is_fused(scene.replace(meshes=[seen_through, ground]))
    assert mesh.texture is not None
    levels = seen_through.replace(filter="mipmap")
    assert in_kernel.is_fused(scene.replace(meshes=[levels, ground]))
    many = mesh.replace(texture=mesh.texture[..., :1].expand(-1, -1, 17).contiguous())
    assert not in_kernel.is_fused(eg.Scene([many], lights=scene.lights[:0]))
