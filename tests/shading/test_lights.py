"""Lights: what arrives from them against closed forms and quadrature, images of a plane, gradients, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from finite_differences import Case, check, gradient, rotation
from lit_scenes import (
    F64,
    QUAD,
    ball,
    by_quadrature,
    directions,
    from_above,
    grid,
    picture,
    plane,
    polygon_irradiance,
    uniform,
    vector,
)
from sampling_options import with_sampling
from torch import Tensor
from torch.autograd import gradcheck

import edgegrad as eg
from edgegrad.scene.spherical_harmonics import harmonics

WHITE = eg.Material(base_color=1.0)


HERE = torch.tensor([[0.1, 0.2, 0.0], [0.4, -0.3, 0.1], [-0.6, 0.1, 0.2]], dtype=F64)


def emitter(verts: Tensor, emission: Tensor, two_sided: bool = True) -> Any:
    """The light of an emissive mesh, as the scene has it."""
    mesh = eg.Mesh(
        verts, torch.tensor([[0, 1, 2], [0, 2, 3]]), material=eg.Material(0.0, emission=emission, two_sided=two_sided)
    )
    return eg.Scene([mesh]).casting[0]


LIGHTS: dict[str, tuple[Callable[..., Any], list[Tensor]]] = {
    "directional": (eg.lights.DirectionalLight, [vector(0.3, -0.2, -1), vector(2).sum(), vector(1, 0.5, 0.2)]),
    "point": (eg.lights.PointLight, [vector(0.3, 0.2, 1), vector(2).sum(), vector(1, 0.5, 0.2)]),
    "spot": (
        eg.lights.SpotLight,
        [
            vector(0.3, 0.2, 1),
            vector(-0.2, 0.1, -1),
            vector(2).sum(),
            vector(1, 0.5, 0.2),
            vector(0.1).sum(),
            vector(0.9).sum(),
        ],
    ),
    "area": (emitter, [QUAD, picture(1, 4)[0]]),
    "environment": (eg.lights.Environment, [picture(), rotation((0.0, 1.0, 0.0), vector(0.5).sum())]),
}


@pytest.mark.parametrize("kind", LIGHTS)
def test_what_arrives_has_right_derivatives(kind: str):
    make, values = LIGHTS[kind]
    points = make(*values).draw(uniform(3))
    leaves = [value.clone().requires_grad_() for value in values]

    def of(*values: Tensor) -> tuple[Tensor, ...]:
        *own, position = values
        if kind == "environment":
            # Only rotations are taken: by the angle about an axis.
            own[1] = rotation((0.0, 1.0, 0.0), own[1][0, 2])
        light = make(*own)
        arriving = light.arriving(points, position)
        if kind == "area":
            # The density is that of where the faces are, by their areas now: so this is what is integrated over barycentrics.
            arriving = arriving * light._area(points.index).detach().norm(dim=1, keepdim=True)
        return light.place(points), arriving

    assert gradcheck(of, (*leaves, HERE.clone().requires_grad_()))


def test_points_of_an_environment_have_their_density():
    light = eg.lights.Environment(picture(5, 7), rotation((1.0, 0.0, 0.0), vector(0.7).sum()))
    points = light.draw(uniform(200_000))
    assert math.isclose(float((1 / points.density).mean()), 4 * math.pi, rel_tol=0.005)
    d = light.place(points)
    torch.testing.assert_close(d.norm(dim=1), torch.ones(len(d), dtype=F64))
    # What arrives is what is seen there, over the density.
    arriving = light.arriving(points, d)
    torch.testing.assert_close(arriving * points.density[:, None], light.towards(d))
    up, angle = directions(400)
    whole = torch.cat([light.towards(up), light.towards(-up)]).sum(0) * angle
    torch.testing.assert_close(arriving.mean(0), whole, rtol=0.004, atol=0)
    # A texel is where its row and column say: +Y on top, −Z in the middle, +X to the right.
    image = torch.zeros(8, 16, 1, dtype=F64)
    image[0], image[3:5, 7:9], image[3:5, 11:13] = 1, 2, 3
    seen = eg.lights.Environment(image).towards(torch.tensor([[0, 1, 0], [0, 0, -1], [1, 0, 0], [-1, 0, 0]], dtype=F64))
    torch.testing.assert_close(seen[:, 0], vector(1, 2, 3, 0))


@pytest.mark.parametrize("image", [False, True])
def test_directions_above_a_surface_give_the_same_irradiance(image: bool) -> None:
    """All of them do, with less noise."""
    seeded = torch.Generator().manual_seed(3)
    radiance = torch.rand((9, 16, 1), dtype=F64, generator=seeded) ** 3 if image else vector(1.0)
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -0.3, 0.5], [0.3, 0, -0.2], [-0.5, 0.2, 0]], dtype=F64))
    sky = eg.lights.Environment(radiance, rotation=turn)
    points = sky.draw(torch.rand((200_000, 3), dtype=F64, generator=seeded))
    direction = sky.place(points)
    again = sky.points_at(direction)
    assert torch.allclose(sky.place(again), direction, atol=1e-12)
    assert torch.equal(again.density, points.density)
    normal = torch.nn.functional.normalize(vector(0.3, 0.5, -0.4), dim=0)
    above = sky.above(points, normal.expand(len(direction), 3))
    cosine = sky.place(above) @ normal
    assert float(cosine.min()) >= 0
    half = sky.arriving(points, direction)[:, 0] * (direction @ normal).clamp(min=0)
    whole = sky.arriving(above, direction)[:, 0] * cosine
    assert float(whole.std()) < 0.7 * float(half.std())
    assert abs(float(whole.mean() - half.mean())) < 4 * float(half.std()) / len(direction) ** 0.5


@pytest.mark.parametrize("kind", ["constant", "image", "image of both signs", "point", "directional", "emission"])
def test_negative_light_takes_away_what_it_would_give(kind: str):
    """An optimisation may pass there: images are linear in radiance and intensity, also below zero."""
    rows = picture() - (0.7 if kind == "image of both signs" else 0.0)
    make: dict[str, Callable[[Tensor], Any]] = {
        "constant": lambda scale: eg.lights.Environment(scale * rows[0, 0]),
        "point": lambda scale: eg.lights.PointLight(vector(1, 2, 3), 5 * scale),
        "directional": lambda scale: eg.lights.DirectionalLight(vector(0, -1, -1), 5 * scale),
        "emission": lambda scale: eg.shapes.rectangle(
            vector(0, 0, 3),
            vector(1, 0, 0),
            vector(0, 1, 0),
            material=eg.Material(base_color=0.0, emission=scale * rows[0, 0]),
        ),
    }
    light = make.get(kind, lambda scale: eg.lights.Environment(scale * rows))

    def image(sign: float) -> tuple[Tensor, Tensor]:
        scale = torch.tensor(sign, dtype=F64, requires_grad=True)
        mesh = ball(1).replace(material=eg.Material(0.8, metallic=0.5, roughness=0.6))
        made = eg.render(eg.Scene([mesh], torch.zeros(3), lights=[light(scale)]), from_above(8), spp=4, seed=0)
        return made.detach(), torch.autograd.grad(made.sum(), scale)[0]

    (above, slope), (below, same) = image(1.0), image(-1.0)
    assert float(above.abs().max()) > 0.05
    torch.testing.assert_close(below, -above)
    torch.testing.assert_close(same, slope)


def test_dark_texels_and_dark_faces_are_drawn_too():
    image = torch.zeros(2, 4, 1, dtype=F64)
    image[0, 0] = 1e6
    assert eg.lights.Environment(image).draw(uniform(2000)).index.bincount(minlength=8).min() > 0
    assert eg.lights.Environment(0 * image).draw(uniform(2000)).index.bincount(minlength=8).min() > 50
    assert emitter(QUAD, vector(0.0)).draw(uniform(2000)).index.bincount(minlength=2).min() > 500


def test_area_light_is_the_closed_form_and_so_is_its_gradient():
    """Vertices move, too: points stay at their barycentrics, while areas change."""
    flat = QUAD.clone()
    flat[:, 2] = 1.0 + 0.2 * flat[:, 0]
    verts = flat.clone().requires_grad_()
    place, normal = vector(0.1, 0.2, 0.0), torch.nn.functional.normalize(vector(0.1, -0.2, 1), dim=0)
    light = emitter(verts, vector(1.0))
    points = light.draw(uniform(200_000))
    there = light.place(points)
    assert light.mesh.verts is verts
    l = torch.nn.functional.normalize(there - place, dim=1)
    found = (light.arriving(points, place.expand(len(l), 3))[:, 0] * (l @ normal)).mean()
    # Faces of a bent quad are apart: the sum of two triangles. Seen from below they run clockwise.
    exact = sum(-polygon_irradiance(verts[rows].flip(0), place, -normal) for rows in ([0, 1, 2], [0, 2, 3]))
    assert isinstance(exact, Tensor)
    torch.testing.assert_close(found, exact.abs(), rtol=0.005, atol=0)
    by_found, by_exact = (torch.autograd.grad(value, verts, retain_graph=True)[0] for value in (found, exact.abs()))
    torch.testing.assert_close(by_found, by_exact, rtol=0.01, atol=0.005 * float(by_exact.abs().max()))


def test_area_light_of_one_side():
    behind = emitter(QUAD, vector(1.0), two_sided=False)
    points = behind.draw(uniform(10))
    assert (behind.arriving(points, HERE[:1].expand(10, 3)) == 0).all()
    assert (behind.arriving(points, vector(0, 0, 5).expand(10, 3)) > 0).all()


def image_of(light: Any, material: eg.Material = WHITE, **options: Any) -> Tensor:
    lights = light if isinstance(light, list) else [light]
    return eg.render(eg.Scene([plane(material=material)], lights=lights), from_above(), **{"seed": 0, **options})


def test_directional_light_on_a_plane():
    image = image_of(eg.lights.DirectionalLight([3.0, 0.0, -4.0], 2.0, [1.0, 0.5, 0.25]), eg.Material(base_color=0.5))
    torch.testing.assert_close(image, (vector(1, 0.5, 0.25) * 0.5 * 2 * 0.8 / math.pi).expand(16, 16, 3))


def test_directions_of_any_length() -> None:
    """Any length but zero will do."""
    scene = plane(material=eg.Material(base_color=0.5))
    images = [
        eg.render(
            eg.Scene([scene], lights=[eg.lights.DirectionalLight(length * vector(0.3, 0.2, -1.0))]),
            from_above(),
            seed=0,
        )
        for length in (1.0, 1e-14, 1e-30, 1e30)
    ]
    assert images[0].max() > 0.1
    for image in images[1:]:
        assert torch.allclose(image, images[0], rtol=1e-6)


def test_point_light_on_a_plane_in_closed_form():
    position = vector(0.3, -0.2, 1.0)
    image = torch.stack([image_of(eg.lights.PointLight(position, 3.0), seed=seed) for seed in range(8)]).mean(0)
    r = (position - grid()).norm(dim=-1)
    exact = (3.0 * position[2] / r**3 / math.pi).mean(-1)
    torch.testing.assert_close(image[..., 0], exact, rtol=0.1, atol=0)  # a pixel's point is drawn at random within it
    torch.testing.assert_close(image[..., 0].mean(), exact.mean(), rtol=0.005, atol=0)


def test_spot_light_has_the_cone_of_gltf():
    spot = eg.lights.SpotLight([0.0, 0, 1], [0.0, 0, -2], 3.0, inner_angle=0.3, outer_angle=0.7)
    point = eg.lights.PointLight([0.0, 0, 1], 3.0)
    angle = vector(0.0, 0.29, 0.5, 0.71)
    there = torch.stack([angle.tan(), 0 * angle, 0 * angle], 1)
    points = spot.draw(uniform(4))
    share = spot.arriving(points, there) / point.arriving(points, there)
    ramp = (math.cos(0.5) - math.cos(0.7)) / (math.cos(0.3) - math.cos(0.7))
    torch.testing.assert_close(share[:, 0], vector(1, 1, ramp**2, 0))


def test_spherical_harmonics_are_orthonormal_and_give_irradiance():
    up, angle = directions(200)
    Y = torch.stack(harmonics(torch.cat([up, -up])), -1)
    torch.testing.assert_close(Y.T @ Y * angle, torch.eye(9, dtype=F64), atol=1e-4, rtol=0)
    coefficients = torch.zeros(9, 3, dtype=F64)
    coefficients[0], coefficients[2] = 2.0, 1.0
    turn = rotation((1.0, 0.0, 0.0), vector(math.pi / 2).sum())
    n = torch.eye(3, dtype=F64)
    own = eg.lights.SphericalHarmonics(coefficients)
    assert own.irradiance(n)[2, 0] > own.irradiance(n)[0, 0]
    torch.testing.assert_close(
        eg.lights.SphericalHarmonics(coefficients, turn).irradiance(n @ turn.T), own.irradiance(n)
    )
    image = image_of(own, eg.Material(base_color=0.5))
    torch.testing.assert_close(image, (own.irradiance(n)[2] * 0.5 / math.pi).expand(16, 16, 3))


# -- gradients inside faces --------------------------------------------------------------------------------------------------


def by_light(name: str) -> Case:
    def case(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        move = theta * vector(0.3, 0.5, 0.8)
        light = {
            "cone": lambda: eg.lights.SpotLight(
                vector(0.4, 0.3, 2.0), vector(-0.1, 0, -1), 4.0, None, 0.1, 0.5 + 0.3 * theta
            ),
            "emitter": lambda: eg.shapes.rectangle(
                vector(1.6, 0.7, 1.5) + move,
                [0.3, 0, 0],
                [0, 0.3, 0],
                material=eg.Material(base_color=0.0, emission=4.0),
            ),
            "radiance": lambda: eg.lights.Environment(picture() * (1 + theta), visible=False),
        }[name]()
        floor = plane(1.0, material=eg.Material([0.5, 0.6, 0.7], metallic=0.2, roughness=0.5))
        return eg.Scene([floor], lights=[light]), from_above(16, 1.9)

    return case


@pytest.mark.parametrize(
    "name", ["cone", *(pytest.param(name, marks=pytest.mark.slow) for name in ("emitter", "radiance"))]
)
def test_gradients_by_lights_are_finite_differences(name: str):
    wide = name in ("emitter", "radiance")
    options = {"shadows": False, "sampling": eg.Sampling(lights=8 if wide else 1)}
    exact = by_quadrature(
        by_light(name), 1e-3, 4 if name == "emitter" else 8, shadows=False, lights_each=8 if wide else 1
    )
    check(
        name,
        exact,
        gradient(by_light(name), 12 if name == "radiance" else 4, **with_sampling(options, surface=10_000, edges=500)),
    )


# -- what is refused --------------------------------------------------------------------------------------------------------

MESH = plane(material=WHITE)

REFUSED: list[tuple[Callable[[], Any], type[Exception], str]] = [
    (lambda: eg.lights.DirectionalLight([0.0, 0, 0]), ValueError, "direction: expected a direction, got zeros"),
    (lambda: eg.lights.DirectionalLight([0.0, 1]), ValueError, r"direction: expected shape \(3,\)"),
    (lambda: eg.lights.PointLight("here"), TypeError, "position: expected"),
    (lambda: eg.lights.PointLight([0.0, 0, float("nan")]), ValueError, "position: expected finite"),
    (lambda: eg.lights.PointLight([0.0, 0, 1], [1.0, 2.0]), ValueError, "intensity: expected one number.*color="),
    (lambda: eg.lights.SpotLight([0.0, 0, 1], [0, 0, -1.0], torch.ones(1, 3)), ValueError, "give the colour as color="),
    (lambda: eg.lights.DirectionalLight([0.0, 0, 1], (1, 2, 3)), ValueError, "give the colour as color="),
    (lambda: eg.lights.PointLight([0.0, 0, 1], 1.0, 3.0), ValueError, "color: expected shape.*is intensity="),
    (lambda: eg.lights.SpotLight([0.0, 0, 1], [0, 0, -1.0], inner_angle=1.0), ValueError, "inner_angle: expected 0 ≤"),
    (lambda: eg.lights.SpotLight([0.0, 0, 1], [0, 0, -1.0], outer_angle=2.0), ValueError, "outer_angle"),
    (lambda: eg.lights.Environment(torch.ones(4, 3)), ValueError, "radiance: expected shape.*one channel is"),
    (lambda: eg.lights.Environment([1.0], 2 * torch.eye(3)), ValueError, "rotation: expected a rotation"),
    (lambda: eg.lights.Environment([1.0], visible=1), TypeError, "visible: expected True or False"),
    (lambda: eg.lights.SphericalHarmonics(torch.ones(4, 3)), ValueError, r"coefficients: expected shape \(9, C\)"),
    (lambda: eg.lights.SphericalHarmonics(torch.ones(9)), ValueError, r"of one, coefficients\[:, None\]"),
    (lambda: eg.shapes.disc(segments=2), ValueError, "segments: expected an int from 3"),
    (lambda: eg.Scene([MESH], lights=3), TypeError, "lights: expected a sequence"),
    (lambda: eg.Scene([MESH], lights=[3]), TypeError, r"lights\[0\]: expected a light"),
    (
        lambda: eg.Scene([MESH], lights=[MESH]),
        ValueError,
        r"lights\[0\]: expected a light, got a Mesh without emission",
    ),
    (
        lambda: eg.Scene(
            [MESH], lights=[eg.lights.PointLight([0.0, 0, 1], 1.0, [1.0, 2]), eg.lights.Environment([1.0, 2, 3])]
        ),
        ValueError,
        r"lights\[1\]: expected 2 channels",
    ),
]


@pytest.mark.parametrize(("make", "error", "text"), REFUSED)
def test_what_is_refused(make: Callable[[], Any], error: type[Exception], text: str):
    with pytest.raises(error, match=text):
        make()
