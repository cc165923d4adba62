"""fit_pose from many starts and from none: rotations cover SO(3), matches find the object, and wrong counts are
refused."""

from __future__ import annotations

import math

import pytest
import torch
from brackets import bracket, task_of
from quiet_fits import quiet
from torch import Tensor

import edgegrad as eg
from benchmarks.poses.cases import Placed, Recipe, drawn
from benchmarks.poses.objects import Sources
from edgegrad.camera.poses import rotation
from edgegrad.fit import FitOptions, fit_pose
from edgegrad.fit.placement import Pose, angle
from edgegrad.fit.pose.photo.match import Matches, Mips, _in_mask, closer
from edgegrad.fit.pose.photo.template_views import TemplateViews, all_sides, ball, pose_at, spread
from edgegrad.fit.pose.settings import TEMPLATES
from edgegrad.fit.pose.task import PoseTask

CENTER = torch.tensor([1.0, 0.75, 0.4])
SIZE = 96


def camera() -> eg.Camera:
    eye = CENTER + torch.tensor([1.2, 1.0, 4.0])
    return eg.Camera.look_at(eye, CENTER, fov_y=45.0, size=(SIZE, SIZE))


def truth(turn: tuple[float, float, float], shift: tuple[float, float, float]) -> tuple[Tensor, Tensor]:
    """Return a pose that is rotated about the object's centre."""
    R = rotation(torch.tensor(turn))
    return R, CENTER + torch.tensor(shift) - R @ CENTER


def pictured(R: Tensor, t: Tensor) -> tuple[eg.Mesh, Tensor, Tensor]:
    """Return the mesh, its picture in light before clutter, and a mask."""
    mesh = bracket().to(torch.float32)
    moved = mesh.transformed(R, t)
    generator = torch.Generator().manual_seed(3)
    coarse = 0.15 + 0.5 * torch.rand(1, 3, 9, 9, generator=generator)
    clutter = torch.nn.functional.interpolate(coarse, (SIZE, SIZE), mode="bilinear")[0].movedim(0, -1)
    light = [
        eg.lights.DirectionalLight(torch.tensor([-0.5, -0.8, -1.0]), 2.0),
        eg.lights.Environment(torch.tensor([0.5, 0.5, 0.6]), visible=False),
    ]
    lit = moved.replace(material=eg.Material())
    with torch.no_grad():
        picture = eg.render(eg.Scene([lit], background=clutter, lights=light), camera(), spp=32, seed=0)
        mask = (eg.render_aovs(moved, camera(), ["alpha"], 16, seed=0)["alpha"] >= 0.5).float()
    return mesh, picture, mask


def farthest(rotations: Tensor, seed: int = 0) -> float:
    """Return the largest angle from random rotations to the nearest of these, in radians."""
    q = torch.nn.functional.normalize(
        torch.randn(300, 4, generator=torch.Generator().manual_seed(seed)), dim=-1
    ).double()
    probes = [rotation(2.0 * torch.acos(x[0].clamp(-1, 1)) * x[1:] / x[1:].norm().clamp(min=1e-9)) for x in q]
    cosine = 0.5 * (torch.einsum("nij,mij->nm", torch.stack(probes), rotations) - 1.0)
    return float(torch.acos(cosine.amax(1).clamp(-1.0, 1.0)).max())


def test_rotations_cover_all_of_so3() -> None:
    # Balls of this radius around evenly spread rotations have some three times the volume of SO(3).
    assert farthest(spread(1000)) < 0.42
    assert farthest(spread(30)) < 1.35
    assert farthest(all_sides()) < 0.42
    assert farthest(all_sides()[::2]) > 0.25  # the measure can decide


def test_rotations_are_rotations() -> None:
    for found in (spread(50), ball(50, 0.8), all_sides()):
        assert torch.allclose(found @ found.mT, torch.eye(3).double().expand_as(found), atol=1e-9)
        assert torch.allclose(torch.linalg.det(found), torch.ones(len(found)).double())


def test_a_ball_of_rotations_begins_with_none_and_is_filled_evenly() -> None:
    angles = torch.tensor([angle(torch.eye(3).double(), R) for R in ball(200, 0.8)])
    assert float(angles[0]) < 1e-9 and float(angles.max()) <= 0.8
    # Half of a ball's volume is within 2^(-1/3) of its radius.
    assert float((angles < 0.8 * 0.5 ** (1.0 / 3.0)).double().mean()) == pytest.approx(0.5, abs=0.04)


def test_a_pose_off_the_axis_shows_the_object_in_its_place_and_from_its_side() -> None:
    mesh, picture, mask = pictured(*truth((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    task = task_of(picture, camera(), mesh, mask)
    R = rotation(torch.tensor([0.4, -0.3, 0.8], dtype=torch.float64))
    pose = pose_at(task, R, torch.tensor([80.0, 20.0]), 5.0)
    center = pose.R @ task.center + pose.t
    assert torch.allclose(camera().to(torch.float64).project(center), torch.tensor([80.0, 20.0]).double(), atol=1e-4)
    # What the ray to the object sees of it is what the axis sees of the view.
    view = camera().world_to_camera.double()
    seen = view[:3, :3] @ center + view[:3, 3]
    assert float(seen[2]) == pytest.approx(5.0, abs=1e-6)
    ray = (view[:3, :3] @ pose.R).T @ (seen / seen.norm())
    assert torch.allclose(ray, R.T @ torch.tensor([0.0, 0.0, 1.0]).double(), atol=1e-6)


def near(pose: Pose, R: Tensor, t: Tensor, task: PoseTask, turn: float, share: float) -> bool:
    """Return whether a pose is within an angle in radians and a share of the object's size."""
    off = (pose.R @ task.center + pose.t) - (R.double() @ task.center + t.double())
    return angle(pose.R, R.double()) < turn and float(off.norm()) < share * task.size


def test_matches_come_closer_than_views_are_apart() -> None:
    """Views are 20° apart, and places a tenth of the object's size. The later rounds bring matches nearer."""
    R, t = truth((2.5, 0.3, 0.2), (0.3, -0.2, 0.4))
    mesh, picture, mask = pictured(R, t)
    task = task_of(picture, camera(), mesh, mask)
    mips = Mips(task, TEMPLATES.view_pixels)
    views = TemplateViews.from_rotations(task, all_sides()[::2], TEMPLATES.view_pixels, 0)
    found = _in_mask(views, mips).distinct(24, *TEMPLATES.distinct)
    coarse = found
    for one in TEMPLATES.beam_rounds:
        before = found
        found = closer(task, before, mips, one, 0)
        if one.across == TEMPLATES.view_pixels:  # the match itself is among those compared
            assert bool((found.scores >= before.scores - 1e-4).all())
            assert float((found.scores - before.scores).mean()) > 0.1
        found = found.distinct(12, *TEMPLATES.distinct)
    assert any(near(pose, R, t, task, 0.2, 0.1) for pose in found.poses(task)[:4])
    assert not any(near(pose, R, t, task, 0.2, 0.1) for pose in coarse.poses(task)[:4])


def test_matches_that_are_kept_are_distinct() -> None:
    turns = rotation(torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64))
    eye = torch.eye(3, dtype=torch.float64)
    rotations = torch.stack([eye, turns, eye, eye, eye])
    positions = torch.tensor([[0.0, 0.0], [1.0, 0.0], [30.0, 0.0], [0.0, 0.0], [2.0, 0.0]], dtype=torch.float64)
    pixels = torch.tensor([100.0, 100.0, 100.0, 130.0, 100.0], dtype=torch.float64)
    found = Matches(rotations, positions, pixels, torch.tensor([1.0, 5.0, 2.0, 3.0, 4.0]))
    assert found.distinct(9, 0.2, 0.1, 1.2).scores.tolist() == [5.0, 3.0, 2.0]
    assert found.distinct(9, 0.05, 0.1, 1.2).scores.tolist() == [5.0, 4.0, 3.0, 2.0]
    assert found.distinct(2, 0.05, 0.1, 1.2).scores.tolist() == [5.0, 4.0]


@pytest.mark.slow
def test_with_a_mask_no_start_is_needed(capsys: pytest.CaptureFixture[str]) -> None:
    R, t = truth((0.4, 2.0, -0.7), (0.3, -0.2, 0.4))
    mesh, picture, mask = pictured(R, t)
    fit = fit_pose(mesh, picture, camera(), mask, search="global", options=FitOptions(seed=0, progress=True))
    said = capsys.readouterr().err
    assert "views from all sides" in said and "views nearby" in said and "hypotheses on level 1" in said
    assert fit.reason == "converged"
    assert angle(fit.R.double(), R.double()) < math.radians(2.0)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_fit() -> None:
    R, t = truth((0.4, 2.0, -0.7), (0.3, -0.2, 0.4))
    mesh, picture, mask = pictured(R, t)
    first, again = (
        fit_pose(mesh, picture, camera(), mask, search="global", options=quiet(max_size=size)) for size in (256, SIZE)
    )
    assert torch.equal(again.matrix, first.matrix)


@pytest.mark.slow
@pytest.mark.parametrize("masked", [False, True])
def test_eight_of_ten_are_found_without_a_start(masked: bool) -> None:
    """A stone with patterns has any pose and any light before boards, in pictures worn as photographs are."""
    right, count = 0, 10
    for k in range(count):
        case = drawn("global", Recipe(only="stone", boards=True, mask=masked), 300 + k, Sources())[0]
        fit = fit_pose(case.mesh, case.picture, case.camera, case.mask, search="global", options=quiet())
        off = case.apart(Placed(fit.R, fit.t), case.truth)
        right += off[0] < 1.0 and off[1] < 0.01
        assert fit.reason != "converged" or off[0] < 3.0, (k, off)
    assert right >= 8 + masked


def test_errors_name_the_argument() -> None:
    mesh, picture, mask = pictured(*truth((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    for search, says in ((0, "search"), ("all", "expected True, False, a number"), (10**6, "search")):
        with pytest.raises(ValueError, match=says):
            fit_pose(mesh, picture, camera(), mask, search=search, options=quiet())  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="search"):
        fit_pose(mesh, picture, camera(), mask, search=2.5, options=quiet())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="leave init out"):
        fit_pose(mesh, picture, camera(), mask, torch.eye(4), search="global", options=quiet())
