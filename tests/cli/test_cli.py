"""The command line end to end, on files that the tests write."""

import argparse
import json
import math
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from brackets import BACKGROUND, START, about_center, bracket, camera, errors, picture, rotation, silhouette

import edgegrad as eg
from edgegrad import cli, demo
from edgegrad.cli import doctor, inputs, outputs
from edgegrad.files.cameras import save_camera
from edgegrad.files.image import linear_to_srgb, read_image, srgb_to_linear, write_image
from edgegrad.fit import PoseFit, fit_camera, fit_pose

pytestmark = [pytest.mark.quick, pytest.mark.unsanitized]


@pytest.fixture
def files(tmp_path):
    """A folder with mesh.ply, camera.json, target.png, mask.png and init.json; the mesh's colours survive 8 bit."""
    mesh = bracket()
    colors = (linear_to_srgb(mesh.face_colors) * 255).round().to(torch.uint8).numpy()
    trimesh.Trimesh(mesh.verts.numpy(), mesh.faces.numpy(), face_colors=colors, process=False).export(
        tmp_path / "mesh.ply"
    )
    view = camera(48)
    save_camera(tmp_path / "camera.json", view)
    write_image(tmp_path / "target.png", picture(view))
    write_image(tmp_path / "mask.png", srgb_to_linear(silhouette(view)))  # a mask's greys are coverage as they are
    (tmp_path / "init.json").write_text(json.dumps({"mesh_to_world": START.tolist()}))
    return tmp_path


def run(*arguments):
    return cli.main([str(argument) for argument in arguments])


def fit(files, *more):
    return run("fit-pose", files / "mesh.ply", files / "target.png", "--camera", files / "camera.json", *more)


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
    """In millimetres; of a mesh without colours, whose distance it tells."""
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


def test_depth_files(tmp_path):
    """Whole numbers of 16 bits with their scale, floating point as it is, NaN where nothing was measured."""
    whole = np.array([[0, 1, 65535], [1000, 2500, 40000]], np.uint16)
    Image.fromarray(whole).save(tmp_path / "mm.png")
    found = eg.read_depth(tmp_path / "mm.png", 0.001)
    assert found.dtype == torch.float32
    np.testing.assert_allclose(found.numpy(), whole / 1000, rtol=1e-7)
    metres = torch.tensor([[0.0, 1.5], [2.25, torch.nan]])
    Image.fromarray(metres.numpy()).save(tmp_path / "m.tif")
    torch.testing.assert_close(eg.read_depth(tmp_path / "m.tif"), metres, equal_nan=True)
    torch.testing.assert_close(eg.read_depth(tmp_path / "m.tif", 2.0), 2 * metres, equal_nan=True)
    with pytest.raises(TypeError, match="scale: expected a number, got str"):
        eg.read_depth(tmp_path / "m.tif", "1")
    for scale in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ValueError, match="scale: expected a number above 0"):
            eg.read_depth(tmp_path / "mm.png", scale)
    with pytest.raises(ValueError, match=r"whole numbers up to 65535, got none; 0\.001"):
        eg.read_depth(tmp_path / "mm.png")


def test_an_interrupted_fit_is_written(files, capsys, monkeypatch):
    count = 0

    def write_pose(folder, found):
        nonlocal count
        count += 1
        write(folder, found)
        if count == 5:
            raise KeyboardInterrupt

    write = outputs.write_pose
    monkeypatch.setattr(outputs, "write_pose", write_pose)
    assert fit(files, "--init", files / "init.json", "--out", files / "out") == cli.INTERRUPTED
    found = PoseFit.from_json((files / "out" / "pose.json").read_text())
    assert found.interrupted and found.steps == 5
    assert (files / "out" / "fit.webp").exists() and "interrupted" in capsys.readouterr().out


def test_a_failed_write_still_prints_the_pose(files, capsys, monkeypatch):
    def full(folder, found):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(outputs, "write_pose", full)
    assert fit(files, "--init", files / "init.json", "--steps", 1, "--out", files / "out") == 2
    said = capsys.readouterr()
    assert "mesh to world:" in said.out
    assert "pose.json: expected to write it, got: No space left on device" in said.err


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


def test_a_bare_matrix_is_a_pose(tmp_path):
    matrix = START.double()
    (tmp_path / "a.json").write_text(json.dumps(matrix.tolist()))
    np.save(tmp_path / "b.npy", matrix.numpy())
    np.savetxt(tmp_path / "c.txt", matrix.numpy())
    (tmp_path / "d.txt").write_text("\n".join(", ".join(map(str, row)) for row in matrix.tolist()))
    for name in ("a.json", "b.npy", "c.txt", "d.txt"):
        assert float((inputs.read_pose(tmp_path / name).matrix - matrix).abs().max()) < 1e-6, name


@pytest.mark.parametrize(
    ("tags", "pixels"),
    [
        ({0xA405: 35}, 35.0 * 60.0 / 36.0),
        # 5.6 mm at 400 pixels a mm of a sensor of 240 pixels, of which the file has a quarter.
        ({0x920A: IFDRational(56, 10), 0xA20E: IFDRational(400), 0xA210: 4, 0xA002: 240}, 5.6 * 400.0 / 4.0),
        ({0x920A: IFDRational(56, 10)}, None),
        ({0xA405: 65535}, None),  # not known
    ],
)
def test_the_focal_length_of_a_photograph(tags, pixels, tmp_path):
    """Of 3 : 2, as 35 mm film is."""
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    Image.fromarray(np.full((40, 60, 3), 99, np.uint8)).save(tmp_path / "photo.jpg", exif=exif)
    args = argparse.Namespace(camera=None, fov=None, eye=None, target=None, up=None)
    said = inputs.assume_fov(args, tmp_path / "photo.jpg", (40, 60), None)
    degrees = 40.0 if pixels is None else math.degrees(2.0 * math.atan(20.0 / pixels))
    assert args.fov == pytest.approx(degrees, rel=0.005)
    assert ("40° assumed" in said) == (pixels is None) and ("EXIF" in said) == (pixels is not None)
    args.fov = 30.0
    assert inputs.assume_fov(args, tmp_path / "photo.jpg", (40, 60), None) == "" and args.fov == 30.0


def test_a_label_is_chosen(files):
    labels = np.zeros((4, 4), np.uint8)
    labels[1:3], labels[3] = 5, 2
    Image.fromarray(labels).save(files / "labels.png")
    assert inputs.read_coverage(files / "labels.png", 5).tolist() == (labels == 5).tolist()


def test_weights_of_three_levels_are_no_labels(files):
    levels = np.repeat(np.uint8([0, 128, 255]), 16)[:, None].repeat(48, 1)
    Image.fromarray(levels).save(files / "weight.png")
    np.testing.assert_allclose(inputs.read_weight(files / "weight.png").numpy(), levels / 255, atol=1e-6)
    assert fit(files, "--weight", files / "weight.png", "--steps", 1, "--size", 12, "--out", files / "out") == 0


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
    expected = eg.render(turned, camera(48), spp=64)
    assert float((a - b).abs().mean()) > 0.01
    # Colours went through 8 bit, vertices through float32.
    assert float((b - expected).abs().mean()) < 0.005


def test_demo_prints_errors_and_writes_pictures(tmp_path, capsys, monkeypatch):
    pytest.importorskip("pyvista", reason="needs the extra edgegrad[demo]")
    monkeypatch.setattr(demo, "SIZE", 96)
    assert run("demo", "--runs", 1, "--out", tmp_path / "demo") == 0
    said = capsys.readouterr().out
    assert "1 of 1 within 0.5° and 0.5 %" in said
    assert sorted(p.name for p in (tmp_path / "demo").iterdir()) == ["fit.png", "fit.webp", "loss.png", "pose.json"]


def test_demo_without_pyvista_says_how_to_get_it(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista.examples", None)
    assert run("demo", "--out", tmp_path) == 2
    assert "pip install 'edgegrad[demo]'" in capsys.readouterr().err


def test_version_as_a_program():
    done = subprocess.run([sys.executable, "-m", "edgegrad", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"edgegrad {eg.__version__}\n"


@pytest.mark.parametrize("typed, meant", [
    (["rendr"], "render"),
    (["render", "mesh.ply", "--out", "a.png", "--sede", "3"], "--seed"),
    (["bop", "refin"], "refine"),
])  # fmt: skip
def test_did_you_mean(capsys, typed, meant):
    with pytest.raises(SystemExit):
        run(*typed)
    assert f"did you mean {meant}?" in capsys.readouterr().err


def test_help_comes_without_torch():
    code = "import sys\nfrom edgegrad import cli\ntry: cli.main(['render', '--help'])\nfinally: assert 'torch' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


def test_doctor(capsys, monkeypatch):
    assert run("doctor") == 0
    said = capsys.readouterr().out
    for word in ("torch", "Embree       4.", "threads", "right"):
        assert word in said
    assert doctor.gradient_error() < 0.01
    monkeypatch.setattr(doctor, "TOLERANCE", 0.05 * doctor.gradient_error())
    assert run("doctor") == 1 and "WRONG" in capsys.readouterr().out


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


# -- the other fits ---------------------------------------------------------------------------------------------------


@pytest.fixture
def sphere(tmp_path):
    """sphere.ply, and masks of it, a little larger, by three cameras."""
    shape = trimesh.creation.icosphere(subdivisions=2)
    shape.export(tmp_path / "sphere.ply")
    larger = eg.Mesh(1.2 * torch.tensor(shape.vertices).float(), torch.tensor(shape.faces))
    for k, eye in enumerate([(4.0, 0, 0), (0, 0.1, 4.0), (-2, 3, -1)]):
        view = eg.Camera.look_at(eye, (0, 0, 0), (0.1, 0.9, 0.2), size=(32, 32))
        save_camera(tmp_path / f"c{k}.json", view)
        write_image(tmp_path / f"m{k}.png", eg.render(larger.replace(face_colors=torch.ones(320, 3)), view, spp=64))
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
    write_image(sphere / "p.png", eg.render(plain, view, spp=64) * torch.tensor([1.0, 0.5, 0.2]))
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


def test_fit_pose_resumes(files, monkeypatch):
    """As if it had never been interrupted, to the last bit."""

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
    assert found("half")["steps"] == 9
    assert fit(files, *said, "--resume", "--out", files / "half") == 0
    assert found("half") == found("whole") and found("whole")["steps"] > 11
    for name in ("fit.png", "loss.png"):
        assert (files / "half" / name).read_bytes() == (files / "whole" / name).read_bytes()


def test_ctrl_c_while_modules_are_imported_is_not_lost():
    code = (
        "import os, signal, time\nfrom edgegrad import cli\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "with cli._ended_by_ctrl_c():\n"
        "    try:\n        os.kill(os.getpid(), signal.SIGINT)\n        time.sleep(1)\n"
        "    except BaseException:\n        pass\n"
        "print('went on')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (cli.INTERRUPTED, "", "edgegrad: interrupted\n")
