"""fit_camera finds cameras and their lenses, and keeps a history of them."""

import json
import math

import pytest
import torch
from brackets import BACKGROUND, about_center, before_sky, bracket, camera, picture, rotation
from quiet_fits import quiet

import edgegrad as eg
from edgegrad.fit import fit_camera
from edgegrad.fit.placement import Pose


def started_aside(true, zoom=1.0):
    """Return a camera some degrees and some percent off."""
    off = torch.linalg.inv(about_center(rotation(0.05, -0.06, 0.04), (0.04, -0.03, 0.05)))
    K = true.K.clone()
    K[:2, :2] *= zoom
    return true.replace(world_to_camera=true.world_to_camera @ off, K=K)


def test_a_camera_and_its_focal_length():
    true = camera(56, distance=2.6)
    fit = fit_camera(before_sky(), picture(true), started_aside(true, 1.1), search=False, options=quiet(steps=16))
    found = fit.camera
    assert float(found.K[0, 0] / true.K[0, 0]) == pytest.approx(1.0, abs=0.02)
    assert fit.converged and fit.reason == "converged"
    # Rendered from there, the scene looks like the picture.
    again = eg.render(eg.Scene([bracket()], BACKGROUND), found, spp=64, seed=3)
    assert float((again - picture(true)).square().mean()) < 1e-4
    turned = found.world_to_camera[:3, :3] @ true.world_to_camera[:3, :3].T
    assert math.degrees(math.acos(min(1.0, (float(turned.trace()) - 1.0) / 2.0))) < 1.0


def test_the_history_of_a_camera(tmp_path):
    """A step has its loss, gradient, and the pose of the scene before the camera."""
    true = camera(32)
    start = started_aside(true, 1.05)

    whole = fit_camera(before_sky(), picture(true), start, search=False, options=quiet(steps=4))
    history = whole.history
    assert whole.steps == len(history) == len(whole.searches[0].history) and whole.seconds > 0
    for step, one in ((history[0], start), (history[-1], whole.camera)):
        torch.testing.assert_close(step.pose.focal * start.K[0, 0].double(), one.K[0, 0].double())
        torch.testing.assert_close(start.world_to_camera.double() @ step.pose.matrix, one.world_to_camera.double())
    assert history[-1].loss == whole.loss < history[0].loss
    # The focal length is not fitted on blurred levels, and the last record is no step.
    assert set(history[0].gradient) == {"rotation", "shift"} and not history[-1].gradient
    assert any(set(step.gradient) == {"rotation", "shift", "focal"} for step in history)


def test_a_camera_is_saved(tmp_path):
    view = camera(24)
    fit = fit_camera(before_sky(), picture(view), view, focal=False, search=False, options=quiet(steps=2))
    names = fit.save(tmp_path)
    assert names == ["camera.json", "calibration.json", "history.json", "pose.json", "fit.png", "loss.png"]
    assert {path.name for path in tmp_path.iterdir()} == set(names) and torch.equal(fit.camera.K, view.K)
    history = json.loads((tmp_path / "history.json").read_text())
    assert [record["loss"] for record in history] == [record.loss for record in fit.history]
    assert set(history[0]["values"]) == set(Pose._fields)
    assert {axes.get_ylabel() for axes in fit.plot_history().axes} == {"loss", "|gradient|"}
    torch.testing.assert_close(eg.load_camera(tmp_path / "camera.json").K.double(), view.K.double())


@pytest.mark.slow
def test_a_rig_of_cameras(tmp_path):
    """Two cameras that keep their places to one another find where they are, and the lens that they share."""
    left = camera(64, distance=2.6)
    apart = about_center(rotation(0.0, 0.5, 0.0))
    true = [left, left.replace(world_to_camera=left.world_to_camera @ apart)]
    start = [started_aside(one, 1.05) for one in true]
    fit = fit_camera(before_sky(), [picture(one) for one in true], start, options=quiet())
    assert fit.converged and len(fit.cameras) == 2 and fit.camera is fit.cameras[0]
    for found, one in zip(fit.cameras, true, strict=True):
        assert float(found.K[0, 0] / one.K[0, 0]) == pytest.approx(1.0, abs=0.01)
        assert float((found.eye - one.eye).norm()) < 0.02 * 2.6
    names = fit.save(tmp_path)
    assert {"camera-0.json", "camera-1.json"} < set(names) and "camera.json" not in names
    eye = eg.load_camera(tmp_path / "camera-1.json").eye
    torch.testing.assert_close(eye.double(), fit.cameras[1].eye.double(), rtol=1e-5, atol=1e-5)
