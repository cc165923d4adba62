"""`edgegrad render` on files that the tests write."""

import json

import pytest
import torch
import trimesh
from brackets import about_center, bracket, camera, rotation
from cli_fixtures import run

import edgegrad as eg
from edgegrad.files.image import read_image, write_image

pytestmark = [pytest.mark.quick, pytest.mark.unsanitized]
pytest_plugins = "cli_fixtures"


def test_render_frames_the_mesh(files):
    out = files / "new" / "view.exr"
    assert (
        run("render", files / "mesh.ply", "--out", out, "--size", "64x48", "--spp", 4, "--background", "#000000") == 0
    )
    image = read_image(out)
    assert image.shape == (48, 64, 3)
    seen = image.sum(-1) > 0
    assert 0.15 < float(seen.float().mean()) < 0.9
    assert not bool(seen[0].any() | seen[-1].any() | seen[:, 0].any() | seen[:, -1].any())
    assert (
        run("render", files / "mesh.ply", "--out", files / "view.png", "--eye", 1, 1, 6, "--fov", 30, "--size", 32) == 0
    )
    assert read_image(files / "view.png").shape == (32, 32, 3)


def test_render_with_a_pose_by_hand(files):
    (files / "pose.json").write_text(json.dumps({"mesh_to_world": about_center(rotation(0.0, 0.6, 0.0)).tolist()}))
    for name, more in (("a", ()), ("b", ("--pose", files / "pose.json"))):
        assert (
            run("render", files / "mesh.ply", "--camera", files / "camera.json", "--out", files / f"{name}.exr", *more)
            == 0
        )
    a, b = (read_image(files / f"{name}.exr") for name in "ab")
    turned = bracket().transformed(rotation(0.0, 0.6, 0.0), about_center(rotation(0.0, 0.6, 0.0))[:3, 3])
    expected = eg.render(turned, camera(48), spp=64, seed=0)
    assert float((a - b).abs().mean()) > 0.01
    # Colours went through 8 bit, vertices through float32.
    assert float((b - expected).abs().mean()) < 0.005


def test_a_plain_mesh_is_rendered_under_a_headlight(tmp_path):
    trimesh.creation.icosphere(subdivisions=3).export(tmp_path / "ball.stl")
    assert run("render", tmp_path / "ball.stl", "--out", tmp_path / "ball.exr", "--size", 32, "--spp", 4) == 0
    image = read_image(tmp_path / "ball.exr")
    assert float(image[16, 16, 0]) == pytest.approx(0.7, abs=0.02) and 0.0 < float(image[16, 1, 0]) < 0.5


def test_texture_and_no_materials(tmp_path, capsys):
    (tmp_path / "a.obj").write_text(
        "mtllib gone.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl skin\nf 1/1 2/2 3/3\n"
    )
    write_image(tmp_path / "red.png", torch.tensor([1.0, 0.0, 0.0]).expand(4, 4, 3))
    more = ("--out", tmp_path / "a.exr", "--size", 16, "--spp", 4, "--eye", 0.3, 0.3, 2)
    assert run("render", tmp_path / "a.obj", *more) == 2
    assert "--no-materials" in capsys.readouterr().err
    assert run("render", tmp_path / "a.obj", "--no-materials", *more) == 0
    assert run("render", tmp_path / "a.obj", "--texture", tmp_path / "red.png", *more) == 0
    assert torch.allclose(read_image(tmp_path / "a.exr").amax((0, 1)), torch.tensor([1.0, 0.0, 0.0]))
