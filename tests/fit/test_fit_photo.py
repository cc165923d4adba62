"""fit_pose in photographs: poses in light that nobody knows, before clutter."""

import math
import re
from dataclasses import replace

import pytest
import torch
import trimesh
from brackets import BACKGROUND, CENTER, START, bracket, camera, errors, picture, task_of
from photographs import clutter, coverage, depth_of, photograph
from quiet_fits import arranged, quiet

import edgegrad as eg
from edgegrad.camera.poses import rotation as turned
from edgegrad.files.image import srgb_to_linear
from edgegrad.fit import fit_camera, fit_pose
from edgegrad.fit.options import Settings
from edgegrad.fit.placement import angle, pose_from_matrix
from edgegrad.fit.pose import pose_search
from edgegrad.fit.pose.fit_pose import ambiguity
from edgegrad.fit.pose.likelihood.objective import pose_levels
from edgegrad.fit.pose.likelihood.support import RESOLVED, evidence_of
from edgegrad.fit.pose.settings import POSE
from edgegrad.fit.pose.task import is_clutter
from edgegrad.fit.region import smoothed


def test_an_ambiguous_pose_may_be_shifted(taken):
    """A nearer pose is as good a reason for doubt as a rotated one."""
    view, image = taken
    task = task_of(image, view)
    pose = pose_from_matrix("pose", START)
    for far, words in ((0.02, ""), (0.09, "9% of the size away")):
        others = [pose, pose._replace(t=pose.t + far * task.size * torch.tensor([0.0, 0.6, 0.8]))]
        said = ambiguity(pose, others, None, task)
        assert words in said and bool(said) == bool(words)


@pytest.fixture(scope="module")
def taken():
    view = camera(96)
    image = photograph(view, seed=2)
    assert is_clutter(image)
    return view, image


@pytest.mark.parametrize(
    ("kind", "degrees", "percent"),
    [
        ("colours", 2.5, 1.0),
        pytest.param("plain", 3.0, 0.9, marks=pytest.mark.slow),
        ("mask", 1.1, 0.6),
        ("depth", 0.3, 0.1),
    ],
)
def test_a_pose_in_a_photograph(taken, kind, degrees, percent):
    view, image = taken
    given = {"mask": {"masks": coverage(view)}, "depth": {"depths": depth_of(view)}}.get(kind, {})
    given["search"] = kind in ("colours", "plain")
    fit = fit_pose(bracket(kind == "plain"), image, view, init=START, **arranged(**given))
    off = errors(fit)
    assert off[0] < degrees and off[1] < percent, (off, fit.explained)  # 12.3° and 8.4 % off at the start
    assert fit.explained >= POSE.photo_support and (fit.reason == "converged") == (kind != "plain")
    # So small a contour does not show all turns to 2°.
    words = "directions unknown: rotation about (" if kind == "plain" else "converged"
    assert fit.reason.startswith(words), fit.reason
    assert fit.uncertainty is None or off[0] < 2.0 * fit.uncertainty.degrees


@pytest.mark.slow
@pytest.mark.parametrize(("unit", "weight"), [(40.0, 1.0), (1e-3, 1.0), (1.0, 0.01), (1.0, 255.0)])
def test_radiance_and_weights_of_any_unit(taken, unit, weight):
    view, image = taken
    given = {"init": START, "weights": torch.full(view.size, weight), "search": False, "progress": False}
    fit = fit_pose(bracket(), unit * image, view, **arranged(**given))
    off = errors(fit)
    assert off[0] < 2.5 and off[1] < 0.6 and fit.reason == "converged", (off, fit.explained)
    assert float(fit.uncertainty.degrees) == pytest.approx(1.29, abs=0.08)


def test_two_photographs_of_one_pose(taken):
    view, image = taken
    other = eg.Camera.look_at(
        CENTER + 4.5 * torch.tensor([-0.6, 0.35, 0.72]).double(), CENTER, fov_y=45.0, size=(96, 96)
    )
    fit = fit_pose(
        bracket(), [image, photograph(other, seed=1, gain=(0.7, 0.8, 0.9))], [view, other], init=START, search=False,
        options=quiet(),
    )  # fmt: skip
    off = errors(fit)
    assert off[0] < 1.5 and off[1] < 1.0 and fit.reason == "converged", off


def test_a_camera_in_a_photograph(taken):
    """fit_camera takes the same terms; the camera starts as far from the bracket as the bracket did from its pose."""
    view, image = taken
    moved = view.replace(world_to_camera=view.world_to_camera.double() @ START)
    fit = fit_camera(bracket(), image, moved, focal=False, search=False, options=quiet())
    found = fit.camera.world_to_camera.double() @ torch.linalg.inv(view.world_to_camera.double())
    degrees = math.degrees(math.acos(min(1.0, (float(found[:3, :3].trace()) - 1.0) / 2.0)))
    seen, before, right = (one.project(bracket().verts) for one in (fit.camera, moved, view))
    assert degrees < 2.5 and fit.reason == "converged", degrees
    assert float((seen - right).norm(dim=-1).mean()) < 0.8 < 4.0 < float((before - right).norm(dim=-1).mean())


def test_a_photograph_of_something_else_is_not_converged():
    view = camera(40)
    for seed in (1, 3):
        fit = fit_pose(bracket(), clutter(40, seed), view, init=START, search=False, options=quiet())
        assert fit.reason != "converged"


@pytest.mark.parametrize(("step", "least", "most"), [(0.2, 0.95, 1.0), (0.05, 0.2, 0.6)])
def test_a_faint_contour_proves_little(step, least, most):
    """A plain mesh is at its very place. Where colours hardly separate it from its surroundings, chance finds as much
    elsewhere."""
    view, generator = camera(96), torch.Generator().manual_seed(0)
    texture = smoothed(torch.randn(3, 96, 96, generator=generator), 0.8).movedim(0, -1)
    display = 0.3 + 0.1 * texture + step * smoothed(coverage(view)[..., 0][None], 0.7)[0][..., None]
    image = srgb_to_linear((255.0 * display).round() / 255.0)  # of 8 bits, in which 1 is white
    task = task_of(image, view, bracket(True))
    pose = pose_from_matrix("init", torch.eye(4))
    level = pose_levels(task, pose, [None], Settings(max_size=96))[-1].informed([pose])
    assert least <= evidence_of(level, pose).edges <= most


def test_few_pixels_prove_little_before_something_else_than_the_known_background():
    """A coloured mesh is at its very place, before the background that is given, or before clutter."""
    view = camera(32)
    pose, found = pose_from_matrix("init", torch.eye(4)), []
    for behind in (BACKGROUND, clutter(32, 1)):
        task = task_of(picture(view, background=behind), view, background=BACKGROUND)
        level = pose_levels(task, pose, [None], Settings())[-1].informed([pose])
        found.append(evidence_of(level, pose))
    known, other = found
    assert known.edges > 0.85 and other.edges < 1.05 * other.across / RESOLVED < 0.8, found


@pytest.mark.slow
def test_noise_is_refused_without_following_other_starts():
    noise = torch.rand(96, 96, 3, generator=torch.Generator().manual_seed(0))
    fit = fit_pose(bracket(), noise, camera(96), init=START, options=quiet())
    assert fit.reason != "converged" and fit.explained < 0.1
    assert fit.reason.startswith("edges not explained")


@pytest.mark.parametrize(
    ("depth", "error", "message"),
    [
        (torch.ones(10, 10), ValueError, r"depths: expected shape .*96.*, got .*10.*"),
        (torch.full((96, 96), -1.0), ValueError, r"depths: expected depths along the optical axis.*got -1"),
        (
            torch.ones(96, 96, dtype=torch.int32),
            TypeError,
            r"depths: expected .*float.*take x\.float\(\) times its unit",
        ),
        (torch.zeros(96, 96), ValueError, r"depths: expected a pixel that was measured, got none"),
        ([torch.ones(96, 96)] * 2, ValueError, r"depths: expected 1, one for each camera, got 2"),
    ],
)
def test_errors_of_depth(taken, depth, error, message):
    view, image = taken
    with pytest.raises(error, match=message):
        fit_pose(bracket(), image, view, init=START, depths=depth, options=quiet())


@pytest.mark.slow
def test_an_ambiguous_pose_in_unknown_light_is_not_converged():
    """A box of one colour, before a camera without perspective: turned to the left and to the right it has nearly one contour,
    and a light makes its faces as bright as they are. The descent from a start at the wrong one stays there."""
    made = trimesh.creation.box((1.6, 0.9, 0.7))
    verts, faces = (torch.tensor(x.copy()) for x in (made.vertices, made.faces))
    box = eg.Mesh(verts, faces, colors=torch.full((len(verts), 3), 0.5))
    view = eg.Camera.orthographic((0.0, 0.7, 4.0), (0.0, 0.0, 0.0), height=2.4, size=(64, 64))
    R = turned(torch.tensor([0.0, 0.25, 0.0], dtype=torch.float64))
    start = torch.eye(4, dtype=torch.float64)
    start[:3, :3] = turned(torch.tensor([0.05, -0.2, 0.0], dtype=torch.float64))
    fit = fit_pose(box, photograph(view, box.transformed(R), seed=4), view, init=start, options=quiet(spp=8))
    assert fit.explained >= POSE.photo_support and not fit.uncertainty.unknown and fit.reason != "converged"
    assert fit.reason.startswith("ambiguous: the pictures hardly separate it from a pose that is turned by "), (
        fit.reason
    )
    assert "give symmetries of the mesh, depth" in fit.reason


@pytest.mark.slow
def test_an_ambiguous_pose_is_not_converged(monkeypatch):
    """A box before a camera without perspective has nearly one contour turned to the left and to the right.

    Which of both is the answer is chance: before this clutter the mirrored one is likelier by 18 nats, of which some 50 count
    as one, and before those of the seeds 5, 6 and 7 the right one by 8 … 121. Both must be found, with about the same mass."""
    made = trimesh.creation.box((1.6, 0.9, 0.7))
    verts = torch.tensor(made.vertices.copy())
    box = eg.Mesh(verts, torch.tensor(made.faces.copy()))
    view = eg.Camera.orthographic((0.0, 0.7, 4.0), (0.0, 0.0, 0.0), height=2.4, size=(96, 96))
    R = turned(torch.tensor([0.0, 0.25, 0.0], dtype=torch.float64))
    image = photograph(view, box.transformed(R).replace(colors=0.45 + 0.2 * torch.sin(3.0 * verts).float()), seed=4)
    start = torch.eye(4, dtype=torch.float64)
    start[:3, :3] = turned(torch.tensor([0.05, 0.2, 0.0], dtype=torch.float64))
    found = []
    for least in (0.1, POSE.ambiguous_nats):
        monkeypatch.setattr(pose_search, "POSE", replace(POSE, ambiguous_nats=least))
        found.append(fit_pose(box, image, view, init=start, options=quiet()))
    for fit in found:
        off = [math.degrees(angle(mode.matrix[:3, :3], R)) for mode in fit.modes[:2]]
        assert min(off) < 3.0 and 15.0 < max(off) < 40.0 and fit.explained >= POSE.plain_support
        assert 0.65 > fit.modes[0].probability >= fit.modes[1].probability > 0.35
        torch.testing.assert_close(fit.matrix, fit.modes[0].matrix)
    assert found[0].reason == "converged" and found[1].reason != "converged"
    words = r"ambiguous: the pictures hardly separate it from a pose that is turned by (\d+)°"
    said = re.match(words, found[1].reason)
    assert said and 15 < int(said[1]) < 40, found[1].reason
