"""fit_camera finds cameras and their lenses, and keeps a history of them."""

import json
import math

import pytest
import torch
from brackets import BACKGROUND, about_center, before_sky, bracket, camera, picture, rotation
from quiet_fits import arranged, quiet

import edgegrad as eg
from edgegrad.fit import fit_camera
from edgegrad.fit.options import Settings
from edgegrad.fit.pose.robust_loss import Comparison
from edgegrad.fit.pose.task import STEP_PARTS


def test_a_camera_and_its_focal_length():
    true = camera(96, distance=2.6)
    off = torch.linalg.inv(about_center(rotation(0.05, -0.06, 0.04), (0.04, -0.03, 0.05)))
    K = true.K.clone()
    K[:2, :2] *= 1.1
    start = true.replace(world_to_camera=true.world_to_camera @ off, K=K)
    fit = fit_camera(before_sky(), picture(true), start, options=quiet(steps=16))
    found = fit.camera
    assert float(found.K[0, 0] / true.K[0, 0]) == pytest.approx(1.0, abs=0.02)
    assert fit.converged and fit.reason == "converged"
    # Rendered from there, the scene looks like the picture.
    again = eg.render(eg.Scene([bracket()], BACKGROUND), found, spp=64, seed=3)
    assert float((again - picture(true)).square().mean()) < 1e-4
    turned = found.world_to_camera[:3, :3] @ true.world_to_camera[:3, :3].T
    assert math.degrees(math.acos(min(1.0, (float(turned.trace()) - 1.0) / 2.0))) < 1.0


def started_aside(true, zoom=1.0):
    """Return a camera some degrees and some percent off."""
    off = torch.linalg.inv(about_center(rotation(0.05, -0.06, 0.04), (0.04, -0.03, 0.05)))
    K = true.K.clone()
    K[:2, :2] *= zoom
    return true.replace(world_to_camera=true.world_to_camera @ off, K=K)


def test_the_history_of_a_camera(tmp_path):
    """A step has its loss, gradient and cameras. The history of a resumed fit is the same to the last bit."""
    true = camera(48)
    start = started_aside(true, 1.05)

    def fit(**options):
        return fit_camera(before_sky(), picture(true), start, **arranged(**{"steps": 4, **options}))

    whole = fit()
    history = whole.history
    assert whole.steps == len(history) == len(whole.search.history) and whole.seconds == whole.search.seconds > 0
    assert [record.step for record in history] == list(range(whole.steps))
    assert set(history[0].values) == {"cameras.0.world_to_camera", "cameras.0.K"}
    for record, one in ((history[0], start), (history[-1], whole.camera)):
        torch.testing.assert_close(record.values["cameras.0.K"], one.K.double())
        torch.testing.assert_close(record.values["cameras.0.world_to_camera"], one.world_to_camera.double())
    assert history[-1].loss == whole.loss < history[0].loss
    # The focal length is not fitted on blurred levels, and the last record is no step.
    assert set(history[0].gradient) == {"world_to_camera"} and not history[-1].gradient
    assert any(set(record.gradient) == {"world_to_camera", "K"} for record in history)

    def after_step(fit):
        if fit.steps == 8:
            raise KeyboardInterrupt

    kept = {"checkpoint": tmp_path / "fit.ckpt"}
    assert len(fit(**kept, callback=after_step).history) == 8
    for record, again in zip(history, fit(**kept, resume=True).history, strict=True):
        assert (record.step, record.loss, record.gradient) == (again.step, again.loss, again.gradient)
        assert all(torch.equal(value, again.values[name]) for name, value in record.values.items())


def test_the_gradient_in_the_history():
    """It is that of the loss, by finite differences of renders with the same samples, which leave some percent."""
    true = camera(48)
    fit = fit_camera(
        before_sky(), picture(true), started_aside(true), focal=False, options=quiet(steps=1, spp=64),
    )  # fmt: skip
    task, first, h = fit.search.task, fit.search.history[0], 2e-3
    assert task is not None
    level = task.pyramid(first.pose, Settings(max_size=512, spp=64))[0]
    assert level.size == first.size

    def loss(entry, step, c=None):
        moved = task.moved(first.pose, [entry], torch.tensor([step], dtype=torch.float64))
        compared = Comparison(task, level, task.images(level, moved, 4096, 0))
        return compared.loss(c or compared.scale())[0], compared.scale()

    c = loss(0, 0.0)[1]
    for part in ("rotation", "shift"):
        slopes = [(loss(entry, h, c)[0] - loss(entry, -h, c)[0]) / (2 * h) for entry in STEP_PARTS[part]]
        assert first.gradient[part] == pytest.approx(math.hypot(*slopes), rel=0.05)


def test_a_camera_is_saved(tmp_path):
    view = camera(32)
    fit = fit_camera(before_sky(), picture(view), view, focal=False, options=quiet(steps=2))
    names = fit.save(tmp_path)
    assert names == ["camera.json", "history.json", "pose.json", "fit.png", "loss.png", "fit.webp"]
    assert {path.name for path in tmp_path.iterdir()} == set(names) and torch.equal(fit.camera.K, view.K)
    history = json.loads((tmp_path / "history.json").read_text())
    assert [record["loss"] for record in history] == [record.loss for record in fit.history]
    assert history[0]["values"] == {"cameras.0.world_to_camera": view.world_to_camera.tolist()}
    assert {axes.get_ylabel() for axes in fit.plot_history().axes} == {"loss", "|gradient|"}
    torch.testing.assert_close(eg.load_camera(tmp_path / "camera.json").K.double(), view.K.double())


@pytest.mark.slow
def test_a_rig_of_cameras(tmp_path):
    """Two cameras that keep their places to one another find where they are, and the lens that they share."""
    left = camera(64, distance=2.6)
    apart = about_center(rotation(0.0, 0.5, 0.0))
    true = [left, left.replace(world_to_camera=left.world_to_camera @ apart)]
    off = torch.linalg.inv(about_center(rotation(0.05, -0.06, 0.04), (0.04, -0.03, 0.05)))
    wide = torch.diag(torch.tensor([1.05, 1.05, 1.0], dtype=torch.float64))
    start = [
        one.replace(world_to_camera=one.world_to_camera @ off, K=(wide @ one.K.double()).to(one.K)) for one in true
    ]
    for one, was in zip(start, true, strict=True):
        one.K[:2, 2] = was.K[:2, 2]
    fit = fit_camera(before_sky(), [picture(one) for one in true], start, options=quiet())
    assert fit.converged and len(fit.cameras) == 2 and fit.camera is fit.cameras[0]
    for found, one in zip(fit.cameras, true, strict=True):
        assert float(found.K[0, 0] / one.K[0, 0]) == pytest.approx(1.0, abs=0.01)
        assert float((found.eye - one.eye).norm()) < 0.02 * 2.6
    names = fit.save(tmp_path)
    assert {"camera-0.json", "camera-1.json"} < set(names) and "camera.json" not in names
    eye = eg.load_camera(tmp_path / "camera-1.json").eye
    torch.testing.assert_close(eye.double(), fit.cameras[1].eye.double(), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"cameras": 3}, "cameras: expected a Camera"),
        ({"cameras": []}, "cameras: expected one for each picture"),
        ({"cameras": [camera(8), camera(8)]}, "images: expected 2, one for each camera"),
        ({"distortion": 9}, "distortion: expected at most 8 for a camera that is perspective"),
        ({"focal": 1}, "focal: expected True or False"),
        ({"images": None}, "images: expected pictures or masks"),
        ({"images": torch.zeros(8, 9, 3)}, "images: expected "),
        ({"images": torch.ones(8, 8, 3)}, "images: expected "),
        ({"images": None, "masks": torch.zeros(9, 8)}, "masks: expected "),
        ({"scene": 3}, "scene: expected a Mesh or a Scene"),
    ],
)
def test_errors_of_fit_camera(change, message):
    arguments = {"scene": bracket(), "images": torch.zeros(8, 8, 3), "cameras": camera(8), "progress": False, **change}
    with pytest.raises((TypeError, ValueError)) as caught:
        fit_camera(**arranged(**arguments))
    assert message in str(caught.value)
