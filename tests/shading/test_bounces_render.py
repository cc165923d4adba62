"""render(bounces=n): light that is scattered more than once, against closed forms and a path tracer of the tests' own."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from path_oracle import PathOracle
from room_scenes import ROOMS as ALL_ROOMS
from room_scenes import box_room, emitter, quad, towards_room, vector
from scenes import icosphere
from torch import Tensor

import edgegrad as eg
from edgegrad.kernel.request import make_request
from edgegrad.light import in_kernel, radiance
from edgegrad.points.image_context import ImageContext

F64 = torch.float64
ROOMS: dict[str, dict[str, Any]] = {
    "emitter": {},
    "point": {"lights": "point", "metallic": 1.0, "roughness": 0.4},
    "sky": {"lights": "sky", "floor": {"base_color": vector(0.8, 0.6, 0.4), "metallic": 0.7, "roughness": 0.5}},
    "light glossy": {"floor": {"base_color": vector(0.8, 0.6, 0.4), "metallic": 0.5, "roughness": 0.5}},
}


def check_points(room: str, bounces: int, rows: tuple[int, ...], paths: int) -> None:
    """Points of the image against the oracle; four standard errors of both."""
    scene = box_room(**ROOMS[room])
    frame = ImageContext(scene, make_request(scene, towards_room(8), 1, 0))
    ((_, found),) = frame.sampler.pixel_hits(1 << 40)
    for row in rows:
        same = torch.full((paths,), row)
        place = found.face[same], frame.sampler.rays_at(found.x[same]), found.x[same]
        with torch.no_grad():
            hits = frame.moving_hits(*place, frame.seeds("image", paths))
            L = in_kernel.indirect(hits, True, bounces)
            expected, error = PathOracle(scene).indirect(
                int(found.face[row]), hits.position[0], hits.view[0], bounces, paths
            )
        own_error = L.std(0) / paths**0.5
        assert bool((error < 0.06 * expected).all()) and float(expected.min()) > 0.005
        assert bool(((L.mean(0) - expected).abs() < 4 * (error**2 + own_error**2).sqrt()).all()), (
            row,
            L.mean(0),
            expected,
        )


@pytest.mark.parametrize("room", ["emitter", pytest.param("point", marks=pytest.mark.slow)])
def test_points(room: str) -> None:
    check_points(room, 3, (20, 55), 30_000)


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [2, 4])
@pytest.mark.parametrize("room", ROOMS)
def test_points_of_all_rooms(room: str, bounces: int) -> None:
    check_points(room, bounces, (20, 45, 55), 300_000)


# Shares of the radiance are drawn in two ways where a path may meet a light (csrc/shading/lit/path.h); with two light samples
# nothing is, each point has one path, and no pixel is asked again.
@pytest.mark.watched
@pytest.mark.parametrize("room", ["sky", "sky through an opening", "large light"])
def test_images_whose_points_have_several_paths(room: str) -> None:
    scene, camera = ALL_ROOMS[room](), towards_room(12)
    with torch.no_grad():
        several, single = (
            torch.stack(
                [eg.render(scene, camera, 16, seed, bounces=2, sampling=eg.Sampling(lights=n)) for seed in range(16)]
            ).mean((1, 2))
            for n in (1, 2)
        )
    error = ((several.var(0) + single.var(0)) / 16).sqrt()  # of the mean over the image, by channels
    assert bool((error < 0.01 * single.mean(0)).all())
    assert bool(((several.mean(0) - single.mean(0)).abs() < 4 * error).all())


def furnace(albedo: Tensor) -> eg.Scene:
    """The inside of a sphere that emits 1: within it, light from all of it is the same everywhere."""
    ball = icosphere(2)
    return eg.Scene([eg.Mesh(ball.verts.double(), ball.faces, material=eg.Material(albedo, emission=1.0))])


@pytest.mark.parametrize("bounces", [1, 8])
def test_white_furnace(bounces: int) -> None:
    albedo = torch.full((3,), 0.8, dtype=F64, requires_grad=True)
    camera = eg.Camera.look_at((0.3, 0.1, 0.2), (1.0, 0.4, 0.1), fov_y=60.0, size=(32, 32))
    image = eg.render(furnace(albedo), camera, 16, bounces=bounces, sampling=eg.Sampling(surface=20_000), seed=0).mean()
    (gradient,) = torch.autograd.grad(image, albedo)
    expected = sum(0.8**k for k in range(bounces + 1))
    slope = sum(k * 0.8 ** (k - 1) for k in range(1, bounces + 1))
    assert abs(float(image.detach()) / expected - 1) < 0.01
    assert abs(float(gradient.sum()) / slope - 1) < 0.01


@pytest.mark.watched
def test_gradients_of_a_room() -> None:
    """Radiance is linear in the emission, and each colour's derivative is that of images with other colours."""
    leaves = {"wall": vector(0.7, 0.15, 0.1), "emission": vector(6.0, 5.4, 4.2)}
    camera, weights = towards_room(16), torch.rand(16, 16, 3, dtype=F64, generator=torch.Generator().manual_seed(1))

    def loss(wall: Tensor, emission: Tensor, **options: Any) -> Tensor:
        room = box_room()
        red, shining = room.meshes[2], room.meshes[-1]
        meshes = [*room.meshes[:2], red.replace(material=eg.Material(wall)), *room.meshes[3:-1]]
        meshes.append(shining.replace(material=eg.Material(0.0, emission=emission, two_sided=False)))
        return (weights * eg.render(eg.Scene(meshes), camera, 256, 0, bounces=3, **options)).sum()

    wall, emission = (leaf.clone().requires_grad_() for leaf in leaves.values())
    value = loss(wall, emission, sampling=eg.Sampling(surface=40_000))
    by_wall, by_emission = torch.autograd.grad(value, [wall, emission])
    assert abs(float((by_emission * emission).sum() / value.detach()) - 1) < 0.02
    step = torch.full((3,), 0.1, dtype=F64)
    with torch.no_grad():
        up, down = (loss(wall + sign * step, emission) for sign in (1, -1))
    assert abs(float((by_wall * step).sum() / ((up - down) / 2)) - 1) < 0.02


def test_one_bounce_is_direct_light_and_more_add_to_it() -> None:
    scene, camera = box_room(), towards_room(12)
    images = [eg.render(scene, camera, 16, bounces=n, seed=0) for n in (1, 2, 3)]
    assert torch.equal(images[0], eg.render(scene, camera, 16, seed=0))
    means = [float(image.mean()) for image in images]
    assert means[0] < 0.95 * means[1] < 0.95 * means[2]
    alone = eg.Scene([quad((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0), base_color=0.5), emitter()])
    flat = [eg.render(alone, towards_room(12), 16, bounces=n, seed=0).mean() for n in (1, 2)]
    assert torch.allclose(*flat, rtol=0.02)  # nothing scatters to the floor: the light is black


def test_channels_batches_and_transforms() -> None:
    color = vector(0.6, 0.5, 0.4)
    camera = towards_room(8)

    def image(color: Tensor) -> Tensor:
        return eg.render(box_room("point", floor={"base_color": color}), camera, 4, bounces=3, seed=0)

    found, moved = torch.func.jvp(image, (color,), (torch.ones(3, dtype=F64),))
    leaf = color.clone().requires_grad_()
    assert torch.equal(found, image(leaf).detach())
    (gradient,) = torch.autograd.grad(image(leaf).sum(), leaf)
    assert abs(float(moved.sum()) - float(gradient.sum())) < 1e-9 * float(gradient.sum())
    scene = box_room("point")
    assert torch.equal(
        eg.render(scene, camera, 4, bounces=3, seed=0),
        eg.render_aovs(scene, camera, ["image"], 4, bounces=3, seed=0)["image"],
    )
    pair = eg.render(scene, eg.Camera.stack([camera, camera]), 4, bounces=3, seed=0)
    assert torch.allclose(pair[0].mean(), pair[1].mean(), rtol=0.1) and torch.equal(
        pair[0], eg.render(scene, camera, 4, bounces=3, seed=0)
    )


def test_borders_without_samples_are_refused() -> None:
    scene, camera = box_room("point"), towards_room(8)
    mesh, *others = scene.meshes
    leaf = mesh.verts.clone().requires_grad_()
    uvs = {"uvs": mesh.verts[:, :2], "uv_faces": mesh.faces}
    half = torch.full((2, 2), 0.5, dtype=F64)

    def room(verts: Tensor, light: Tensor | None = None, **fields: Any) -> eg.Scene:
        lights = [scene.lights[0].replace(position=vector(0.5, -0.3, 1.7) if light is None else light)]
        return scene.replace(meshes=[mesh.replace(verts=verts, **fields), *others], lights=lights)

    sheet = {**uvs, "alpha": half, "material": eg.Material(0.5, alpha_mode="BLEND")}
    nearest = eg.Texture(torch.rand(2, 2, 3, dtype=F64), filter="nearest", uvs=leaf[:, :2], uv_faces=mesh.faces)
    moved_light = room(mesh.verts, vector(0, 0, 1).requires_grad_(), **sheet)
    verts = r"meshes\[0\].verts"
    for other, name, why in (
        (room(leaf, **sheet), verts, "sees through"),
        (moved_light, r"lights\[0\].position", "sees through"),
        (room(mesh.verts, material=eg.Material(nearest)), r"uvs of a nearest texture of meshes\[0\]", "nearest texels"),
    ):
        for function in (eg.render, eg.plan):
            with pytest.raises(ValueError, match=f"bounces: {name} requires a gradient.*{why}"):
                function(other, camera, 4, bounces=2)
    # Without borders there is nothing to leave out; and direct light has all of them.
    assert eg.render(room(leaf, **sheet), camera, 4, bounces=3, visibility=False, seed=0).requires_grad
    assert eg.render(room(leaf, **sheet), camera, 4, seed=0).requires_grad
    with torch.no_grad():
        eg.render(room(leaf, **sheet), camera, 4, bounces=3, seed=0)
    with pytest.raises(ValueError, match="bounces: expected an int from 1"):
        eg.render(scene, camera, 4, bounces=0, seed=0)


def test_creases_that_no_light_reaches_directly() -> None:
    """The front and the top of the block, both turned away from a point light, show different light of the walls."""
    scene = box_room("point")
    scene = scene.replace(lights=[scene.lights[0].replace(position=vector(0.0, 0.9, 0.1))])
    frame = ImageContext(scene, make_request(scene, towards_room(8), 1, 0))
    first = frame.fixed.first_faces[4]
    differ = []
    for bounces in (1, 2):
        frame.fixed.jumping.clear()
        radiance.note_jumps(frame.no_hits, bounces > 1)
        attributes = frame.fixed.crease_attributes()[first : first + 12]
        differ.append(bool((attributes[2] != attributes[5]).any()))
    assert differ == [False, True]


@pytest.mark.parametrize("bounces", [2, 4])
def test_what_moves(bounces: int) -> None:
    scene, camera = box_room("emitter"), towards_room(8)
    leaves = [mesh.verts.clone().requires_grad_() for mesh in scene.meshes]
    moved = scene.replace(meshes=[mesh.replace(verts=v) for mesh, v in zip(scene.meshes, leaves, strict=True)])
    pose = camera.world_to_camera.clone().requires_grad_()
    image = eg.render(moved, camera.replace(world_to_camera=pose), 4, bounces=bounces, seed=0)
    gradients = torch.autograd.grad(image.sum(), [*leaves, pose])
    assert all(bool(gradient.isfinite().all()) and float(gradient.abs().sum()) > 0 for gradient in gradients)


def test_plan() -> None:
    color = vector(0.6, 0.5, 0.4).requires_grad_()
    scene = box_room("point", floor={"base_color": color})
    direct, indirect = (eg.plan(scene, towards_room(8), 4, bounces=n) for n in (1, 3))
    assert not direct["bounces"].on and indirect["bounces"].on
    assert indirect["bounces"].samples == 2 * 2 * indirect["interior"].samples
    # Each has a noisy path.
    assert indirect["interior"].samples == pytest.approx(4 * direct["interior"].samples, abs=4)
