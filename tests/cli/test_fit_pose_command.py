"""`edgegrad fit-pose` end to end, and errors of its arguments in one line each."""

import json
from functools import partial

import numpy as np
import pytest
import torch
from brackets import BACKGROUND, bracket, camera, errors, picture, silhouette
from cli_fixtures import fit, run
from PIL import Image

import edgegrad as eg
from edgegrad import cli
from edgegrad.cli import outputs
from edgegrad.files.image import linear_to_srgb, read_image, write_image
from edgegrad.fit import fit_pose
from edgegrad.fit.pose.result import PoseFit

pytestmark = [pytest.mark.quick, pytest.mark.unsanitized]
pytest_plugins = "cli_fixtures"


def test_fit_pose(files, capsys):
    out = files / "new" / "out"
    assert fit(files, "--init", files / "init.json", "--steps", 20, "--out", out) == 0
    found = PoseFit.from_json((out / "pose.json").read_text())
    assert max(errors(found)) < 1.0 and found.reason == "converged"
    said = capsys.readouterr()
    assert (
        "converged" in said.out
        and "standard deviation: ±" in said.out
        and "mesh to world:" in said.out
        and "wrote pose.json, fit.png, loss.png, checkpoint.pt in" in said.out
    )
    assert "loss" in said.err and "100%" not in said.err  # the progress bar, which does not know its end
    assert sorted(p.name for p in out.iterdir()) == ["checkpoint.pt", "fit.png", "loss.png", "pose.json"]

    sheet = Image.open(out / "fit.png")
    assert sheet.width > 3 * sheet.height
    assert Image.open(out / "loss.png").width > 500

    # What render makes of the pose is the target.
    assert run("render", files / "mesh.ply", "--pose", out / "pose.json", "--out", files / "again.exr") == 0
    again = read_image(files / "again.exr")
    covered = eg.read_mask(files / "mask.png")[..., None] > 0.99
    assert again.shape == (48, 48, 3)
    assert float(((again - picture(camera(48))).abs() * covered).mean()) < 0.01


@pytest.fixture
def given(monkeypatch):
    """Return the arguments that fit-pose and fit-poses give to their fits, which do nothing."""
    found = {}

    def fit_pose(scene, images, cameras, masks=None, init=None, **given):
        found.update(given, scene=scene, images=images, masks=masks, init=init)
        raise ValueError("seen")

    monkeypatch.setattr("edgegrad.fit.fit_pose", fit_pose)
    monkeypatch.setattr("edgegrad.fit.fit_poses", fit_pose)
    return found


def test_images_reach_the_fit(files, given):
    """A mask is given, or is the picture's alpha."""
    view, out = camera(48), ("--out", files / "out")
    assert fit(files, "--mask", files / "mask.png", *out) == 2
    torch.testing.assert_close(given["masks"].reshape(48, 48, 1), silhouette(view), atol=0.01, rtol=0.0)
    colour = "#" + bytes((linear_to_srgb(BACKGROUND) * 255).round().to(torch.uint8).tolist()).hex()
    assert fit(files, "--background", colour, *out) == 2
    assert given["masks"] is None and torch.allclose(given["scene"].background, BACKGROUND, atol=0.01)
    levels = np.repeat(np.uint8([0, 128, 255]), 16)[:, None].repeat(48, 1)
    Image.fromarray(levels).save(files / "weight.png")
    assert fit(files, "--weight", files / "weight.png", *out) == 2
    np.testing.assert_allclose(given["weights"].reshape(48, 48), levels / 255, atol=1e-6)
    write_image(files / "target.png", torch.cat([picture(view), silhouette(view)], -1))
    assert fit(files, *out) == 2
    assert given["images"].shape == (48, 48, 3)
    torch.testing.assert_close(given["masks"].reshape(48, 48, 1), silhouette(view), atol=0.01, rtol=0.0)


def test_depth_reaches_the_fit(files, given):
    """It is in millimetres."""
    z = eg.render_aovs(bracket(), camera(48), ["depth"], seed=0)["depth"][..., 0]
    Image.fromarray((1000 * z).round().numpy().astype(np.uint16)).save(files / "depth.png")
    more = ["--depth", files / "depth.png", "--depth-scale", 0.001, "--out", files / "out"]
    assert fit(files, *more) == 2
    depth = given.pop("depths")
    torch.testing.assert_close(depth, z, atol=5.1e-4, rtol=0.0)
    view = ["--mesh", files / "mesh.ply", "--camera", files / "camera.json"]
    assert run("fit-poses", files / "target.png", *view, *more) == 2
    assert torch.equal(given["depths"], depth)


def test_fit_pose_is_written_when_interrupted_and_resumes(files, capsys, monkeypatch):
    """The result is that of an uninterrupted fit, to the last bit."""

    def found(folder):
        kept = json.loads((files / folder / "pose.json").read_text())
        return {name: value for name, value in kept.items() if name != "seconds"}

    def write_pose(folder, fit):
        write(folder, fit)
        if fit.steps == 9 and not fit.interrupted:
            raise KeyboardInterrupt

    monkeypatch.setattr("edgegrad.fit.fit_pose", partial(fit_pose, search=False))
    said = ["--init", files / "init.json", "--steps", 4]
    assert fit(files, *said, "--out", files / "whole") == 0
    write = outputs.write_pose
    with monkeypatch.context() as only_now:
        only_now.setattr(outputs, "write_pose", write_pose)
        assert fit(files, *said, "--resume", "--out", files / "half") == cli.INTERRUPTED
    assert found("half")["steps"] == 9 and found("half")["interrupted"] and "interrupted" in capsys.readouterr().out
    assert fit(files, *said, "--resume", "--out", files / "half") == 0
    assert found("half") == found("whole") and found("whole")["steps"] > 11
    for name in ("fit.png", "loss.png"):
        assert (files / "half" / name).read_bytes() == (files / "whole" / name).read_bytes()
