"""The examples find what they look for, in fewer steps than they take, some from smaller pictures."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from example_modules import FOLDER, example


def test_a_texture_and_its_light() -> None:
    pictures, before, after = example("harmonics", size=64).fit(steps=20)
    assert after < 0.5 * before
    assert len(pictures) == 3


@pytest.mark.slow
def test_a_network_and_the_shape_under_it() -> None:
    network = example("network", size=48)
    _, tube = network.fit(steps=45)
    assert abs(tube - network.TRUE_TUBE) < 0.5 * abs(network.FIRST_TUBE - network.TRUE_TUBE)


@pytest.mark.slow
def test_declared_discontinuities() -> None:
    step = example("step", size=64)
    _, found = step.fit(steps=50)
    assert torch.allclose(found.centre, step.TRUTH.centre, atol=0.02)
    assert abs(found.radius - step.TRUTH.radius) < 0.02
    assert abs(found.stripe - step.TRUTH.stripe) < 0.004


@pytest.mark.slow
def test_a_sun_and_a_pose() -> None:
    sun = example("sun")
    camera = sun.view(48)
    found = sun.fit(sun.picture(sun.TRUTH, camera, seed=10_000, seeds=8), camera, steps=60)
    degrees_of_sun, degrees, distance = found.errors(sun.TRUTH)
    assert degrees_of_sun < 4 and degrees < 3 and distance < 0.15


@pytest.mark.slow
def test_an_environment_in_a_mirror() -> None:
    mirror = example("mirror")
    _, found = mirror.fit(steps=60, size=32)
    assert mirror.error(found) < 0.4 * mirror.error(torch.full_like(found, 0.4))


@pytest.mark.slow
def test_a_shape_and_its_shadow() -> None:
    _, shape, found = example("shadow").fit(steps=72, size=32)
    before, after = ((d - shape.truth()).square().mean().sqrt() for d in (torch.full_like(found, 0.45), found))
    assert after < 0.4 * before


@pytest.mark.slow
def test_a_pose_of_which_a_quarter_is_covered() -> None:
    pose = example("pose")
    before, after, fit = pose.trial(pose.objects.pebble(64, 3), "covered", seed=1, size=64)
    assert before > 10.0 and after < 1.0 and fit.converged and fit.explained < 0.9


@pytest.mark.slow
def test_a_focal_length_and_a_pose() -> None:
    focal = example("focal")
    before, after, fit = focal.trial(focal.objects.pebble(64, 3), seed=2, size=96)
    assert abs(before) > 3.0 and abs(after) < 1.0 and fit.converged


@pytest.mark.slow
def test_a_texture() -> None:
    texture = example("texture")
    mesh = texture.objects.pebble(64, 3)
    found = texture.fit(mesh, size=64, texels=64, steps=40, progress=False)
    assert texture.held_out(mesh, found.mesh, size=64) > 25.0


@pytest.mark.slow
def test_a_pose_before_an_unknown_background() -> None:
    pose = example("pose")
    _, after, fit = pose.trial(pose.objects.pebble(), "unknown", seed=1, size=128)
    assert after < 1.0 and fit.converged


@pytest.mark.slow
def test_a_shape() -> None:
    shape = example("shape")
    stone = shape.stone(4)
    found = shape.fit(stone, views=8, size=96, levels=2, steps=60, progress=False)
    assert shape.chamfer(found.mesh, stone) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("given", ["depths", "sensor"])
def test_a_shape_from_six_depth_maps(given: str) -> None:
    shape = example("shape")
    stone = shape.stone(5)
    found = shape.fit(stone, views=6, size=96, given=given, steps=80, progress=False)
    assert shape.chamfer(found.mesh, stone) < 0.3


@pytest.mark.slow
def test_a_material_under_a_known_sky() -> None:
    material = example("material")
    truth = material.Made(material.GOLD, torch.tensor(0.3), torch.tensor(0.7))
    _, made = material.fit(
        material.ball(), truth, 16, method="gauss-newton", steps=7, spp=4, progress=False
    )  # from 0.2 off in both
    assert abs(made.roughness - truth.roughness) < 0.03 and abs(made.metallic - truth.metallic) < 0.04
    assert (made.base - truth.base).abs().max() < 0.03


@pytest.mark.slow
def test_a_pose_of_a_body_from_masks() -> None:
    """A descent alone ends with a leg in the other's place."""
    body = example("body")
    rig, truth, _, fit = body.trial(0, progress=False)
    rotation, direction = body.Errors.of(rig, fit.values["rotations"], truth)
    assert fit.converged and rotation.median() < 1.0 and rotation.quantile(0.9) < 3.0
    assert direction.median() < 0.3 and direction.quantile(0.9) < 1.0


@pytest.mark.slow
def test_a_camera_from_masks_of_a_robot(tmp_path: Path) -> None:
    pytest.importorskip("yourdfpy")
    pytest.importorskip("pytorch_kinematics")
    robot = example("robot")
    truth, start, found, _, _ = robot.trial(
        robot.eg.rig.load(robot.arm.write(tmp_path / "arm.urdf")), 4, size=96, seed=2
    )
    before, after = (robot.errors(one, truth) for one in (start, found))
    assert before[0] > 40.0 and before[1] > 2.0 and after[0] < 2.0 and after[1] < 0.1


def test_there_is_no_other() -> None:
    known = (
        "arm body corner figure focal harmonics many_views material mirror network objects pose raster_cube "
        "raster_earth raster_environment_phong raster_pose raster_triangle raster_views robot shadow shape simplify "
        "step sun texture"
    )
    assert sorted(path.stem for path in FOLDER.glob("*.py")) == known.split()


def test_a_triangle() -> None:
    image = example("raster_triangle").picture(64)
    covered = image.sum(2) > 0
    assert torch.allclose(image.sum(2)[covered], torch.ones(())) and abs(covered.float().mean() - 0.32) < 0.015
    assert image[7, 8].argmax() == 0 and image[7, 55].argmax() == 1 and image[54, 32].argmax() == 2  # y runs up


def test_the_corners_of_a_cube_from_few_pixels() -> None:
    before, after = example("raster_cube").fit(size=8, steps=150)
    assert after.corners < 0.8 * before.corners and after.colors < 0.7 * before.colors


@pytest.mark.slow
@pytest.mark.parametrize("exact, steps, off", [(False, 3000, 0.02), (True, 500, 0.15)])
def test_the_corners_of_a_cube_from_16_pixels(exact: bool, steps: int, off: float) -> None:
    before, after = example("raster_cube").fit(size=4, steps=steps, exact=exact)
    assert before.corners > 0.5 and after.corners < off and after.colors < off


@pytest.mark.slow
def test_a_texture_with_mipmaps_and_without() -> None:
    earth = example("raster_earth")
    (_, without), (_, mipmaps) = (earth.fit(mipmaps, steps=40, size=32) for mipmaps in (False, True))
    assert mipmaps > without + 1.0


def test_a_pose_by_trying_and_by_gradients() -> None:
    start, _, found = example("raster_pose").fit(seed=0, steps=200, size=64)
    assert start > 90 and found < 0.1


def test_an_environment_and_a_highlight() -> None:
    _, before, after = example("raster_environment_phong").fit(steps=100, size=64)
    assert after.environment < 0.7 * before.environment


@pytest.mark.slow
def test_an_environment_and_a_highlight_with_more_steps() -> None:
    _, before, after = example("raster_environment_phong").fit(steps=500, size=64)
    assert after.environment < 0.25 * before.environment and after.color < 0.5 * before.color
    assert abs(after.exponent) < 0.6 * abs(before.exponent)


@pytest.mark.slow
def test_a_mesh_of_few_faces_with_a_texture() -> None:
    simplify = example("simplify", size=96)
    mesh, off = simplify.simplify(simplify.stone(4), faces=200, steps=60)
    assert len(mesh.faces) <= 220 and off.fitted < off.baked < 0.7 * off.simplified


@pytest.mark.slow
def test_colors_in_indirect_light() -> None:
    corner = example("corner")
    seen = corner.pictures(corner.TRUTH, 32, 8)
    direct, all_light = (max(corner.errors(corner.fit(seen, bounces)).values()) for bounces in (1, 4))
    assert direct > 0.15 and all_light < 0.02
