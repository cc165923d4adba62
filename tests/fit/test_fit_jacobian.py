"""Derivatives of renders by a motion, against those of torch.func."""

from dataclasses import replace

import pytest
import torch
from brackets import BACKGROUND, CENTER, START, about_center, bracket, camera, task_of
from motions import about, derivatives

import edgegrad as eg
from edgegrad.fit.pose.jacobian import Motion
from edgegrad.fit.pose.pose import pose_from_matrix
from edgegrad.fit.pose.task import DISTORTION

pytestmark = pytest.mark.quick

CHANNELS = ["image", "alpha", "position", "depth", "shading_normal", "normal"]


def smooth():
    verts = bracket().verts
    return bracket().replace(face_colors=None, colors=(0.5 + 0.5 * torch.sin(3.0 * verts)).float())


def test_derivatives_by_a_rigid_motion():
    """All channels have the derivatives of torch.func by the same samples."""
    view, scene = camera(24), eg.Scene([smooth()], BACKGROUND)
    axes = camera().world_to_camera[:3, :3]
    motion = about(CENTER, axes, size=2.0)
    images, found = derivatives(scene, view, CHANNELS, motion, spp=16, seed=3)
    verts = scene.meshes[0].verts
    turns = torch.stack([torch.linalg.cross(axis.expand_as(verts), verts - CENTER) for axis in axes.double()])
    shifts = 2.0 * axes.double()[:, None].expand(-1, len(verts), -1)
    rendered, expected = eg.jvp(scene, view, {verts: torch.cat([turns, shifts])}, 16, 3, aovs=CHANNELS)
    for name in CHANNELS:
        assert torch.equal(images[name], rendered[name])
        torch.testing.assert_close(
            found[name], expected[name], rtol=1e-4, atol=1e-4 * float(expected[name].abs().max())
        )


def test_derivatives_by_the_lens():
    true = camera(24)
    dK = torch.zeros(2, 3, 3, dtype=torch.float64)
    dK[0, 0, 0] = dK[0, 1, 1] = 24.0
    dK[1, 0, 2] = 24.0
    bend = torch.zeros(3, 4, dtype=torch.float64)
    bend[2, 0] = 1.0
    dK = torch.cat([dK, torch.zeros(1, 3, 3, dtype=torch.float64)])
    motion = Motion(torch.zeros(3, 3, 3, dtype=torch.float64), torch.zeros(3, 3, dtype=torch.float64), dK, bend)
    view = true.replace(distortion=torch.zeros(4, dtype=true.K.dtype))
    scene = eg.Scene([smooth()], BACKGROUND)
    found = derivatives(scene, view, ["image"], motion, 16, 3)[1]["image"]
    _, expected = eg.jvp(scene, view, {view.K: dK, view.distortion: bend}, 16, 3)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))


def test_other_channels_are_refused():
    motion = about(CENTER)
    with pytest.raises(ValueError, match=r"aovs: expected a channel that has derivatives .*'face_id'"):
        derivatives(eg.Scene([smooth()]), camera(8), ["face_id"], motion)
    lit = eg.Scene([smooth()], lights=[eg.lights.PointLight((0.0, 0.0, 9.0), 100.0)])
    with pytest.raises(ValueError, match=r"aovs: expected a channel of a scene that is lit .*'image'"):
        derivatives(lit, camera(8), ["image"], motion)
    assert derivatives(lit, camera(8), ["alpha"], motion)[1]["alpha"].shape == (6, 8, 8, 1)


@pytest.mark.parametrize("dofs", [range(7), [0, 1, 2, 3, 4, 5, 7], range(18), [0, 1, 2, 3, 4, 5, *range(8, 18)]])
@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_the_motion_of_a_step(dofs, kind):
    """Points and lens move as by differences of PoseTask.moved() and lens()."""
    dofs = [
        entry for entry in dofs if entry < DISTORTION or kind == "perspective"
    ]  # a parallel projection has no distortion
    if kind == "orthographic":
        view = eg.Camera.orthographic((3.0, 2.0, 4.0), CENTER, height=3.0, size=(24, 32))
    else:
        view = eg.Camera.look_at((3.0, 2.0, 4.0), CENTER, fov_y=45.0, size=(24, 32))
    view = view.to(torch.float64)
    if kind == "perspective":
        view = view.replace(distortion=torch.tensor([0.1, 0.0, 0.01, 0.0]).double())
    picture = eg.render(eg.Scene([bracket()], BACKGROUND), view, seed=0)
    task = task_of(picture, view, background=BACKGROUND)
    task = replace(task, dofs=dofs)
    level = task.level(1.0, 0.0, 1.0, 4, dofs)
    pose = pose_from_matrix("", about_center(1.1 * START[:3, :3], (0.2, 0.1, -0.1)))._replace(
        focal=torch.tensor(1.2).double()
    )
    found = task.motion(level, level.shots[0], pose)
    verts, h = bracket().verts, 1e-6

    def at(k, step):
        moved = task.moved(pose, dofs, torch.zeros(len(dofs)).double().index_fill(0, torch.tensor(k), step))
        camera = task.lens(view, moved)
        return moved.scale * verts @ moved.R.T + moved.t, camera.K, camera.coefficients

    points = found.of_points(pose.scale * verts @ pose.R.T + pose.t)
    for k in range(len(dofs)):
        moved, K, bend = ((a - b) / (2 * h) for a, b in zip(at(k, h), at(k, -h), strict=True))
        torch.testing.assert_close(points[k], moved, rtol=0, atol=1e-6)
        torch.testing.assert_close(torch.zeros_like(K) if found.K is None else found.K[k], K, rtol=0, atol=1e-6)
        if kind == "perspective":
            given = torch.zeros(8).double() if found.distortion is None else found.distortion[k]
            torch.testing.assert_close(given[: len(bend)], bend, rtol=0, atol=1e-6)
