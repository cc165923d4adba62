"""Scenes that are lit: shadows, random numbers of points, every way to render, and what has a gradient."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from finite_differences import rotation
from lit_scenes import F64, QUAD, ball, from_above, hits_of, picture, plane, uniform, vector
from oracles import reference
from torch import Tensor

import edgegrad as eg
from edgegrad.points.shadow_rays import Forced

EMITTING = eg.Material(base_color=0.0, emission=[3.0, 2.0, 1.0])
WHITE = eg.Material(base_color=1.0)


# -- shadows ----------------------------------------------------------------------------------------------------------------


def shadowed(light: Any, **options: Any) -> Tensor:
    blocker = eg.Mesh(plane(0.25).verts + vector(0, 0, 0.5), plane().faces, material=eg.Material(0.0))
    side = eg.Camera.look_at([0.0, -4.0, 2.0], [0.0, 0.0, 0.1], (0.0, 0.0, 1.0), 40.0, (16, 16))
    return eg.render(
        eg.Scene([plane(1.0, material=WHITE), blocker], lights=[light]), side, 64, **{"seed": 0, **options}
    )


@pytest.mark.parametrize("kind", ["directional", "point"])
def test_a_rectangle_casts_its_shadow(kind: str):
    """The share of points of the plane that is dark."""
    scene = eg.Scene(
        [plane(1.0, material=WHITE), eg.Mesh(plane(0.25).verts + vector(0, 0, 0.5), plane().faces)],
        lights=[
            eg.lights.DirectionalLight([0.0, 0.2, -1.0])
            if kind == "directional"
            else eg.lights.PointLight([0.1, 0, 1.0])
        ],
    )
    g = torch.Generator().manual_seed(0)
    xy = 2 * torch.rand((20_000, 2), dtype=F64, generator=g) - 1
    hits = eg.points.trace(scene, torch.cat([xy, torch.full((len(xy), 1), -1.0, dtype=F64)], 1), vector(0, 0, 1))
    (light,) = hits.lights
    lit = hits.visible_from(light, hits.light_points(light)) > 0
    low, high = (-0.25, 0.25) if kind == "directional" else (-0.6, 0.4)
    move = (0.0, 0.1) if kind == "directional" else (0.0, 0.0)
    size = 0.25 if kind == "directional" else 0.5
    inside = (xy[:, 0] > low) & (xy[:, 0] < high) & ((xy[:, 1] - move[1]).abs() < size)
    assert bool((lit == ~inside).all())


def test_an_emitter_does_not_hide_itself():
    """Its faces are thin triangles in one plane, seen at an angle."""
    emitter = eg.shapes.disc(
        [1.6, 0.0, 1.0], [0.3, 0.0, 0.0], [0.0, 0.3, 0.1], material=eg.Material(base_color=0.0, emission=5.0)
    )
    scene = eg.Scene([plane(1.0, material=WHITE), emitter])
    xy = 2 * uniform(20_000)[:, :2] - 1
    hits = eg.points.trace(scene, torch.cat([xy, torch.full((len(xy), 1), -1.0, dtype=F64)], 1), vector(0, 0, 1))
    (light,) = hits.lights
    assert bool((hits.visible_from(light, hits.light_points(light)) == 1).all())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_emitter_in_floats_does_not_hide_itself_in_a_scene_of_doubles(dtype: torch.dtype) -> None:
    emitter = eg.shapes.rectangle(
        vector(0.9, -0.6, 2.4),
        vector(0, 0.3, 0),
        vector(0.4, 0, 0.1),
        material=eg.Material(base_color=0.0, emission=8.0, two_sided=False),
    )
    ground = plane(material=eg.Material(base_color=0.7), colors=torch.ones((4, 1), dtype=F64))
    images = [
        eg.render(eg.Scene([ground, emitter.to(to)]), from_above(), spp=1, shadows=shadows, seed=0)
        for to, shadows in ((dtype, True), (F64, False))
    ]
    assert torch.allclose(*images, rtol=1e-5, atol=1e-7)


def test_options_of_shadows():
    light = eg.lights.DirectionalLight([0.0, 0.2, -1.0])
    with_, without = shadowed(light), shadowed(light, shadows=False)
    assert float(with_.sum()) < 0.99 * float(without.sum())
    for kwargs, error in (
        ({"shadows": 1}, TypeError),
        ({"sampling": {"lights": 1}}, TypeError),
    ):
        with pytest.raises(error, match=next(iter(kwargs))):
            shadowed(light, **kwargs)
    light = eg.lights.Environment([1.0])
    noise = [
        torch.stack([shadowed(light, sampling=eg.Sampling(lights=n), seed=seed) for seed in range(6)])
        .var(0)
        .mean()
        .sqrt()
        for n in (1, 16)
    ]
    assert noise[1] < 0.4 * noise[0]


def test_forced_shadows():
    scene = eg.Scene([plane(material=WHITE)], lights=[eg.lights.PointLight([0.0, 0, 1]), eg.lights.Environment([1.0])])
    hits = hits_of(scene, 4)
    light = hits.lights[1]
    drawn = hits.light_points(light)
    some = torch.tensor([True, False, True, False])
    hits._forced = Forced(1, drawn._replace(density=drawn.density * 7), vector(0, 0, 1, 1), some)
    order = torch.tensor([2, 1, 0])
    part = hits._subset(order)
    torch.testing.assert_close(part.light_points(light).density / drawn.density[order], vector(7, 1, 7))
    lit = part.visible_from(light, drawn.select(order))
    assert torch.equal(lit, vector(1, 1, 0))
    assert bool((part.visible_from(hits.lights[0], hits.lights[0].draw(uniform(3))) == 1).all())
    with pytest.raises(ValueError, match=r"light: expected one of hits\.lights"):
        hits.light_points(eg.lights.PointLight([0.0, 0, 1]))


# -- random numbers ---------------------------------------------------------------------------------------------------------


def test_random_numbers_of_points():
    scene = eg.Scene([plane(material=WHITE)])
    hits = hits_of(scene, 4096)
    u = hits.random(3)
    assert u.shape == (4096, 3) and bool(((u >= 0) & (u < 1)).all())
    cells = ((u * 4).long() * torch.tensor([16, 4, 1])).sum(1).bincount(minlength=64)
    assert cells.min() > 44 and cells.max() < 84  # 64 each: more even than chance, where they reach from 40 to 90
    assert torch.equal(hits.select(torch.tensor([7, 3])).random(3), u[[7, 3]])
    assert not torch.equal(hits.random(3, 1), u)


def test_random_numbers_of_a_pixel_are_its_own():
    """A change in one corner leaves the noise of all other pixels as it is, with a constant seed."""
    emitter = eg.shapes.rectangle((0.0, -0.5, 1.5), (0.2, 0.0, 0.1), (0.0, -0.2, 0.0), material=EMITTING, dtype=F64)
    floor, dot = plane(1.0, material=WHITE), ball(0, material=WHITE).transformed(scale=0.1, t=vector(-0.8, 0.8, 0.1))
    images = [
        eg.render(eg.Scene(m, lights=[emitter]), from_above(), shadows=False, seed=0) for m in ([floor], [floor, dot])
    ]
    same = (images[0] == images[1]).all(2)
    assert bool(same[4:].all()) and bool(same[:, 4:].all()) and not bool(same[:4, :4].all())


def test_points_of_lights_are_well_spread_between_pixels():
    """A pixel's neighbours find the light that it misses: blocks of 2 × 2 have less than half of the noise that independent
    points would leave."""
    scene = eg.Scene([plane(material=WHITE)], lights=[eg.lights.Environment(torch.ones(16, 32, 1, dtype=F64))])
    images = torch.stack([eg.render(scene, from_above(32), spp=1, seed=seed) for seed in range(4)])[..., 0]
    of_pixels, of_blocks = (float(torch.nn.functional.avg_pool2d(images - images.mean(), k).std()) for k in (1, 2))
    assert of_pixels > 0.1 and of_blocks < 0.45 * of_pixels


# -- scenes -----------------------------------------------------------------------------------------------------------------


def all_lights() -> list[Any]:
    return [
        eg.lights.DirectionalLight([0.3, 0.2, -1.0]), eg.lights.PointLight([0.5, 0.5, 1.5], 2.0),
        eg.lights.SpotLight([-0.5, 0.5, 1.5], [0.2, -0.2, -1.0], 2.0), eg.lights.Environment(picture()),
        eg.lights.SphericalHarmonics(0.1 * picture(3, 3).reshape(9, 3)),
        eg.shapes.rectangle([0.0, -0.5, 1.5], [0.2, 0.0, 0.1], [0.0, -0.2, 0.0], material=EMITTING, dtype=F64),
    ]  # fmt: skip


def everything() -> tuple[eg.Scene, eg.Camera]:
    floor = plane(1.0, material=eg.Material(0.6, metallic=0.3, roughness=0.5)).transformed(t=vector(0, 0, -0.5))
    thing = ball(1, material=WHITE).transformed(scale=0.4)
    camera = eg.Camera.look_at([0.5, -3.0, 2.0], [0.0, 0.0, 0.0], (0.0, 0.0, 1.0), 45.0, (16, 16)).to(F64)
    return eg.Scene([floor, thing], lights=all_lights()), camera


def test_moved_scenes_look_the_same():
    scene, camera = everything()
    R, t, scale = rotation((0.6, 0.0, 0.8), vector(0.8).sum()), vector(1, 2, 3), 2.5
    back = torch.eye(4, dtype=F64)
    back[:3, :3], back[:3, 3] = R.T / scale, -R.T @ t / scale
    w = camera.world_to_camera.to(F64) @ back
    there = camera.replace(world_to_camera=torch.cat([w[:3] * scale, w[3:]]))
    images = [eg.render(scene, camera, seed=3), eg.render(scene.transformed(R, t, scale), there, seed=3)]
    # A ray may meet another face than before: compared in the mean of 4 × 4 pixels.
    small = [torch.nn.functional.avg_pool2d(image.permute(2, 0, 1), 4) for image in images]
    torch.testing.assert_close(*small, rtol=0.03, atol=0.01)
    for light in (eg.lights.Environment([1.0]), eg.lights.SphericalHarmonics(torch.ones(9, 1))):
        with pytest.raises(ValueError, match="R: expected a rotation"):
            light.transformed(2 * torch.eye(3))


def test_a_light_moved_by_a_matrix_that_enlarges():
    light = eg.lights.PointLight(vector(0, 0, 1), 3.0)
    twice = light.transformed(2 * rotation((0.0, 0.0, 1.0), vector(0.3).sum()))
    assert float(twice.intensity) == pytest.approx(float(light.transformed(scale=2.0).intensity)) == pytest.approx(12.0)


def test_a_scene_of_materials_without_a_light_says_so():
    scene = eg.Scene([plane(material=eg.Material(0.5))])
    with pytest.warns(UserWarning, match="scene: no light falls"):
        assert float(eg.render(scene, from_above(4), spp=1, seed=0).abs().max()) == 0


def test_to_and_detach_take_everything_along():
    scene, _ = everything()
    leaf = vector(1.0).sum().requires_grad_()
    scene = scene.replace(lights=[eg.lights.PointLight([0.0, 0, 1], leaf), *scene.lights])
    assert not any(
        t.requires_grad for light in scene.detach().lights for t in vars(light).values() if isinstance(t, Tensor)
    )
    small = scene.to(torch.float32)
    assert all(
        t.dtype == torch.float32 for light in small.lights for t in vars(light).values() if isinstance(t, Tensor)
    )
    material = small.meshes[0].material
    assert material is not None and isinstance(material.roughness, Tensor) and material.roughness.dtype == torch.float32
    assert "PointLight" in repr(scene)


def test_renders_in_every_way():
    scene, camera = everything()
    image = eg.render(scene, camera, 4, seed=0)
    assert image.dtype == F64 and torch.equal(image, eg.render(scene, camera, 4, seed=0))
    single = eg.render(scene.to(torch.float32), camera.to(torch.float32), 4, seed=0)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double().mean(), image.mean(), rtol=0.02, atol=0)
    batch = camera.replace(world_to_camera=camera.world_to_camera.expand(2, 4, 4))
    assert eg.render(scene, batch, 4, seed=0).shape == (2, 16, 16, 3)
    aovs = eg.render_aovs(scene, camera, ["alpha", "image", "mesh_id"], 4, seed=0)
    assert list(aovs) == ["alpha", "image", "mesh_id"] and torch.equal(aovs["image"], image)
    plan = eg.plan(scene, camera, 4, sampling=eg.Sampling(lights=3))
    assert plan["lights"].on and plan["shadows"].on and "9 points of lights" in plan["lights"].why
    assert not eg.plan(scene, camera, shadows=False)["shadows"].on
    with pytest.raises(ValueError, match="screen_gradient: expected a scene without materials"):
        eg.screen_gradient(scene, camera, image, seed=0)
    with pytest.raises(ValueError, match="reference: expected a scene without materials"):
        reference.render(scene, camera)
    with pytest.raises(ValueError, match="intensity: expected numbers, got a meta tensor"):
        eg.render(
            scene.replace(lights=[eg.lights.PointLight([0.0, 0, 1], torch.ones((), device="meta"))]), camera, seed=0
        )


def test_forward_mode_is_reverse_mode():
    scene, camera = everything()
    values = {"position": vector(0.5, 0.5, 1.5), "roughness": vector(0.5).sum(), "verts": scene.meshes[1].verts}

    def of(position: Tensor, roughness: Tensor, verts: Tensor) -> eg.Scene:
        floor, thing, *rest = scene.meshes
        floor = floor.replace(material=eg.Material(0.6, metallic=0.3, roughness=roughness))
        return eg.Scene(
            [floor, thing.replace(verts=verts), *rest], lights=[eg.lights.PointLight(position, 2.0), *scene.lights]
        )

    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    image = eg.render(of(**leaves), camera, 4, seed=0)
    g = torch.Generator().manual_seed(2)
    dots = {name: torch.randn((2, *v.shape), dtype=F64, generator=g) for name, v in values.items()}
    moved = of(**values)
    material = moved.meshes[0].material
    assert material is not None
    own = {"position": moved.lights[0].position, "roughness": material.roughness, "verts": moved.meshes[1].verts}
    _, image_dot = eg.jvp(moved, camera, {own[name]: dots[name] for name in own}, 4, seed=0)
    weight = torch.randn(image.shape, dtype=F64, generator=g)
    by = dict(zip(leaves, torch.autograd.grad((image * weight).sum(), list(leaves.values())), strict=True))
    reverse = sum((dots[name] * by[name]).reshape(2, -1).sum(1) for name in by)
    assert isinstance(reverse, Tensor)
    torch.testing.assert_close((image_dot * weight).reshape(2, -1).sum(1), reverse)


def test_one_number_for_all_channels():
    """One number counts for each channel of lights of every kind."""
    make: list[Callable[[Any], Any]] = [
        lambda c: (
            eg.lights.PointLight([1.0, 0, 1], c) if isinstance(c, float) else eg.lights.PointLight([1.0, 0, 1], color=c)
        ),
        eg.lights.Environment,
        lambda c: eg.lights.SphericalHarmonics(torch.ones(9, 1) * torch.as_tensor(c)),
        lambda c: eg.shapes.rectangle(
            [1.0, 0, 1], [0.2, 0, 0], [0, 0.2, 0], material=eg.Material(base_color=0.0, emission=c)
        ),
    ]
    for light in make:
        images = [
            eg.render(eg.Scene([ball(1, material=WHITE)], lights=[light(c)]), from_above(8), 1, seed=0)
            for c in (2.0, torch.full((3,), 2.0))
        ]
        assert torch.equal(*images) and images[0].any()


def test_a_visible_environment_is_the_background():
    radiance = picture(4, 8).requires_grad_()
    far = plane(0.3, material=eg.Material(0.0)).transformed(t=vector(0, 0, -3))
    turned = vector(0.0).sum().requires_grad_()

    def image(radiance: Tensor, turned: Tensor) -> Tensor:
        w2c = torch.eye(4, dtype=F64)
        w2c = torch.cat(
            [
                torch.cat(
                    [torch.diag(vector(1, -1, -1)) @ rotation((0.0, 1.0, 0.0), turned), vector(0, 0, 0)[:, None]], 1
                ),
                w2c[3:],
            ]
        )
        camera = eg.Camera(w2c, torch.tensor([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]], dtype=F64), (16, 16))
        return eg.render(eg.Scene([far], lights=[eg.lights.Environment(radiance)]), camera, seed=0)

    found = image(radiance, turned)
    pixels = torch.arange(16, dtype=F64)
    y, x = torch.meshgrid(pixels, pixels, indexing="ij")
    exact: Any = 0
    for dx in (0.25, 0.75):
        for dy in (0.25, 0.75):
            d = torch.stack([(x + dx - 8) / 8, -(y + dy - 8) / 8, -torch.ones_like(x)], -1).reshape(-1, 3)
            exact = exact + eg.lights.Environment(radiance).towards(d).reshape(16, 16, 3) / 4
    torch.testing.assert_close(found[:, :3], exact[:, :3])
    weight = picture(16, 16, 9)
    weight[4:12] = 0  # away from the thing, whose silhouette moves too
    by = torch.autograd.grad((found * weight).sum(), [radiance, turned], retain_graph=True)
    torch.testing.assert_close(by[0], torch.autograd.grad((exact * weight).sum(), radiance)[0])
    h = 1e-5
    with torch.no_grad():
        high, low = ((image(radiance, vector(k * h).sum()) * weight).sum() for k in (1, -1))
    torch.testing.assert_close(by[1], (high - low) / (2 * h), rtol=1e-4, atol=0)
    hidden = eg.lights.Environment(radiance, visible=False)
    assert float(eg.render(eg.Scene([far], lights=[hidden]), from_above(), seed=0).detach().abs().sum()) == 0
    shown = eg.render(eg.Scene([far], vector(1, 2, 3), lights=[eg.lights.Environment(radiance)]), from_above(), seed=0)
    torch.testing.assert_close(shown[0, 0], vector(1, 2, 3))


# -- gradients --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["lit", "mipmap", "shader"])
def test_second_derivatives_raise_before_a_background(kind: str) -> None:
    """The part through coverage, which the image's own graph does not have, raises, too."""
    uvs = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    texture = torch.rand(8, 8, 3, dtype=F64)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    verts, background = QUAD.clone().requires_grad_(), torch.rand(3, dtype=F64, requires_grad=True)
    mesh = eg.Mesh(
        verts, faces, texture=texture, uvs=uvs, uv_faces=faces, filter="mipmap" if kind == "mipmap" else "linear"
    )
    mesh = mesh.replace(material=WHITE) if kind == "lit" else mesh
    lights = [eg.lights.PointLight(torch.zeros(3, dtype=F64), 3.0)] if kind == "lit" else []
    camera = eg.Camera.look_at((0.0, 0, -2), (0.0, 0, 1), size=(16, 16))
    shader = (lambda hits: hits.sample(texture)) if kind == "shader" else None
    image = eg.render(eg.Scene([mesh], background, lights), camera, spp=4, shader=shader, seed=0)
    (gradient,) = torch.autograd.grad(image.pow(3).sum(), background, create_graph=True)
    with pytest.raises(RuntimeError, match="second derivatives"):
        torch.autograd.grad(gradient.sum(), verts)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_gradient_of_the_image_that_is_not_finite_is_named(bad: float) -> None:
    """It is named as without lights, whether or not a sample lies there."""
    verts = QUAD.clone().requires_grad_()
    mesh = eg.Mesh(verts, torch.tensor([[0, 1, 2], [0, 2, 3]]), material=WHITE)
    camera = eg.Camera.look_at((0.0, 0, -2), (0.0, 0, 1), size=(16, 16))
    image = eg.render(
        eg.Scene([mesh], lights=[eg.lights.PointLight(torch.zeros(3, dtype=F64), 3.0)]), camera, spp=4, seed=0
    )
    adjoint = torch.zeros_like(image)
    adjoint[1, 14, 2] = bad
    with pytest.raises(ValueError, match=r"the gradient of the image: expected finite numbers, got .* at \[1, 14, 2\]"):
        image.backward(adjoint)


def test_leaves_of_lights_stay_leaves() -> None:
    power = torch.tensor(3.0, dtype=F64, requires_grad=True)
    assert eg.lights.PointLight(torch.zeros(3, dtype=F64), power).intensity is power


@pytest.mark.parametrize("filter", ["linear", "mipmap"])
def test_nothing_in_view_has_gradients_of_zero(filter: str):
    """A loop goes on where the mesh has left the image, or no light falls on it, as without lights."""
    for place, light in ((100, eg.lights.PointLight), (100, eg.lights.SphericalHarmonics), (0, eg.lights.PointLight)):
        verts, texels = ball(1).verts.clone().requires_grad_(), picture().requires_grad_()
        uvs, faces = torch.rand(3, 2), torch.arange(3).expand(len(ball(1).faces), 3)
        emitter = (
            torch.tensor([0, 0, -5], dtype=F64) if light is eg.lights.PointLight else torch.ones((9, 3), dtype=F64)
        )
        material = eg.Material(eg.Texture(texels, uvs, faces, filter=filter))
        mesh = ball(1).replace(verts=verts, material=material).transformed(t=vector(place, 0, 0))
        image = eg.render(eg.Scene([mesh], lights=[light(emitter.requires_grad_())]), from_above(8), spp=4, seed=0)
        for own in torch.autograd.grad(image.sum(), [verts, texels, emitter]):
            assert float(own.abs().max()) == 0


def test_emitters_that_are_masked_are_said_to_lack_a_gradient() -> None:
    floor, alpha = plane(material=eg.Material()), torch.eye(4, dtype=F64)
    emitter = plane(0.5, material=eg.Material(emission=1.0, two_sided=True), alpha=alpha).transformed(t=vector(0, 0, 1))
    moving = emitter.replace(alpha=alpha.clone().requires_grad_())
    with pytest.warns(UserWarning, match="an alpha edge ends a mesh that emits"):
        eg.render(eg.Scene([floor, moving]), from_above(), seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        eg.render(eg.Scene([floor, emitter]), from_above(), seed=0)
        leaf = moving.replace(material=eg.Material())
        eg.render(eg.Scene([floor, leaf], lights=[eg.lights.PointLight(vector(0.3, 0.2, 3))]), from_above(), seed=0)
