"""How large and how small numbers may be: within the range of float32 all is right, beyond it there is an error."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from scenes import cube
from torch import Tensor

import edgegrad as eg

F32, F64 = torch.float32, torch.float64
LARGEST = torch.finfo(F32).max
ARGUMENTS = ("verts", "colors", "background", "world_to_camera", "K")
ADJOINT = torch.linspace(-1.0, 1.0, 12 * 12 * 3, dtype=F64).reshape(12, 12, 3)


def good(projection: str) -> dict[str, Tensor]:
    camera = eg.Camera.look_at(torch.tensor([1.0, 1.5, 3.0], dtype=F64), (0.0, 0.0, 0.0), size=(12, 12))
    K = torch.tensor([[16.0, 0, 6], [0, 16, 6], [0, 0, 1]], dtype=F64) if projection == "perspective" else camera.K
    return {
        "verts": cube().verts,
        "colors": cube().colors,
        "background": torch.tensor([0.1, 0.2, 0.3], dtype=F64),
        "world_to_camera": camera.world_to_camera,
        "K": K,
    }


def scaled(values: dict[str, Tensor], world: float, image: float = 1.0) -> dict[str, Tensor]:
    """Return the same in other units of length and of radiance."""
    pose = values["world_to_camera"].clone()
    pose[:3, 3] *= world
    radiance = {name: image * values[name] for name in ("colors", "background")}
    return {**values, **radiance, "verts": world * values["verts"], "world_to_camera": pose}


def image_and_gradients(
    values: dict[str, Tensor], projection: str = "perspective", adjoint: float = 1.0
) -> dict[str, Tensor]:
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    mesh = eg.Mesh(leaves["verts"], cube().faces, colors=leaves["colors"])
    camera = eg.Camera(leaves["world_to_camera"], leaves["K"], (12, 12), projection)
    image = eg.render(eg.Scene(mesh, leaves["background"]), camera, 8, seed=0)
    image.backward((adjoint * ADJOINT).to(image.dtype))
    return {"image": image.detach(), **{name: leaf.grad for name, leaf in leaves.items()}}


def check_close(found: dict[str, Tensor], expected: dict[str, Tensor], factors: dict[str, float], tolerance: float):
    for name, value in expected.items():
        value = value.double()
        got = found[name].double() / factors.get(name, 1.0)
        assert float((got - value).abs().max()) <= tolerance * float(value.abs().max()), name
        assert bool(value.any())


@pytest.mark.parametrize("dtype, tolerance", [(F32, 2e-4), (F64, 1e-11)])
@pytest.mark.parametrize("power", [-36, -20, 20, 36])
def test_units_of_length(power: int, dtype: torch.dtype, tolerance: float):
    scale = 10.0**power
    values = {name: value.to(dtype) for name, value in scaled(good("perspective"), scale).items()}
    expected = image_and_gradients(good("perspective"))
    found = image_and_gradients(values)
    found["world_to_camera"] = found["world_to_camera"].double()
    found["world_to_camera"][:3, 3] *= scale
    # One by a length.
    check_close(found, expected, {"verts": 1.0 / scale}, tolerance)


@pytest.mark.parametrize("radiance, adjoint", [(1e37, 1e37), (1e-37, 1e37), (1e37, 1e-30), (1e-30, 1e-30)])
@pytest.mark.parametrize("world", [1e-37, 1.0, 1e37])
def test_products_of_extremes(world: float, radiance: float, adjoint: float):
    """Lengths, radiance and adjoint at the ends of the range at once; what comes out is beyond it, in double."""
    expected = image_and_gradients(good("perspective"))
    found = image_and_gradients(scaled(good("perspective"), world, radiance), adjoint=adjoint)
    found["world_to_camera"][:3, 3] *= world
    both = radiance * adjoint
    factors = {"image": radiance, "verts": both / world, "colors": adjoint, "background": adjoint}
    # Where the adjoint is not zero is kept in float, which moves samples a little.
    check_close(found, expected, {**factors, "world_to_camera": both, "K": both}, 2e-3)


def shaded(world: float, shader: Callable[[eg.points.Hits], Tensor] | None) -> tuple[Tensor, Tensor]:
    """The image of two metal faces under a light in other units of length, and its gradient by their vertices in these units."""
    corners = torch.tensor([[-1.0, -0.9, 0.1], [1.0, -0.8, 0.0], [0.9, 1.0, 0.5], [-1.0, 0.8, 0.3]])
    verts, faces = (world * corners).requires_grad_(), torch.tensor([[0, 1, 2], [0, 2, 3]])
    above = world * (0.4 * corners + torch.tensor([1.0, 0.5, 2.0]))
    emitter = eg.Mesh(above, faces, material=eg.Material(emission=torch.tensor([5.0, 4.0, 3.0])))
    metal = eg.Mesh(verts, faces, material=eg.Material(metallic=1.0, roughness=0.5))
    scene = eg.Scene([metal, emitter], lights=[eg.lights.DirectionalLight(torch.tensor([0.2, -0.3, -1.0]), 3.0)])
    image = eg.render(scene, eg.Camera.look_at((0, 0, 4 * world), (0, 0, 0), size=(12, 12)), shader=shader, seed=0)
    image.backward(ADJOINT.to(image.dtype))
    assert verts.grad is not None
    return image.detach(), world * verts.grad


def irradiance(hits: eg.points.Hits) -> Tensor:
    emitter = hits.lights[1]
    points = hits.light_points(emitter)
    return emitter.arriving(points, hits.position) * emitter.incident(points, hits.position)


@pytest.mark.parametrize(
    "shader",
    [None, lambda hits: hits.normal, lambda hits: hits.shading_normal, lambda hits: hits.view, irradiance],
    ids=["materials", "normal", "shading normal", "view", "irradiance"],
)
@pytest.mark.parametrize("power", [-17, -7, 11, 17])
def test_units_of_length_of_what_is_shaded(shader: Callable[[eg.points.Hits], Tensor] | None, power: int):
    """Areas are squares of lengths, and the lengths of normals squares of areas, which floats soon cannot hold. Where within a
    pixel a shader is asked is a matter of rounding: up to 0.6 %."""
    for found, expected in zip(shaded(10.0**power, shader), shaded(1.0, shader), strict=True):
        assert float((found - expected).abs().max()) <= 1e-2 * float(expected.abs().max()) > 0.0


@pytest.mark.parametrize("world", [1e-17, 1e17])
def test_units_of_length_of_vertex_normals(world: float):
    verts, faces = cube().verts.float(), cube().faces
    assert torch.allclose(
        eg.Mesh(world * verts, faces).vertex_normals(), eg.Mesh(verts, faces).vertex_normals(), atol=1e-6
    )


@pytest.mark.parametrize("power", [-37, 37])
def test_units_of_an_orthographic_camera(power: int):
    values = scaled(good("orthographic"), 10.0**power)
    values["K"] = torch.tensor([[4.0 / 10.0**power, 0, 6], [0, 4.0 / 10.0**power, 6], [0, 0, 1]], dtype=F64)
    plain = good("orthographic")
    plain["K"] = torch.tensor([[4.0, 0, 6], [0, 4.0, 6], [0, 0, 1]], dtype=F64)
    expected, found = image_and_gradients(plain, "orthographic"), image_and_gradients(values, "orthographic")
    for name in ("image", "colors", "background"):
        torch.testing.assert_close(found[name], expected[name], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found["verts"] * 10.0**power, expected["verts"], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("value", [3.5e38, -1.7e308])
@pytest.mark.parametrize("name", ARGUMENTS)
def test_beyond_the_range_is_refused(name: str, value: float):
    """Two numbers that cancel in a sum are refused, too."""
    values = good("perspective")
    malformed = values[name].clone()
    at = {"world_to_camera": 7, "K": 2}.get(name, 1)
    malformed.view(-1)[at] = value
    cancelling = torch.cat([malformed[:1], -malformed[:1], malformed[2:]]) if name in ("verts", "colors") else malformed
    for tensor in (malformed, cancelling):
        with pytest.raises(ValueError, match=rf"{name}: expected numbers up to 3\.4e\+38, got .*; choose other units"):
            image_and_gradients({**values, name: tensor})


def test_the_ends_of_the_range_are_in_it():
    verts = torch.tensor([[LARGEST, 0, 0], [0, LARGEST, 0], [-LARGEST, -LARGEST, 0]], dtype=F64)
    for dtype in (F32, F64):
        assert eg.Mesh(verts.to(dtype), [[0, 1, 2]]).verts.dtype == dtype
    for small in (0.0, 2e-38):
        eg.Mesh(verts * 0 + small, [[0, 1, 2]])
    uvs = torch.full((3, 2), 1e9, dtype=F64)
    for dtype in (F32, F64):
        eg.Mesh(verts, [[0, 1, 2]], texture=torch.rand(2, 2, 3), uvs=uvs.to(dtype), uv_faces=[[0, 1, 2]])
        with pytest.raises(ValueError, match=r"uvs: expected numbers up to 1e\+09, got .* at \[0, 0\] \(6 such"):
            eg.Mesh(verts, [[0, 1, 2]], texture=torch.rand(2, 2, 3), uvs=1.1 * uvs.to(dtype), uv_faces=[[0, 1, 2]])


def test_a_mesh_too_small_to_see():
    """Its areas have no double: it would render nothing, whatever the camera."""
    with pytest.raises(
        ValueError, match=r"verts: expected numbers of which some are above 1e-38, .* got .*e-39 at \[0, 0"
    ):
        eg.Mesh(cube().verts * 1e-38, cube().faces)
    with pytest.raises(ValueError, match="verts: expected numbers of which some are above"):
        eg.Mesh(cube().verts * 1e-200, cube().faces)


@pytest.mark.parametrize("value", [3.5e38, 1e200])
def test_adjoints_beyond_the_range_are_refused(value: float):
    with pytest.raises(ValueError, match="the gradient of the image: expected"):
        image_and_gradients(good("perspective"), adjoint=value)


def test_focal_lengths_of_which_the_inverse_is_beyond_the_range():
    K = torch.tensor([[1e-30, 0, 0], [0, 1e30, 0], [0, 0, 1]], dtype=F64)
    eg.Camera(torch.eye(4, dtype=F64), K, (4, 4))
    for fx, fy in ((1e-39, 1.0), (1e-170, 1e-170), (1.0, 1e-300)):
        tiny = torch.tensor([[fx, 0, 0], [0, fy, 0], [0, 0, 1]], dtype=F64)
        with pytest.raises(ValueError, match="K: expected focal lengths that are not zero, got a singular matrix"):
            eg.Camera(torch.eye(4, dtype=F64), tiny, (4, 4))


@pytest.mark.parametrize("dtype, tolerance", [(F32, 1e-7), (F64, 1e-15)])
@pytest.mark.parametrize("distance", [1e-37, 3e-30, 1e-20, 1e10, 3e30, 1e38])
def test_look_at_from_any_distance(distance: float, dtype: torch.dtype, tolerance: float):
    direction = torch.tensor([0.48, -0.6, 0.64], dtype=F64)
    expected = eg.Camera.look_at(direction, (0.0, 0.0, 0.0)).world_to_camera
    for up in (1e-37, 1.0, 1e37):
        eye = (distance * direction).to(dtype)
        camera = eg.Camera.look_at(eye, (0.0, 0.0, 0.0), (0.0, up, 0.0))
        assert camera.world_to_camera.dtype == dtype
        error = (camera.world_to_camera[:3, :3].double() - expected[:3, :3]).abs().max()
        assert float(error) <= 2 * tolerance
        torch.testing.assert_close(
            camera.world_to_camera[:3, 3].double() / distance, expected[:3, 3], rtol=1e-6, atol=2 * tolerance
        )


def test_gradient_of_look_at():
    def pose(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
        return eg.Camera.look_at(eye, target, up).world_to_camera

    inputs = [
        torch.tensor(v, dtype=F64, requires_grad=True) for v in ([0.3, -0.4, 0.8], [0.1, 0.2, 0.3], [0.1, 2, 0.2])
    ]
    assert torch.autograd.gradcheck(pose, inputs)


@pytest.mark.parametrize("function", [eg.plan, eg.profile])
def test_wrong_options_name_the_function_that_was_called(function):
    camera = eg.Camera.look_at((1.0, 1.5, 3.0), (0.0, 0.0, 0.0), size=(4, 4))
    with pytest.raises(TypeError, match=rf"^{function.__name__}: expected only the options .*filter.*, got 'bogus'"):
        function(cube(), camera, bogus=1)
    function(cube(), camera, filter="tent")


@pytest.mark.parametrize("brightness", [1e-37, 1e37])
def test_skies_of_any_brightness(brightness: float):
    """Beside images, for which no number is too large, samples of gradients go by them."""
    radiance = torch.full((2, 4, 1), brightness, requires_grad=True)
    ball = cube().replace(colors=None, material=eg.Material(metallic=1.0, roughness=0.5))
    camera = eg.Camera.look_at((1.0, 1.5, 3.0), (0.0, 0.0, 0.0), size=(12, 12))
    image = eg.render(eg.Scene([ball], lights=[eg.lights.Environment(radiance)]), camera, seed=0)
    image.mean().backward()
    assert radiance.grad is not None
    # The image is linear in the sky.
    total = float((radiance.grad.double() * radiance.detach().double()).sum()) / float(image.detach().double().mean())
    assert total == pytest.approx(1.0, rel=0.03)
