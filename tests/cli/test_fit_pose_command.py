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
from edgegrad.files.cameras import save_camera
from edgegrad.files.image import linear_to_srgb, read_image, write_image
from edgegrad.fit import PoseFit, fit_pose

pytestmark = [pytest.mark.quick, pytest.mark.unsanitized]
pytest_plugins = "cli_fixtures"


def test_fit_pose(files, capsys):
    out = files / "new" / "out"
    assert fit(files, "--init", files / "init.json", "--steps", 20, "--out", out) == 0
    found = PoseFit.from_json((out / "pose.json").read_text())
    assert max(errors(found)) < 1.0 and found.converged
    said = capsys.readouterr()
    assert (
        "converged" in said.out
        and "standard deviation: ±" in said.out
        and "mesh to world:" in said.out
        and "wrote pose.json, fit.png, loss.png, fit.webp, checkpoint.pt in" in said.out
    )
    assert "loss" in said.err and "100%" not in said.err  # the progress bar, which does not know its end
    assert sorted(p.name for p in out.iterdir()) == [
        "checkpoint.pt", "fit.png", "fit.webp", "loss.png", "pose.json"
    ]  # fmt: skip

    sheet = Image.open(out / "fit.png")
    assert sheet.width > 3 * sheet.height
    assert Image.open(out / "loss.png").width > 500
    movie = Image.open(out / "fit.webp")
    assert movie.size == (3 * 48, 48) and movie.n_frames > 3

    # What render makes of the pose is the target.
    assert run("render", files / "mesh.ply", "--pose", out / "pose.json", "--out", files / "again.exr") == 0
    again = read_image(files / "again.exr")
    covered = eg.read_mask(files / "mask.png")[..., None] > 0.99
    assert again.shape == (48, 48, 3)
    assert float(((again - picture(camera(48))).abs() * covered).mean()) < 0.01


@pytest.mark.parametrize("what", ["mask", *(pytest.param(w, marks=pytest.mark.slow) for w in ("background", "alpha"))])
def test_fit_pose_with(what, files, monkeypatch):
    view = camera(48)
    monkeypatch.setattr("edgegrad.fit.fit_pose", partial(fit_pose, search=False))
    colour = "#" + bytes((linear_to_srgb(BACKGROUND) * 255).round().to(torch.uint8).tolist()).hex()
    more = {"mask": ["--mask", files / "mask.png"], "background": ["--background", colour], "alpha": []}[what]
    if what == "alpha":
        write_image(files / "target.png", torch.cat([picture(view), silhouette(view)], -1))
    assert fit(files, "--init", files / "init.json", "--steps", 12, *more, "--out", files / "out") == 0
    assert max(errors(PoseFit.from_json((files / "out" / "pose.json").read_text()))) < 0.5


def test_depth_reaches_the_fit(files, monkeypatch):
    """It is in millimetres."""
    given = {}

    def fit_pose(*arguments, depth, **options):
        given["depth"] = depth
        raise ValueError("seen")

    monkeypatch.setattr("edgegrad.fit.fit_pose", fit_pose)
    z = eg.render_aovs(bracket(), camera(48), ["depth"])["depth"][..., 0]
    Image.fromarray((1000 * z).round().numpy().astype(np.uint16)).save(files / "depth.png")
    more = ["--depth", files / "depth.png", "--depth-scale", 0.001, "--out", files / "out"]
    assert fit(files, *more) == 2
    torch.testing.assert_close(given["depth"], z, atol=5.1e-4, rtol=0.0)
    again = {}

    def fit_poses(*arguments, depth, **options):
        again["depth"] = depth
        raise ValueError("seen")

    monkeypatch.setattr("edgegrad.fit.fit_poses", fit_poses)
    view = ["--mesh", files / "mesh.ply", "--camera", files / "camera.json"]
    assert run("fit-poses", files / "target.png", *view, *more) == 2
    assert torch.equal(again["depth"], given["depth"])


@pytest.mark.parametrize(
    "change, message",
    [
        (["none.ply", "target.png"], "none.ply: expected a file"),
        (["mesh.ply", "none.png"], "none.png: expected a file"),
        (["mesh.ply", "mesh.ply"], "mesh.ply: expected a file name that ends in"),
        (["mesh.ply", "target.png", "--camera", "bad.json"], "bad.json: "),
        (["mesh.ply", "target.png", "--camera", "init.json"], "init.json: expected a JSON object with K"),
        (["mesh.ply", "target.png", "--camera", "camera.json", "--fov", "30"], "--camera: expected none of --fov"),
        (["mesh.ply", "target.png", "--camera", "wide.json"], "wide.json: expected a camera for 48 × 48 pixels"),
        (["mesh.ply", "target.png", "--init", "none.json"], "none.json: expected a file"),
        (["mesh.ply", "target.png", "--init", "bad.json"], "bad.json: pose: expected JSON"),
        (["mesh.ply", "target.png", "--mask", "small.png"], "small.png: expected 48 × 48 pixels like"),
        (
            ["mesh.ply", "target.png", "--mask", "labels.png"],
            "(nothing reaches an eighth of white, so it is no coverage); choose one with --label",
        ),
        (["mesh.ply", "target.png", "--mask", "target.png"], "target.png: expected a mask in grey"),
        (
            ["mesh.ply", "target.png", "--mask", "labels.png", "--label", "9"],
            "labels.png: expected label 9 in it, got the labels 0, 2, 5; choose one with --label",
        ),
        (["mesh.ply", "target.png", "--label", "2"], "--label: expected --mask with it"),
        (["mesh.ply", "target.png", "--mask", "mask.png", "--background", "#102030"], "--background: expected none"),
        (["mesh.ply", "target.png", "--background", "#1020"], "--background: expected #rrggbb"),
        (
            ["mesh.ply", "target.png", "--background", "blue"],
            "--background: expected #rrggbb or an image file, got 'blue'",
        ),
        (["mesh.ply", "target.png", "--background", "small.png"], "small.png: expected 48 × 48 pixels"),
        (
            ["mesh.ply", "target.png", "--depth", "depth.png"],
            "--depth-scale: expected the length of one unit of depth.png",
        ),
        (["mesh.ply", "target.png", "--depth-scale", "1"], "--depth-scale: expected --depth with it"),
        (
            ["mesh.ply", "target.png", "--depth", "depth.png", "--depth-scale", "-1"],
            "--depth-scale: expected a number above 0, the length of one unit of the file, got -1",
        ),
        (["mesh.ply", "target.png", "--depth", "mask.png"], "mask.png: expected depth of 16 bits or more"),
        (["mesh.ply", "target.png", "--depth", "target.png"], "target.png: expected depth in one channel, got 3"),
        (
            ["mesh.ply", "target.png", "--depth", "shallow.png", "--depth-scale", "1"],
            "shallow.png: expected 48 × 48 pixels like",
        ),
        (["mesh.ply", "target.png", "--fov", "200"], "--fov: expected degrees between 0 and 180, got 200"),
        (["mesh.ply", "target.png", "--out", "mesh.ply/out"], "mesh.ply/out (Not a directory); choose another"),
        (["mesh.ply", "target.png", "--steps", "0"], "argument --steps: expected a whole number from 1 up, got '0'"),
        (["mesh.ply"], "the following arguments are required: IMAGE"),
        (
            ["mesh.ply", "target.png", "--mask", "black.png"],
            "black.png: expected a mask, white on the object, got one that is",
        ),
        (
            ["mesh.ply", "target.png", "--starts", "hello"],
            "argument --starts: expected a whole number from 1 up, or global, got 'hello'",
        ),
        (
            ["mesh.ply", "target.png", "--size", "64x48"],
            "argument --size: expected one number, pixels on the longer side",
        ),
        (
            ["mesh.ply", "target.png", "--init", "short.txt"],
            "short.txt: mesh_to_world: expected shape (4, 4), got (1, 3)",
        ),
    ],
)
def test_errors_are_one_line(files, capsys, monkeypatch, change, message):
    monkeypatch.chdir(files)
    (files / "bad.json").write_text("{")
    save_camera(files / "wide.json", camera(48).replace(size=(48, 96)))
    write_image(files / "small.png", torch.ones(8, 8, 3))
    write_image(files / "black.png", torch.zeros(48, 48, 1))
    (files / "short.txt").write_text("1 2 3")
    labels = np.zeros((48, 48), np.uint8)
    labels[20:30, 20:30], labels[30:32] = 5, 2
    Image.fromarray(labels).save(files / "labels.png")
    Image.fromarray(np.full((48, 48), 4000, np.uint16)).save(files / "depth.png")
    Image.fromarray(np.full((8, 48), 4000, np.uint16)).save(files / "shallow.png")
    try:
        code = run("fit-pose", *change, *(() if "--out" in change else ("--out", "out")))
    except SystemExit as stop:  # from argparse
        code = stop.code
    said = capsys.readouterr().err
    assert code == 2
    assert said.startswith("edgegrad: error: ") and said.count("\n") == 1 and message in said


def test_fit_pose_is_written_when_interrupted_and_resumes(files, capsys, monkeypatch):
    """The result is that of an uninterrupted fit, to the last bit."""

    def found(folder):
        kept = json.loads((files / folder / "pose.json").read_text())
        return {name: value for name, value in kept.items() if name != "seconds"}

    def write_pose(folder, fit):
        write(folder, fit)
        if fit.steps == 9:
            raise KeyboardInterrupt

    said = ["--init", files / "init.json", "--steps", 4]
    assert fit(files, *said, "--out", files / "whole") == 0
    write = outputs.write_pose
    monkeypatch.setattr(outputs, "write_pose", write_pose)
    assert fit(files, *said, "--resume", "--out", files / "half") == cli.INTERRUPTED
    monkeypatch.undo()
    assert found("half")["steps"] == 9 and found("half")["interrupted"] and "interrupted" in capsys.readouterr().out
    assert (files / "half" / "fit.webp").exists()
    assert fit(files, *said, "--resume", "--out", files / "half") == 0
    assert found("half") == found("whole") and found("whole")["steps"] > 11
    for name in ("fit.png", "loss.png"):
        assert (files / "half" / name).read_bytes() == (files / "whole" / name).read_bytes()
