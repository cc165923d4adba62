"""Shadows on a floor that the camera does not see: it sees the ceiling, which the floor lights. What casts them stands aside,
where it comes between no two points of both, and is black: all that its motion changes is where the shadows end."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from bounce_scenes import F64, QUAD, adjoint, indirect_change, indirect_gradient, mesh, seen_from
from finite_differences import Case, right_ratio, rotation
from room_scenes import vector
from threads import check_threads
from torch import Tensor

import edgegrad as eg

PLACE = (-3.0, 1.2, 0.2)
FEW = {"sampling": eg.Sampling(surface=4_000, edges=16_000)}


def bright_spot() -> Tensor:
    """An environment that is bright towards −X, a little above the horizon."""
    image = torch.zeros(16, 32, 1, dtype=F64)
    image[6, 7:9] = 40.0
    return image


def lights_of(kind: str, theta: Tensor) -> tuple[list[eg.Mesh], list[Any]]:
    """Meshes that emit, and other lights."""
    # So that what a point light gives the floor stays nearly the same, and the shadow's border is all that changes.
    shift = theta * (vector(-0.2, 0.5, 0.0) if kind == "point" else vector(0.5, 0.0, 0.2))
    place, towards = vector(*PLACE) + shift, vector(-3.0, 1.3, 0.2) + shift
    if kind == "emitter":
        half, up = vector(0, 0, 0.25), vector(0.1, 0.2, 0)
        corners = torch.stack([place + half + up, place - half + up, place - half - up, place + half - up])
        return [mesh(corners, [[0, 2, 1], [0, 3, 2]], 0.0, 30.0)], []
    if kind == "point":
        return [], [eg.lights.PointLight(place, 9.0)]
    if kind == "spot":
        return [], [eg.lights.SpotLight(place, vector(3.0, -1.2, 0.0), 9.0, inner_angle=0.3, outer_angle=0.6)]
    if kind == "directional":
        return [], [eg.lights.DirectionalLight(-towards, 3.0)]
    return [], [eg.lights.Environment(bright_spot(), rotation((0.0, 0.6, 0.8), 0.3 * theta), visible=False)]


def case_of(kind: str, moved: str, **of_floor: Any) -> Case:
    """θ makes the caster larger, or shifts the light or the floor; the shadows stay within the floor."""

    def case(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        by = {name: theta if name == moved else torch.zeros((), dtype=F64) for name in ("caster", "light", "floor")}
        corners = vector(-1.8, 0.62, 0.2) + (1 + by["caster"]) * torch.tensor(
            [[0, -0.12, -0.2], [0, -0.12, 0.2], [0.05, 0.12, 0.2], [0.05, 0.12, -0.2]], dtype=F64
        )
        square = torch.tensor([[-1.0, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]], dtype=F64)
        floor = mesh(1.4 * square + by["floor"] * vector(0.0, 1.0, 0.2), QUAD, 0.8)
        if of_floor:
            floor = floor.replace(material=eg.Material(**of_floor))
        ceiling = mesh(square + vector(0, 1.5, 0), QUAD, 0.6)
        emitters, lights = lights_of(kind, by["light"])
        camera = seen_from((0.1, 0.3, 0.0), (0.0, 1.5, 0.05), 0.8)
        return eg.Scene([floor, ceiling, mesh(corners, QUAD, 0.0), *emitters], lights=lights), camera

    return case


def check(case: Case, spp: int, seeds: int, h: float = 0.2, bounces: int = 2, **samples: Any) -> None:
    change = indirect_change(case, h, spp, seeds, bounces)
    print(right_ratio(change, indirect_gradient(case, h, seeds, bounces, **samples)))


def test_a_caster_before_an_emitter() -> None:
    check(case_of("emitter", "caster"), 128, 4, **FEW)


def test_a_point_light_moves() -> None:
    check(case_of("point", "light"), 128, 4, **FEW)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["point", "spot", "directional", "sky"])
def test_lights_that_move(kind: str) -> None:
    check(case_of(kind, "light"), 1024, 8, **{name: 8 * n for name, n in FEW.items()})


@pytest.mark.slow
@pytest.mark.parametrize("moved", ["caster", "floor"])
@pytest.mark.parametrize("kind", ["emitter", "point", "spot", "directional", "sky"])
def test_surfaces_that_move(kind: str, moved: str) -> None:
    check(case_of(kind, moved), 1024, 8, **{name: 8 * n for name, n in FEW.items()})


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [3, 4])
def test_more_bounces(bounces: int) -> None:
    check(case_of("emitter", "caster"), 1024, 8, bounces=bounces, **{name: 4 * n for name, n in FEW.items()})


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [0.5, 0.2])
def test_glossy_floor(roughness: float) -> None:
    case = case_of("point", "caster", metallic=0.5, roughness=roughness)
    check(case, 2048, 8, **{name: 16 * n for name, n in FEW.items()})


@pytest.mark.watched
def test_both_modes_and_any_number_of_threads() -> None:
    case, zero = case_of("emitter", "caster"), torch.zeros((), dtype=F64)

    def image(theta: Tensor) -> Tensor:
        return eg.render(*case(theta), 1, 0, bounces=3, sampling=eg.Sampling(surface=2_000, edges=1_000))

    def derivatives() -> tuple[Tensor, Tensor]:
        moved: Tensor = torch.func.jvp(image, (zero,), (torch.ones_like(zero),))[1]
        theta = zero.clone().requires_grad_()
        return moved, torch.autograd.grad((adjoint()[:, :, None] * image(theta)).sum(), theta)[0]

    forward, reverse = check_threads(derivatives)
    assert float((adjoint()[:, :, None] * forward).sum() / reverse) == pytest.approx(1, abs=1e-9)


def test_plan() -> None:
    row = "indirect shadow boundaries"

    def moving(name: str) -> tuple[eg.Scene, eg.Camera]:
        return case_of("emitter", name)(torch.zeros((), dtype=F64, requires_grad=True))

    scene, camera = moving("caster")
    assert (
        not eg.plan(scene, camera, 16)[row].on and not eg.plan(scene, camera, 16, bounces=2, visibility=False)[row].on
    )
    assert eg.plan(scene, camera, 16, bounces=2)[row].samples == 32 * 32 * 16 // 8
    assert eg.plan(scene, camera, 16, bounces=2, sampling=eg.Sampling(edges=70))[row].samples == 70
    still, _ = case_of("emitter", "nothing")(torch.zeros((), dtype=F64))
    turned = camera.replace(K=camera.K.clone().requires_grad_())
    assert not eg.plan(still, turned, 16, bounces=2)[row].on
