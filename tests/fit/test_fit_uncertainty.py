"""How exactly a picture shows a pose: covariances by hand, directions that nothing shows, and the reasons that a fit
gives."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from brackets import task_of
from quiet_fits import quiet
from torch import Tensor

import edgegrad as eg
from edgegrad.fit import fit_pose
from edgegrad.fit.placement import Pose
from edgegrad.fit.pose.result import PoseFit
from edgegrad.fit.pose.task import FOCAL_LENGTH, PoseTask
from edgegrad.fit.pose.uncertainty import Uncertainty
from edgegrad.scene.symmetries import Symmetries

pytestmark = pytest.mark.quick

SIZE = 128


def vase() -> eg.Mesh:
    """Return a solid of revolution about y, without colours."""
    heights = torch.tensor([-1.0, -0.99, -0.5, 0.1, 0.45, 0.6, 0.99, 1.0])
    radii = torch.tensor([0.0, 0.45, 0.62, 0.5, 0.22, 0.2, 0.3, 0.0])
    n = 96  # A contour of fewer faces shows rotations about the axis up to multiples of a face.
    around = torch.arange(n) * (2.0 * math.pi / n)
    x, z = radii[:, None] * around.cos(), radii[:, None] * around.sin()
    verts = torch.stack([x, heights[:, None].expand_as(x), z], -1).flatten(0, 1)
    quads = [(r * n + k, r * n + (k + 1) % n) for r in range(7) for k in range(n)]
    faces = [face for a, b in quads for face in ((a, a + n, b), (b, a + n, b + n))]
    return eg.Mesh(verts, torch.tensor(faces))


def camera() -> eg.Camera:
    return eg.Camera.look_at((1.0, 0.6, 4.0), (0, 0, 0), fov_y=45.0, size=(SIZE, SIZE))


def picture(mesh: eg.Mesh) -> Tensor:
    """Return the mesh in grey in light, before boards of many colours."""
    coarse = 0.05 + 0.3 * torch.rand(1, 3, 9, 9, generator=torch.Generator().manual_seed(3))
    clutter = torch.nn.functional.interpolate(coarse, (SIZE, SIZE), mode="bilinear")[0].movedim(0, -1)
    lit = mesh.replace(colors=torch.full((len(mesh.verts), 3), 0.8), material=eg.Material())
    lights = [eg.lights.Environment(torch.tensor([0.9, 0.9, 1.0]), visible=False)]
    with torch.no_grad():
        return eg.render(eg.Scene([lit], background=clutter, lights=lights), camera(), spp=32, seed=0)


def task() -> PoseTask:
    return task_of(picture(vase()), camera(), vase())


def standing() -> Pose:
    one = torch.ones((), dtype=torch.float64)
    return Pose(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64), one, one)


def test_a_covariance_is_the_inverse_of_the_information_in_the_worlds_axes() -> None:
    given = task()
    axes = camera().world_to_camera[:3, :3].double()
    deviations = torch.tensor([0.01, 0.02, 0.12, 0.001, 0.002, 0.08], dtype=torch.float64)
    known = Uncertainty.from_information(given, standing(), torch.diag(1.0 / deviations**2))
    assert known.degrees == pytest.approx(math.degrees(0.12), rel=0.02)
    assert abs(float(known.axis @ axes[2])) == pytest.approx(1.0, abs=1e-6)
    assert known.shift == pytest.approx(0.08 * given.size, rel=0.02)
    assert abs(float(known.direction @ axes[2])) == pytest.approx(1.0, abs=1e-6)
    assert "rotation about (" in known.unknown and "±7° only" in known.unknown and "±8% of the size" in known.unknown
    # Of two directions that belong together, each is known less exactly than its entry alone says.
    information = torch.diag(1.0 / deviations**2)
    information[0, 3] = information[3, 0] = 0.9 * (information[0, 0] * information[3, 3]).sqrt()
    both = Uncertainty.from_information(given, standing(), information)
    expected = 0.01 / math.sqrt(1.0 - 0.9**2)
    assert float((axes @ both.covariance[:3, :3] @ axes.T)[0, 0].sqrt()) == pytest.approx(expected, rel=0.02)


def test_a_continuous_symmetry_makes_its_axis_known() -> None:
    given = task()
    axes = camera().world_to_camera[:3, :3].double()
    up = axes @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    information = torch.zeros(6, 6, dtype=torch.float64)
    information[:3, :3] = 1e6 * (torch.eye(3) - torch.outer(up, up))  # nothing of turns about y
    information[3:, 3:] = 1e6 * torch.eye(3)
    known = Uncertainty.from_information(given, standing(), information)
    assert known.degrees > 45.0 and abs(float(known.axis[1])) > 0.999
    spun = Symmetries(continuous=[Symmetries.Axis(torch.tensor([0.0, 1.0, 0.0]))])
    free = Uncertainty.from_information(given, standing(), information, spun)
    assert free.degrees < 1.0 and free.unknown == ""
    other = Symmetries(continuous=[Symmetries.Axis(torch.tensor([1.0, 0.0, 0.0]))])
    assert Uncertainty.from_information(given, standing(), information, other).unknown != ""


def test_an_unknown_focal_length_is_named() -> None:
    """Where perspective hardly shows, the focal length has the information of the distance."""
    pose_alone = task()
    given = replace(pose_alone, dofs=[*range(6), FOCAL_LENGTH])
    information = 1e6 * torch.eye(7, dtype=torch.float64)
    information[6, 6] = 1.0 / 0.08**2
    known = Uncertainty.from_information(given, standing(), information)
    assert known.focal == pytest.approx(0.08, rel=0.01) and known.unknown == "focal length known to ±8% only"
    # The object's distance goes with the focal length: 8 % of it. At the length found, which `unknown` judges by, it is known.
    away = float((camera().world_to_camera[:3, :3] @ standing().t.float() + camera().world_to_camera[:3, 3])[2])
    axis = camera().world_to_camera[2, :3].double()
    assert known.shift == pytest.approx(0.08 * away, rel=0.01) and abs(float(known.direction @ axis)) > 0.999
    restored = Uncertainty.from_dict(known.to_dict())
    assert restored.shift == known.shift and restored.at_lens is not None
    at_lens = replace(restored, covariance=restored.at_lens)
    assert at_lens.shift == pytest.approx(1e-3 * given.size, rel=0.01)
    information[5, 6] = information[6, 5] = 0.9 * (information[5, 5] * information[6, 6]).sqrt()
    known = Uncertainty.from_information(given, standing(), information)
    assert known.focal == pytest.approx(0.08 / 0.19**0.5, rel=0.03)
    information[6, 6], information[5, 6], information[6, 5] = 1e6, 0.0, 0.0
    assert Uncertainty.from_information(given, standing(), information).unknown == ""
    assert Uncertainty.from_information(pose_alone, standing(), information[:6, :6]).focal == 0.0


def test_a_vase_is_not_converged_about_its_axis_unless_that_is_a_symmetry() -> None:
    shot = picture(vase())
    start = torch.eye(4, dtype=torch.float64)
    start[0, 3] = 0.05
    spun = Symmetries(continuous=[Symmetries.Axis(torch.tensor([0.0, 1.0, 0.0]))])

    def fitted(symmetries: Symmetries | None) -> PoseFit:
        return fit_pose(vase(), shot, camera(), init=start, search=False, symmetries=symmetries, options=quiet())

    alone, known = fitted(None), fitted(spun)
    for fit in (alone, known):
        tilt = fit.R.double() @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        assert math.degrees(math.acos(min(1.0, float(tilt[1])))) < 3.0 and fit.explained > 0.85
    assert alone.reason.startswith("directions unknown: rotation about (")
    assert alone.uncertainty is not None and abs(float(alone.uncertainty.axis[1])) > 0.95
    assert known.reason == "converged"
