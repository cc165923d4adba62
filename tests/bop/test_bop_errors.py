"""BOP's errors against plain formulas, and recalls against exact numbers."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from bop_scenes import SIZE, TRUTHS, K, camera, estimates, meshes, pose

import edgegrad as eg
from edgegrad import bop
from edgegrad.bop.evaluate import matched

pytestmark = pytest.mark.quick

CAMERA = camera()


pytest_plugins = "bop_fixtures"


# -- errors, against plain formulas ------------------------------------------------------------------------------------------

E, T = pose((0.5, -0.3, 0.9), (10.0, -20.0, 400.0)), pose((0.4, -0.2, 1.0), (14.0, -18.0, 410.0))
POINTS = torch.from_numpy(np.random.default_rng(0).uniform(-50, 50, (40, 3)))
TURNS = eg.Symmetries(
    torch.diag(torch.tensor([1.0, -1, -1, 1]))[None], [eg.Symmetries.Axis([0.0, 0, 1], [1.0, 2, 0])]
)  # fmt: skip


def moved(motion: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.array([motion[:3, :3] @ p + motion[:3, 3] for p in x])


def test_point_errors_equal_plain_formulas() -> None:
    a, b, x = E.numpy(), T.numpy(), POINTS.numpy()
    A, B = moved(a, x), moved(b, x)
    assert bop.errors.add(E, T, POINTS) == pytest.approx(
        np.mean([np.linalg.norm(p - q) for p, q in zip(A, B, strict=True)]), rel=1e-12
    )
    assert bop.errors.adi(E, T, POINTS) == pytest.approx(
        np.mean([min(np.linalg.norm(p - q) for p in A) for q in B]), rel=1e-12
    )
    places = A @ K.double().numpy().T
    worst, pixels = [], []
    S = TURNS.transforms(0.1)
    assert len(S) == 64
    for s in S.numpy():
        C = moved(b @ s, x)
        worst.append(np.linalg.norm(A - C, axis=1).max())
        other = C @ K.double().numpy().T
        pixels.append(np.linalg.norm(places[:, :2] / places[:, 2:] - other[:, :2] / other[:, 2:], axis=1).max())
    assert bop.errors.mssd(E, T, POINTS, S) == pytest.approx(min(worst), rel=1e-12)
    assert bop.errors.mspd(E, T, POINTS, S, CAMERA) == pytest.approx(min(pixels), rel=1e-9)
    # A pose that a symmetry makes the same.
    assert bop.errors.mssd(T @ S[40], T, POINTS, S) < 1e-9 and bop.errors.mspd(T @ S[40], T, POINTS, S, CAMERA) < 1e-9
    assert bop.errors.add(T @ S[40], T, POINTS) > 10.0


def test_bounds_leave_out_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Continuous symmetries have errors close to each other, and bounds come from one point in ten."""
    S = TURNS.transforms()
    whole = (
        min(bop.errors.mssd(E, T, POINTS, s[None]) for s in S),
        min(bop.errors.mspd(E, T, POINTS, s[None], CAMERA) for s in S),
    )
    monkeypatch.setattr("edgegrad.bop.errors.BOUND_POINTS", 4)
    assert (bop.errors.mssd(E, T, POINTS, S), bop.errors.mspd(E, T, POINTS, S, CAMERA)) == pytest.approx(
        whole, rel=1e-12
    )


def test_depth_is_that_of_the_plane() -> None:
    """At the pixels' centres, in OpenCV's convention of K, n·x = d holds."""
    corners = torch.tensor([[-60.0, -50, 10], [70, -40, -20], [0, 80, 30]])
    depth = bop.errors.depth_image(eg.Mesh(corners, torch.tensor([[0, 1, 2]])), T, CAMERA)
    a, b, c = (T[:3, :3] @ corners.double().T).T + T[:3, 3]
    n = torch.linalg.cross(b - a, c - a)
    seen = 0
    for y in range(0, SIZE[0], 2):
        for x in range(1, SIZE[1], 3):
            ray = torch.linalg.inv(K.double()) @ torch.tensor([x, y, 1.0], dtype=torch.float64)
            z = float(n @ a / (n @ ray))
            p = z * ray
            sides = [float(n @ torch.linalg.cross(v - u, p - u)) for u, v in ((a, b), (b, c), (c, a))]
            if abs(min(sides)) / float(n.norm()) ** 2 > 1e-3:  # not right at the border
                seen += min(sides) > 0
                assert float(depth[y, x]) == pytest.approx(z if min(sides) > 0 else 0.0, rel=1e-6)
    assert seen > 80


def test_depth_of_what_is_not_in_the_image() -> None:
    mesh = meshes()[1]
    for shift in ((5000.0, 0, 400), (0, 0, -400.0), (0, -900.0, 300)):
        assert float(bop.errors.depth_image(mesh, pose((0.1, 0, 0), shift), CAMERA).max()) == 0.0
    assert float(bop.errors.depth_image(mesh, pose((0.1, 0, 0), (0, 0, 5.0)), CAMERA).max()) > 0.0  # the eye is inside


def test_vsd_by_pixels() -> None:
    """The reference is a loop over pixels, in which each case of visibility occurs."""
    random = np.random.default_rng(1)
    size = SIZE
    truth = np.where(random.random(size) < 0.6, random.uniform(400, 440, size), 0.0)
    estimate = np.where(random.random(size) < 0.8, truth + random.normal(0, 12, size), 0.0)
    estimate = np.where(random.random(size) < 0.2, random.uniform(400, 440, size), estimate)
    scene = np.where(random.random(size) < 0.3, 0.0, random.uniform(380, 440, size))
    inverse = np.linalg.inv(K.double().numpy())
    taus, diameter, delta = (0.05, 0.1, 0.3), 100.0, 15.0
    wrong, union = np.zeros(3), 0
    for y in range(size[0]):
        for x in range(size[1]):
            length = np.linalg.norm(inverse @ [x, y, 1])
            e, t, m = estimate[y, x] * length, truth[y, x] * length, scene[y, x] * length
            seen_t = t > 0 and (m == 0 or t <= m + delta)
            seen_e = e > 0 and (m == 0 or e <= m + delta or seen_t)
            union += seen_e or seen_t
            wrong += (seen_e != seen_t) + (seen_e and seen_t) * (abs(e - t) / diameter >= np.array(taus))
    found = bop.errors.vsd(*map(torch.from_numpy, (estimate, truth, scene)), CAMERA, diameter, taus, delta)
    assert found == pytest.approx(wrong / union, abs=1e-12) and found[0] > found[1] > found[2] > 0.1
    nothing = torch.zeros(size)
    assert bop.errors.vsd(nothing, nothing, nothing, CAMERA, diameter, taus) == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    "errors, threshold, count",
    [
        ([[1.0, 2.0], [0.5, 3.0]], 4.0, 2),  # the first takes the first, the second what is left
        ([[1.0, 2.0], [0.5, 3.0]], 2.5, 1),
        ([[3.0, 1.0], [0.5, 2.0]], 2.5, 2),
        ([[2.0], [1.0]], 1.5, 1),  # the second, for the first is too far
        ([[1.0]], 1.0, 0),  # below, not at
    ],
)  # fmt: skip
def test_matching_takes_the_lowest_error_first(errors: list[list[float]], threshold: float, count: int) -> None:
    assert matched(np.array(errors), threshold) == count


# -- recalls -----------------------------------------------------------------------------------------------------------------


def test_true_poses_are_all_found(made: Path) -> None:
    data = bop.Dataset(made)
    given = estimates()
    flip = data.model(5).symmetries.motions[2]
    for i in (1, 2):  # in another of the poses that look the same
        given[i] = bop.files.Estimate(3, given[i].im_id, 5, given[i].score, given[i].pose @ flip)
    found = bop.evaluate(data, given, progress=False)
    assert found.overall.ar == 1.0
    assert found.overall.add_s == 1.0 and found.overall.instances == found.overall.estimates == 4
    assert found.overall.degrees < 1e-4 and found.overall.distance < 1e-4
    assert all(row.errors is not None and row.errors.mssd < 1e-4 for row in found.rows)
    assert [row.truth.index for row in found.rows if row.truth] == [0, 1, 0, 1]


def test_recalls_by_exact_numbers(made: Path) -> None:
    """The estimate is farther from the camera by 0.22 diameters of object 1: MSSD and ADD are 0.22 · 115.3 = 25.4 mm."""
    data = bop.Dataset(made)
    shift = 0.22 * data.model(1).diameter
    found = bop.evaluate(data, estimates(pose((1e-12, 0, 0), (0.0, 0.0, shift))), progress=False)
    one = found.objects[1]
    assert one.ar_mssd == pytest.approx(0.6) and one.add_s == 0.0  # 0.25 … 0.5
    assert one.distance == pytest.approx(shift) and one.degrees < 1e-4
    five = found.objects[5]
    ratio = shift / data.model(5).diameter
    assert five.ar_mssd == pytest.approx(sum(0.05 * k > ratio for k in range(1, 11)) / 10)
    row = found.rows[0]
    assert row.errors is not None and row.errors.mssd == pytest.approx(shift) == row.errors.add
    # MSPD: by the rows of K, in pixels of an image 640 wide.
    corners = data.model(1).points.numpy() @ TRUTHS[0][0][1][:3, :3].numpy().T + TRUTHS[0][0][1][:3, 3].numpy()
    place = [(c + np.array([0, 0, z])) @ K.double().numpy().T for c in corners for z in (0.0, shift)]
    flat = np.array([p[:2] / p[2] for p in place]).reshape(-1, 2, 2)
    pixels = np.linalg.norm(flat[:, 0] - flat[:, 1], axis=1).max()
    assert row.errors.mspd == pytest.approx(pixels, rel=1e-6)
    assert one.ar_mspd == pytest.approx(sum(5 * k > pixels * 640 / 96 for k in range(1, 11)) / 10)
    # VSD: taus up to 0.2 find no pixel right; beyond, what is wrong are the borders, where the sides are steep.
    assert min(row.errors.vsd[:4]) == 1.0 and max(row.errors.vsd[5:]) < 0.3
    assert one.ar_vsd == pytest.approx(sum(e < 0.05 * k - 1e-9 for e in row.errors.vsd for k in range(1, 11)) / 100)


def test_missing_and_surplus_estimates(made: Path) -> None:
    data = bop.Dataset(made)
    given = estimates()
    far = pose((0.1, 0, 0), (0.0, 0.0, 900.0))
    # One instance has no estimate; a second one of object 1 with a lower score is ignored, as is an object that is not there.
    found = bop.evaluate(
        data,
        [*given[:3], bop.files.Estimate(3, 0, 1, 0.1, far), bop.files.Estimate(3, 1, 1, 0.9, far)],
        with_vsd=False,
        progress=False,
    )
    assert (
        found.overall.ar_mssd == 0.75
        and found.overall.ar_vsd is None
        and found.overall.ar is None
        and found.ignored == 2
    )
    assert found.objects[1].ar_mssd == 1.0 and found.objects[5].ar_mssd == pytest.approx(2 / 3)
    # With a higher score it goes first, and the right one is ignored.
    found = bop.evaluate(data, [*given, bop.files.Estimate(3, 0, 1, 0.99, far)], with_vsd=False, progress=False)
    assert found.objects[1].ar_mssd == 0.0 and found.objects[5].ar_mssd == 1.0
    nothing = bop.evaluate(data, [], progress=False)
    assert nothing.overall.ar == 0.0 and math.isnan(nothing.overall.degrees) and "nan" not in nothing.table()
    assert json.loads(nothing.to_json())["median_degrees"] is None
    with pytest.raises(ValueError, match="targets: expected at least one"):
        bop.evaluate(data, given, [])


def test_errors_are_measured_on_models_eval(folder: Path) -> None:
    shutil.copytree(folder / "models", folder / "models_eval")
    info = folder / "models_eval" / "models_info.json"
    content = json.loads(info.read_text())
    content["1"]["diameter"] = 1000.0
    info.write_text(json.dumps(content))
    data = bop.Dataset(folder)
    assert data.model(1, evaluation=True).diameter == 1000.0 and data.model(1).diameter < 120.0
    found = bop.evaluate(data, estimates(pose((1e-12, 0, 0), (0, 0, 40.0))), with_vsd=False, progress=False)
    assert found.objects[1].ar_mssd == 1.0
