"""`edgegrad fit-shape`, `fit-texture` and `fit-camera` end to end."""

import json
from functools import partial

import pytest
import torch
import trimesh
from brackets import camera
from cli_fixtures import run

import edgegrad as eg
from edgegrad.files.cameras import save_camera
from edgegrad.files.image import read_image, write_image
from edgegrad.fit import fit_camera

pytestmark = [pytest.mark.quick, pytest.mark.unsanitized]
pytest_plugins = "cli_fixtures"


@pytest.fixture
def sphere(tmp_path):
    """Return a folder with sphere.ply, and masks of a larger sphere by three cameras."""
    shape = trimesh.creation.icosphere(subdivisions=2)
    shape.export(tmp_path / "sphere.ply")
    larger = eg.Mesh(1.2 * torch.tensor(shape.vertices).float(), torch.tensor(shape.faces))
    for k, eye in enumerate([(4.0, 0, 0), (0, 0.1, 4.0), (-2, 3, -1)]):
        view = eg.Camera.look_at(eye, (0, 0, 0), (0.1, 0.9, 0.2), size=(32, 32))
        save_camera(tmp_path / f"c{k}.json", view)
        write_image(
            tmp_path / f"m{k}.png", eg.render(larger.replace(face_colors=torch.ones(320, 3)), view, spp=64, seed=0)
        )
    return tmp_path


def views_of(files):
    return [files / f"m{k}.png" for k in range(3)] + ["--camera"] + [files / f"c{k}.json" for k in range(3)]


def test_fit_shape(sphere, capsys):
    out = sphere / "out"
    options = ["--levels", 1, "--steps", 16, "--out", out]
    assert run("fit-shape", sphere / "sphere.ply", *views_of(sphere), *options) == 0
    found = eg.load_mesh(out / "mesh.ply")
    assert 1.1 < float(found.verts.norm(dim=1).mean()) < 1.3
    assert "loss still falling" in capsys.readouterr().out
    options[3] = 18
    assert run("fit-shape", sphere / "sphere.ply", *views_of(sphere), *options, "--resume") == 0
    assert json.loads((out / "fit.json").read_text())["steps"] == 18


def test_fit_texture(sphere, capsys):
    square = trimesh.Trimesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    uv = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]]).numpy()
    square.visual = trimesh.visual.TextureVisuals(uv=uv)
    square.export(sphere / "square.obj")
    text = (sphere / "square.obj").read_text()  # as many have them: texture coordinates, and no material
    (sphere / "square.obj").write_text("".join(line for line in text.splitlines(True) if "mtl" not in line))
    view = eg.Camera.look_at((0.3, 0.2, 3.0), (0, 0, 0), size=(32, 32))
    save_camera(sphere / "c.json", view)
    plain = eg.Mesh(torch.tensor(square.vertices), torch.tensor(square.faces))
    write_image(sphere / "p.png", eg.render(plain, view, spp=64, seed=0) * torch.tensor([1.0, 0.5, 0.2]))
    options = ["--size", 8, "--steps", 60, "--out", sphere / "out"]
    assert run("fit-texture", sphere / "square.obj", sphere / "p.png", "--camera", sphere / "c.json", *options) == 0
    texture = read_image(sphere / "out" / "texture.png", channels=3)
    torch.testing.assert_close(
        texture.flatten(0, 1).median(0).values, 0.7 * torch.tensor([1.0, 0.5, 0.2]), atol=0.05, rtol=0
    )
    saved = eg.load_mesh(sphere / "out" / "mesh.glb")
    torch.testing.assert_close(saved.texture, texture, atol=1e-6, rtol=0)
    assert (
        run("fit-texture", sphere / "square.obj", sphere / "p.png", "--camera", *2 * [sphere / "c.json"], *options) == 2
    )
    assert "--camera: expected 1, one for each image, got 2" in capsys.readouterr().err


def test_fit_camera(files, capsys, monkeypatch):
    monkeypatch.setattr("edgegrad.fit.fit_camera", partial(fit_camera, search=False))
    out = files / "out"
    said = ["fit-camera", files / "mesh.ply", files / "target.png", "--camera", files / "camera.json", "--steps", 4]
    assert run(*said, "--no-focal", "--out", out) == 0
    found, true = eg.load_camera(out / "camera.json"), camera(48)
    torch.testing.assert_close(found.world_to_camera.double(), true.world_to_camera, atol=0.05, rtol=0)
    said_of = capsys.readouterr().out
    assert "focal length" in said_of and "standard deviation: ±" in said_of
    losses = [record["loss"] for record in json.loads((out / "history.json").read_text())]
    assert losses[-1] == json.loads((out / "pose.json").read_text())["loss"]
    assert run(*said, "--no-focal", "--out", out, "--resume") == 0  # nothing left to do
    assert torch.equal(eg.load_camera(out / "camera.json").world_to_camera, found.world_to_camera)
    assert run(*said, "--principal", "--out", out, "--resume") == 2
    assert "made with another focal, principal; give what it was made with" in capsys.readouterr().err
