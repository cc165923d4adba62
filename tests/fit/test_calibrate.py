"""calibrate() and the uncertainty of cameras: known lenses, numbers that pictures do not show, and noise by hand."""

from __future__ import annotations

import json
import math
from functools import partial

import pytest
import torch
from brackets import BACKGROUND, about_center, before_sky, bracket, camera, picture, rotation, silhouette
from messages import T, V, check_message
from quiet_fits import arranged, quiet
from torch import Tensor

import edgegrad as eg
from edgegrad.fit import FitOptions, calibrate, fit_camera
from edgegrad.fit.pose.camera_result import CameraFit, fitted
from edgegrad.fit.pose.fit_pose import search_pose
from edgegrad.fit.pose.result import PoseFit
from edgegrad.fit.pose.task import DISTORTION, FOCAL_LENGTH, PRINCIPAL
from edgegrad.fit.pose.uncertainty import Uncertainty, reach
from edgegrad.optim.tensors import Ending

LENS = torch.tensor([-0.15, 0.05, 0.0, 0.0], dtype=torch.float64)
SIMPLE = torch.tensor([-0.15, 0.0, 0.0, 0.0], dtype=torch.float64)
DIRECTIONS = rotation(0.0, 0.0, 0.0), rotation(0.2, 0.9, 0.1), rotation(-0.3, -0.8, 0.2), rotation(0.5, 0.3, -0.4)


def taken(count: int, size: int, distance: float = 2.4, distortion: Tensor = LENS) -> list[eg.Camera]:
    """Return cameras around the bracket with one lens, whose principal point is off the middle."""
    one = camera(size, distance).to(torch.float64)
    K = one.K.clone()
    K[0, 2] += 0.012 * size
    K[1, 2] -= 0.016 * size
    around = [one.world_to_camera @ about_center(R.double()) for R in DIRECTIONS[:count]]
    return [one.replace(world_to_camera=W, K=K, distortion=distortion) for W in around]


def guessed(true: list[eg.Camera], zoom: float = 1.05) -> list[eg.Camera]:
    """Return starts: another focal length, the middle of the image, no distortion, and poses some 4° and 3 % off."""
    off = about_center(rotation(0.04, -0.05, 0.03).double(), (0.05, -0.04, 0.03))
    size = true[0].size[0]
    K = true[0].K.clone()
    K[:2, :2] *= zoom
    K[:2, 2] = 0.5 * size
    return [one.replace(world_to_camera=one.world_to_camera @ off, K=K, distortion=None) for one in true]


def pictures(cameras: list[eg.Camera]) -> list[Tensor]:
    return [picture(one) for one in cameras]


def scene() -> eg.Scene:
    return eg.Scene([bracket()], BACKGROUND)


@pytest.mark.parametrize("projection", ["perspective", "fisheye"])
def test_how_far_a_lens_moves_the_corners(projection: str) -> None:
    """The reference moves the points that the camera without distortion shows at its corners."""
    K = torch.tensor([[40.0, 0, 30], [0, 40, 22], [0, 0, 1]], dtype=torch.float64)
    plain = eg.Camera(torch.eye(4, dtype=torch.float64), K, (48, 64), projection, torch.zeros(4))
    corners = torch.tensor([[x, y] for x in (0.0, 64.0) for y in (0.0, 48.0)], dtype=torch.float64)
    n = (corners - K[:2, 2]) / 40.0
    angle = n.norm(dim=1, keepdim=True)
    across = n / angle * torch.tan(angle) if projection == "fisheye" else n
    points = torch.cat([across, torch.ones(4, 1)], 1)
    distance = (corners - K[:2, 2]).norm(dim=1)
    for k in range(4):
        bent = plain.replace(distortion=1e-4 * torch.eye(4, dtype=torch.float64)[k])
        shift = (bent.project(points) - plain.project(points)).norm(dim=1) / 1e-4
        assert reach(plain, DISTORTION + k) == pytest.approx(float((shift / distance).max()), rel=1e-3)
    assert reach(plain, FOCAL_LENGTH) == 1.0
    assert reach(plain, PRINCIPAL) == pytest.approx(64 / float(distance.min()))


def test_a_lens_that_a_picture_does_not_show() -> None:
    """An object within a third of the image does not show k2. It shows k1 and the focal length roughly."""
    (true,) = taken(1, 96, distance=11.0)
    (start,) = guessed([true], 1.0)
    start = start.replace(K=true.K)
    fit = fit_camera(before_sky(), picture(true), start, distortion=2, search=False, options=quiet())
    known = fit.uncertainty
    assert known is not None and fit.explained > 0.7
    assert not fit.converged and fit.reason.startswith("not known: ") and "k2 known to ±" in fit.reason
    assert float(known.distortion[1]) > 0.7
    assert fit.camera.distortion is not None and fit.camera.distortion[2:].tolist() == [0.0, 0.0]
    off = (fit.camera.distortion[:2] - LENS[:2]).abs()
    assert bool((off < 4.0 * known.distortion).all())
    assert 0.0 < known.focal < 0.15 and abs(float(fit.camera.K[0, 0] / true.K[0, 0]) - 1.0) < 4.0 * known.focal


def test_a_near_object_shows_the_lens() -> None:
    (true,) = taken(1, 48, distance=2.2, distortion=SIMPLE)
    (start,) = guessed([true])
    fit = fit_camera(before_sky(), picture(true), start, principal=True, distortion=1, search=False, options=quiet())
    known = fit.uncertainty
    assert known is not None and fit.converged
    assert fit.history[-1].loss == fit.loss and fit.steps == len(fit.history)
    torch.testing.assert_close(fit.history[-1].pose.focal * start.K[0, 0], fit.camera.K[0, 0])
    assert fit.camera.distortion is not None
    assert abs(float(fit.camera.distortion[0]) + 0.15) < min(0.02, 4.0 * float(known.distortion[0]))
    off = (fit.camera.K - true.K)[:2, 2].abs()
    assert bool((known.principal > 0).all()) and bool((off < 4.0 * known.principal).all()) and float(off.max()) < 0.5
    assert abs(float(fit.camera.K[0, 0] / true.K[0, 0]) - 1.0) < min(0.01, 4.0 * known.focal)
    assert 0.0 < known.degrees < 1.0 and known.unknown == ""


def checked(fit: CameraFit, true: list[eg.Camera], focal: float, center: float) -> None:
    """Check that errors are below limits and agree with their deviations."""
    known, lens = fit.uncertainty, true[0].distortion
    assert known is not None and lens is not None and fit.camera.distortion is not None
    assert abs(float(fit.camera.K[0, 0] / true[0].K[0, 0]) - 1.0) < min(focal, 4.0 * known.focal)
    off = (fit.camera.K - true[0].K)[:2, 2].abs()
    assert float(off.max()) < center and bool((off < 4.0 * known.principal).all())
    n = len(known.distortion)
    assert bool(((fit.camera.distortion - lens)[:n].abs() < 4.0 * known.distortion).all())
    squares = [chi_square(*place) for place in zip(fit.cameras, true, fit.uncertainties, strict=True)]
    assert 0.01 < sum(squares) / len(squares) < 4.0


def chi_square(found: eg.Camera, true: eg.Camera, known: Uncertainty | None) -> float:
    """Return χ² / 6 of a camera's error about the middle of the bracket."""
    assert known is not None
    low, high = bracket().verts.double().aminmax(dim=0)
    center = 0.5 * (low + high)
    M = torch.linalg.inv(true.world_to_camera) @ found.world_to_camera
    turn = 0.5 * torch.stack([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]])
    x = torch.cat([turn, M[:3, :3] @ center + M[:3, 3] - center])
    return float(x @ torch.linalg.solve(known.covariance, x)) / 6.0


def test_a_lens_from_several_pictures(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("edgegrad.fit.pose.fit_camera.search_pose", partial(search_pose, search=False))
    true = taken(2, 40, distortion=SIMPLE)
    seen: list[CameraFit] = []
    fit = calibrate(scene(), pictures(true), guessed(true, 1.02), distortion=1, options=quiet(callback=seen.append))
    assert fit.converged and fit.reason == "converged" and fit.explained > 0.9 and fit.uncertainty is not None
    checked(fit, true, 0.01, 0.5)
    for one in fit.cameras:  # one lens
        assert torch.equal(one.K, fit.camera.K) and torch.equal(one.coefficients, fit.camera.coefficients)
    assert fit.history[-1].loss <= fit.history[0].loss
    assert set(fit.history[0].gradient) == {"rotation", "shift", "focal", "principal", "distortion"}
    torch.testing.assert_close(fit.history[-1].pose.focal * guessed(true, 1.02)[0].K[0, 0], fit.camera.K[0, 0])
    counts = [len(now.searches) for now in seen]
    assert counts == sorted(counts) and len(seen[-1].joint) == fit.steps
    names = fit.save(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == set(names) and {"fit.png", "loss.png"} < set(names)
    said = json.loads((tmp_path / "calibration.json").read_text())
    deviation = fit.uncertainty.focal * float(fit.camera.K[0, 0])
    assert said["standard_deviations"]["focal"] == pytest.approx(deviation)
    torch.testing.assert_close(eg.load_camera(tmp_path / "camera-1.json").K.double(), fit.cameras[1].K)


def test_a_calibration_that_ran_out_of_steps_names_what_is_not_known() -> None:
    """No more steps can be had, so numbers that the pictures hardly show are the reason."""
    words = "k2 known to ±1 only"
    (view,), zeros, eye = taken(1, 16), torch.zeros(2), torch.eye(3).double()
    known = Uncertainty(
        torch.eye(6).double(), 1.0, torch.empty(0, 3).double(), 0.0, 5.0, principal=zeros, distortion=zeros, names=("k1", "k2"),
        vague=(words,), at_lens=1e-9 * torch.eye(6).double(), of_camera=True,
    )  # fmt: skip
    search = PoseFit(eye, eye[0], 1.0, view, 0.0, 1, 0.0, False, explained=1.0, cameras=[view], uncertainty=known)
    ended = fitted([search, search], Ending.STEPS)
    assert ended.reason.startswith(f"not known: {words}; seek less") and not ended.converged


ONE = taken(1, 16)[0]
FLAT = ONE.replace(projection="orthographic", distortion=None)


@pytest.mark.parametrize("fit", [fit_camera, calibrate])
@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"cameras": 3}, T, "cameras: expected a Camera or a sequence of them, got int"),
        ({"cameras": []}, V, "cameras: expected one for each picture, got an empty list"),
        ({"cameras": [ONE, 3]}, T, "cameras[1]: expected a Camera, got int"),
        ({"cameras": [ONE]}, V, "images: expected "),
        ({"distortion": 9}, V, "distortion: expected at most 8 for a camera that is perspective, got 9"),
        ({"distortion": -1}, V, "distortion: expected"),
        ({"principal": 1}, T, "principal: expected True or False"),
        ({"images": None}, V, "images: expected pictures or masks to compare with"),
        ({"images": torch.rand(3, 16, 16, 3)}, V, "images: expected 2, one for each camera, got 3"),
        ({"images": [torch.rand(16, 16, 3), torch.rand(8, 8, 3)]}, V, "images[1]: expected "),
        ({"images": 2 * [torch.ones(16, 16, 3)]}, V, "expected a picture of the object, got the same in every pixel"),
        ({"masks": [torch.ones(16, 16)]}, V, "masks: expected 2, one for each camera, got 1"),
        ({"masks": 2 * [torch.zeros(9, 9)]}, V, "masks[0]: expected "),
        ({"images": None, "masks": 2 * [torch.zeros(9, 9)]}, V, "masks[0]: expected "),
        ({"max_size": 2}, V, "max_size: expected"),
        ({"loss": "l1"}, V, "options.loss: {} has a loss and steps of its own; leave it out"),
        ({"callback": 3}, T, "callback: expected a function of the result so far"),
    ],
)
def test_errors_of_both(fit, change, error, message) -> None:
    noise = [torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(k)) for k in (0, 1)]
    given = {"images": noise, "cameras": [ONE, ONE], **change}
    check_message(lambda: fit(scene(), **arranged(**given)), error, message.format(fit.__name__))


@pytest.mark.parametrize(
    ("fit", "change", "error", "message"),
    [
        (fit_camera, {"scene": 3}, T, "scene: expected a Mesh or a Scene, got int"),
        (fit_camera, {"focal": 1}, T, "focal: expected True or False"),
        (calibrate, {"mesh": 3}, T, "mesh: expected a Mesh or a Scene, got int"),
        (calibrate, {"cameras": [ONE, ONE.resized((16, 20))]}, V, "cameras[1]: expected perspective, 16 × 16 pixels, like"),
        (calibrate, {"cameras": [ONE, guessed([ONE])[0].replace(distortion=LENS)]}, V, "cameras[1]: expected the K and"),
        (calibrate, {"cameras": [ONE, ONE.replace(distortion=2 * LENS)]}, V, "cameras[1]: expected the K and distortion of"),
        (calibrate, {"cameras": 2 * [FLAT], "distortion": 0}, V, "orthographic"),
    ],
)  # fmt: skip
def test_errors_of_one(fit, change, error, message) -> None:
    noise = [torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(k)) for k in (0, 1)]
    given = {"scene" if fit is fit_camera else "mesh": scene(), "images": noise, "cameras": [ONE, ONE], **change}
    check_message(lambda: fit(**arranged(**given)), error, message)


@pytest.mark.slow
def test_a_lens_from_masks_alone() -> None:
    true = taken(4, 96, distortion=SIMPLE)
    masks = [silhouette(one) for one in true]
    fit = calibrate(bracket(plain=True), None, guessed(true), masks=masks, distortion=1, options=quiet())
    assert fit.explained > 0.9
    # Contours alone have other places of rest nearby, of which deviations do not know: the focal length is 0.4 % off.
    assert abs(float(fit.camera.K[0, 0] / true[0].K[0, 0]) - 1.0) < 0.01
    assert float((fit.camera.K - true[0].K)[:2, 2].abs().max()) < 0.5


@pytest.mark.slow
def test_a_lens_from_photographs() -> None:
    """The pictures have clutter behind the object, so the terms of photographs are compared."""
    true = taken(4, 128, distance=2.8, distortion=SIMPLE)
    coarse = 0.05 + 0.5 * torch.rand(4, 3, 11, 11, generator=torch.Generator().manual_seed(3))
    clutter = torch.nn.functional.interpolate(coarse, (128, 128), mode="bilinear").movedim(1, -1)
    shot = [picture(one, background=behind) for one, behind in zip(true, clutter, strict=True)]
    fit = calibrate(bracket(), shot, guessed(true, 1.02), distortion=1, options=quiet())
    assert fit.explained > 0.8
    assert abs(float(fit.camera.K[0, 0] / true[0].K[0, 0]) - 1.0) < 0.02


@pytest.mark.slow
def test_deviations_of_cameras_are_calibrated() -> None:
    """The median error of single pictures' lenses over its deviation is that of a normal number, 0.67, within a factor
    of two and a half."""
    ratios = []
    for k, distance in enumerate((2.2, 2.6, 3.2, 4.0)):
        true = taken(4, 96, distance)[k]
        (start,) = guessed([true], 1.03)
        fit = fit_camera(
            before_sky(), picture(true), start, principal=True, distortion=2, options=FitOptions(seed=k, progress=False)
        )
        known = fit.uncertainty
        assert known is not None and fit.camera.distortion is not None
        ratios += [math.log(float(fit.camera.K[0, 0] / true.K[0, 0])) / known.focal]
        ratios += ((fit.camera.K - true.K)[:2, 2] / known.principal).tolist()
        ratios += ((fit.camera.distortion[:2] - LENS[:2]) / known.distortion).tolist()
    middle = float(torch.tensor(ratios).abs().median())
    assert 0.27 < middle < 1.7
