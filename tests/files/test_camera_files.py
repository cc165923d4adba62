"""Cameras of COLMAP, NeRF and edgegrad's own files land points where those libraries do, where they are installed."""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from test_conventions import FLIP, POINTS, SHIFT, SIZE, R, agree, pose

import edgegrad as eg

F64 = torch.float64
K = np.array([[60.0, 0, 30], [0, 55, 25], [0, 0, 1]])
H, W = SIZE


# -- COLMAP ---------------------------------------------------------------------------------------------------------------


@pytest.fixture
def reconstruction(tmp_path: Path):
    """Return pycolmap, and a folder of two images as COLMAP lays it out, with its text written by hand."""
    pycolmap = pytest.importorskip("pycolmap", reason="COLMAP itself is what is compared with")
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    (tmp_path / "images").mkdir()
    eg.write_image(tmp_path / "images" / "b.png", torch.zeros(*SIZE, 3))
    lens = f"1 OPENCV {W} {H} 60 55 30 25 0.05 -0.02 0.01 -0.015\n2 FOV {W} {H} 60 60 30 25 0.9\n"
    (folder / "cameras.txt").write_text("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n" + lens)
    x, y, z, w = pycolmap.Rotation3d(R.numpy()).quat
    places = f"1 {w} {x} {y} {z} 0.3 -0.2 4.0 1 b.png\n\n2 1 0 0 0 0 0 5 1 a.png\n\n"
    (folder / "images.txt").write_text("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n" + places)
    (folder / "points3D.txt").write_text("")
    return pycolmap, folder


@pytest.mark.filterwarnings("ignore:.*1 of 2 images")
@pytest.mark.parametrize("binary", [False, True])
def test_colmap(reconstruction, tmp_path, binary) -> None:
    pycolmap, folder = reconstruction
    theirs = pycolmap.Reconstruction(str(folder))
    if binary:
        for file in list(folder.iterdir()):
            file.unlink()
        theirs.write_binary(str(folder))
    views = eg.load_cameras(tmp_path, dtype=F64)
    assert list(views) == ["a.png", "b.png"]
    assert views["b.png"].image == tmp_path / "images" / "b.png" and views["a.png"].image is None
    for image in theirs.images.values():
        points = POINTS + SHIFT.new_tensor([0, 0, 2])
        expected = np.array([image.project_point(p) for p in points.numpy()])
        agree(views[image.name].camera.project(points), torch.from_numpy(expected), 1e-8)
    assert views["b.png"].camera.size == SIZE and eg.load_cameras(folder)["a.png"].camera.K.dtype == torch.float32


def test_bad_colmap_parameters(reconstruction, tmp_path) -> None:
    _, folder = reconstruction
    text = (folder / "images.txt").read_text()
    (folder / "images.txt").write_text(text.replace("1 a.png", "2 a.png"))
    with pytest.raises(ValueError, match=r"camera 2 of 'a\.png': model: expected one of SIMPLE_PINHOLE, .* got 'FOV'"):
        eg.load_cameras(tmp_path)
    (folder / "images.txt").write_text(text.replace("1 0 0 0 0 0 5", "1 0 zero"))
    with pytest.raises(ValueError, match="expected a reconstruction of COLMAP"):
        eg.load_cameras(tmp_path)
    (folder / "images.txt").write_text(text.replace("1 a.png", "7 a.png"))
    with pytest.raises(ValueError, match=r"'a\.png': expected its camera 7, got none"):
        eg.load_cameras(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"expected cameras and images of COLMAP .* or transforms\.json"):
        eg.load_cameras(tmp_path / "images")


def test_nothing_of_a_reconstruction_is_lost_without_a_word(reconstruction, tmp_path) -> None:
    pycolmap, folder = reconstruction
    (folder.parent / "1").mkdir()
    for name in ("cameras.txt", "images.txt"):
        (folder.parent / "1" / name).write_bytes((folder / name).read_bytes())
    with pytest.warns(
        UserWarning, match=r"1 of 2 images, as 'a\.png' \(no such file.*; sparse/1 \(a reconstruction of its own"
    ):
        eg.load_cameras(tmp_path)
    with pytest.warns(UserWarning, match=r"2 of 2 images"):
        eg.load_cameras(folder, images=folder)
    text = (folder / "images.txt").read_text()
    (folder / "images.txt").write_text(text.replace("\n\n", "\n"))
    with pytest.raises(ValueError, match="image 1 is not followed by a line of its points"):
        eg.load_cameras(folder)
    (folder / "images.txt").write_text(text.replace("a.png", "b.png"))
    with pytest.raises(ValueError, match=r"'b\.png': expected one image of this name, got two"):
        eg.load_cameras(folder)
    (folder / "images.txt").write_text(
        text.replace("\n\n", "\n10.5 3 -1 7 8.25 12\n").replace("a.png", "Jos\u00e9.png"), "latin-1"
    )
    shutil.copy(tmp_path / "images" / "b.png", os.fsencode(tmp_path / "images") + b"/Jos\xe9.png")
    assert all(view.image.is_file() for view in eg.load_cameras(folder).values())
    binary = tmp_path / "binary"
    binary.mkdir()
    (folder / "images.txt").write_text(text)
    pycolmap.Reconstruction(str(folder)).write_binary(str(binary))
    with (binary / "cameras.bin").open("ab") as file:
        file.write(b"more")
    with pytest.warns(UserWarning, match=r"4 bytes at the end of cameras\.bin \(left out\)"):
        eg.load_cameras(binary)


@pytest.mark.filterwarnings("ignore:.*not all of it is read")
def test_damaged_reconstructions_are_refused(reconstruction, tmp_path) -> None:
    pycolmap, folder = reconstruction
    theirs, whole = pycolmap.Reconstruction(str(folder)), tmp_path / "whole"
    whole.mkdir()
    theirs.write_binary(str(whole))
    chance = random.Random(0)
    for k in range(300):
        place, end = (folder, "txt") if k % 2 else (whole, "bin")
        file = place / f"{chance.choice(['cameras', 'images'])}.{end}"
        data = file.read_bytes()
        changed = bytearray(data[: chance.randrange(len(data))] if chance.random() < 0.4 else data)
        for _ in range(chance.randint(0, 4) if changed else 0):
            changed[chance.randrange(len(changed))] = chance.randrange(256)
        file.write_bytes(changed)
        with contextlib.suppress(ValueError):
            eg.load_cameras(place)
        file.write_bytes(data)


# -- NeRF -----------------------------------------------------------------------------------------------------------------


def transforms(folder: Path, frame: dict | None = None, **fields: object) -> Path:
    matrix = torch.linalg.inv(FLIP @ pose()).tolist()
    file = folder / "transforms.json"
    file.write_text(
        json.dumps({**fields, "frames": [{"file_path": "./train/r_0", "transform_matrix": matrix, **(frame or {})}]})
    )
    return file


def test_transforms(tmp_path) -> None:
    (tmp_path / "train").mkdir()
    eg.write_image(tmp_path / "train" / "r_0.png", torch.zeros(*SIZE, 3))
    # As of the synthetic scenes: an angle, the size by the image, whose name has no ending.
    (view,) = eg.load_cameras(transforms(tmp_path, camera_angle_x=0.7), dtype=F64).values()
    assert view.image == tmp_path / "train" / "r_0.png" and view.camera.size == SIZE
    agree(view.camera.world_to_camera, pose())
    assert float(view.camera.fov_x) == pytest.approx(np.degrees(0.7))
    # As of instant-ngp and nerfstudio, against OpenCV. Its principal point is from the image's corner.
    lens = {"w": W, "h": H, "fl_x": 60, "fl_y": 55, "cx": 30.5, "cy": 25.5}
    for coefficients, model in (
        ({"k1": 0.05, "k2": -0.02, "p1": 0.01, "p2": -0.015}, "OPENCV"),
        ({"k1": 0.05, "k2": -0.02, "p1": 0.01, "p2": -0.015, "k3": 0.01}, "OPENCV"),
        ({"k1": 0.05, "k2": -0.02, "k3": 0.01, "k4": 0.02}, "OPENCV_FISHEYE"),
    ):
        file = transforms(tmp_path, coefficients, camera_model=model, **lens)
        camera = eg.load_cameras(tmp_path, dtype=F64)["./train/r_0"].camera
        assert file.parent == tmp_path
        points, rotation = POINTS.numpy()[:, None], cv2.Rodrigues(R.numpy())[0]
        project = cv2.fisheye.projectPoints if "FISH" in model else cv2.projectPoints
        theirs, _ = project(points, rotation, SHIFT.numpy(), K, np.array(list(coefficients.values())))
        agree(camera.project(POINTS) - 0.5, torch.from_numpy(theirs[:, 0]), 1e-8)


LENS = {"fl_x": 60, "fl_y": 55, "w": W, "h": H}


@pytest.mark.filterwarnings("ignore:.*1 of 1 images")
@pytest.mark.parametrize(
    "frame, expected",
    [
        ({"camera_angle_x": 0.7}, {"fx": 0.5 * W / np.tan(0.35), "fy": 0.5 * W / np.tan(0.35) * 55 / 60}),
        ({"camera_angle_y": 0.7}, {"fx": 0.5 * H / np.tan(0.35) * 60 / 55, "fy": 0.5 * H / np.tan(0.35)}),
        ({"camera_angle_x": 0.7, "camera_angle_y": 0.6}, {"fx": 0.5 * W / np.tan(0.35), "fy": 0.5 * H / np.tan(0.3)}),
        ({"fl_x": 90}, {"fx": 90, "fy": 82.5}),
        ({"fl_x": 90, "camera_angle_x": 0.7, "fl_y": 80}, {"fx": 90, "fy": 80}),
        ({"cx": 20, "cy": 21.5}, {"cx": 20, "cy": 21.5}),
        ({"w": 2 * W, "h": 3 * H}, {"size": (3 * H, 2 * W), "cx": W, "cy": 1.5 * H}),
        ({"k1": 0.25}, {"distortion": [0.25, 0.02, 0, 0]}),
        ({"camera_model": "OPENCV_FISHEYE"}, {"projection": "fisheye"}),
        ({"is_fisheye": True}, {"projection": "fisheye"}),
        ({"fl_x": None, "camera_angle_x": None, "w": None, "k1": None, "camera_model": None}, {}),
    ],
)
def test_what_a_frame_says_goes_first(tmp_path, frame, expected) -> None:
    file = transforms(tmp_path, frame, camera_model="OPENCV", k1=0.1, k2=0.02, k3=None, **LENS)
    camera = eg.load_cameras(file, dtype=F64)["./train/r_0"].camera
    found = {
        "fx": float(camera.K[0, 0]), "fy": float(camera.K[1, 1]), "cx": float(camera.K[0, 2]), "cy": float(camera.K[1, 2]),
        "size": camera.size, "projection": camera.projection, "distortion": camera.distortion.tolist(),
    }  # fmt: skip
    usual = {"fx": 60, "fy": 55, "cx": W / 2, "cy": H / 2, "size": SIZE, "projection": "perspective"}
    for key, value in {**usual, "distortion": [0.1, 0.02, 0, 0], **expected}.items():
        assert found[key] == (pytest.approx(value) if not isinstance(value, str) else value), key


@pytest.mark.filterwarnings("ignore:.*1 of 1 images")
def test_frames_of_a_file_that_says_one_focal_length(tmp_path) -> None:
    for shared, own, focals in (
        ({"camera_angle_x": 0.7}, {"fl_x": 80}, (80, 80)),
        ({"fl_x": 60}, {"fl_y": 70}, (60, 70)),
        ({"fl_y": 60}, {"camera_angle_x": 2 * np.arctan(0.5)}, (W, 60)),
    ):
        K = eg.load_cameras(transforms(tmp_path, own, w=W, h=H, **shared), dtype=F64)["./train/r_0"].camera.K
        assert (float(K[0, 0]), float(K[1, 1])) == pytest.approx(focals)


@pytest.mark.filterwarnings("error::UserWarning")  # those that are expected are caught
def test_names_of_frames(tmp_path) -> None:
    """Backslashes lead to the image, and of frames with one name none is lost."""
    (tmp_path / "train").mkdir()
    eg.write_image(tmp_path / "train" / "r_0.png", torch.zeros(*SIZE, 3))
    file = transforms(tmp_path, {"file_path": ".\\train\\r_0"}, camera_angle_x=0.7)
    ((name, view),) = eg.load_cameras(file).items()
    assert name == ".\\train\\r_0" and view.image.samefile(tmp_path / "train" / "r_0.png") and view.camera.size == SIZE
    fields = json.loads(file.read_text())
    fields["frames"] = [{**fields["frames"][0], "fl_x": f} for f in (60, 70)]
    file.write_text(json.dumps(fields))
    views = eg.load_cameras(file, dtype=F64)
    assert [float(view.camera.K[0, 0]) for view in views.values()] == [60, 70]


@pytest.mark.filterwarnings("error::UserWarning")  # those that are expected are caught
def test_keys_that_nobody_reads_are_named(tmp_path) -> None:
    (tmp_path / "train").mkdir()
    eg.write_image(tmp_path / "train" / "r_0.png", torch.zeros(*SIZE, 3))
    harmless = {"aabb_scale": 16, "scale": 0.3, "offset": [0, 0, 0], "ply_file_path": "sparse.ply"}
    eg.load_cameras(transforms(tmp_path, {"sharpness": 9.0, "colmap_im_id": 1}, **LENS, **harmless))
    frame = {"mask_path": "m.png", "rolling_shutter": [0, 0, 0, 1], "time": None}
    file = transforms(tmp_path, frame, **LENS, applied_transform=[[1, 0, 0, 0]], k7=3)
    with pytest.warns(UserWarning) as caught:
        eg.load_cameras(file)
    (text,) = (str(warning.message) for warning in caught)
    for part in (
        "mask_path (left out; read_mask",
        "rolling_shutter (left out)",
        "k7 (",
        "applied_transform (cameras stay",
    ):
        assert part in text
    assert "time" not in text and str(file) in text


@pytest.mark.parametrize(
    "fields, fault",
    [
        ({"camera_angle_x": 0.7}, r"frames\[0\], \./train/r_0: w and h: expected"),
        (
            {"w": W, "h": H, "camera_angle_x": 0},
            r"r_0: camera_angle_x: expected radians between 0 and π, got 0; of degrees",
        ),
        (
            {"w": W, "h": H, "frame": {"camera_angle_y": 49.1}},
            "camera_angle_y: expected radians between 0 and π, got 49.1",
        ),
        ({"w": W, "h": H, "camera_angle_x": float("nan")}, "camera_angle_x: expected radians"),
        ({"w": W, "h": H}, "fl_x: expected this key or camera_angle_x"),
        ({"w": W, "h": H, "fl_x": 60, "camera_model": "EQUIRECTANGULAR"}, "camera_model: expected .* got 'EQUI"),
        ({"w": W, "h": H, "fl_x": 60, "k4": 0.1}, "k4: expected 0"),
        (
            {"w": float("inf"), "h": H, "fl_x": 60},
            r"frames\[0\], ./train/r_0: size: expected whole numbers of pixels, got width inf",
        ),
        ({"w": W, "h": H, "fl_x": 10**400}, "int too large"),
        ({"fl_x": 60, "frame": {"file_path": "long" * 1000}}, "w and h: expected the image's size"),
        (
            {"w": W, "h": H, "fl_x": 60, "frame": {"transform_matrix": [[1, 0], [0, 1]]}},
            "camera_to_world: expected shape",
        ),
        ({"w": W, "h": H, "fl_x": 60, "frame": {"transform_matrix": "x"}}, "transforms.json: frames"),
    ],
)
def test_faults_of_transforms_are_named(tmp_path, fields, fault) -> None:
    with pytest.raises(ValueError, match=fault):
        eg.load_cameras(transforms(tmp_path, **fields))


@pytest.mark.filterwarnings("error::UserWarning")  # those that are expected are caught
def test_images_that_are_not_there_are_named(tmp_path) -> None:
    matrix = torch.linalg.inv(FLIP @ pose()).tolist()
    (tmp_path / "nerf").mkdir()
    (tmp_path / "photos" / "left").mkdir(parents=True)
    for place in ("nerf/a.png", "photos/b.png", "photos/left/0.png"):
        eg.write_image(tmp_path / place, torch.zeros(*SIZE, 3))

    def load(*names: str, images: Path | None = None, **fields: object) -> list[Path | None]:
        frames = [{"file_path": name, "transform_matrix": matrix} for name in names]
        (tmp_path / "nerf" / "transforms.json").write_text(json.dumps({**fields, "frames": frames}))
        views = eg.load_cameras(tmp_path / "nerf", images=images)
        assert list(views) == list(names)
        return [view.image for view in views.values()]

    with pytest.warns(UserWarning, match=r"1 of 2 images, as 'c\.png' \(View\.image is None: no such file\)"):
        assert load("a.png", "c.png", **LENS) == [tmp_path / "nerf" / "a.png", None]
    photos, absolute = tmp_path / "photos", str(tmp_path / "photos" / "b.png")
    for name in ("../photos/b.png", "..\\photos\\b.png", absolute, "x/../../photos/b", "C:\\photos\\b.png"):
        said = rf"1 of 2 images, as {re.escape(repr(name))} \(View\.image is None: outside of the file's folder, .* images="
        with pytest.warns(UserWarning, match=said):
            assert load(name, "a.png", **LENS) == [None, tmp_path / "nerf" / "a.png"]
        assert load(name, "./left/0", images=photos, **LENS) == [photos / "b.png", photos / "left" / "0.png"]
        with pytest.raises(
            ValueError, match=r"w and h: .* got neither: it is outside of the file's folder, .* images="
        ):
            load(name, fl_x=60)
        assert load(name, fl_x=60, images=photos) == [photos / "b.png"]
    with pytest.warns(UserWarning, match=r"1 of 1 images, as 'c\.png'"):
        assert load("c.png", images=photos, **LENS) == [None]
    with pytest.raises(
        ValueError, match=r"images: expected a folder that has 'left/0' and 'right/0' apart, .* both are 0\.png"
    ):
        load("left/0", "right/0", images=photos / "left", **LENS)
    eg.save_camera(tmp_path / "one.json", eg.Camera(pose(), torch.from_numpy(K), SIZE))
    with pytest.raises(ValueError, match=r"one\.json: images: expected none"):
        eg.load_cameras(tmp_path / "one.json", images=photos)


@pytest.mark.filterwarnings("ignore:.*1 of 1 images")
def test_encodings_and_kinds_of_json(tmp_path) -> None:
    file = transforms(tmp_path, {"file_path": "grün"}, **LENS)
    text, expected = file.read_text(), eg.load_cameras(file)["grün"].camera
    eg.save_camera(tmp_path / "one.json", expected)
    for encoding in ("utf-8-sig", "utf-16"):
        file.write_text(json.dumps(json.loads(text), ensure_ascii=False), encoding=encoding)
        assert torch.equal(eg.load_cameras(file)["grün"].camera.K, expected.K)
        (tmp_path / "b.json").write_text((tmp_path / "one.json").read_text(), encoding=encoding)
        assert torch.equal(eg.load_camera(tmp_path / "b.json").world_to_camera, expected.world_to_camera)
    file.write_text(json.dumps(json.loads(text), ensure_ascii=False), encoding="latin-1")
    with pytest.raises(
        ValueError, match=r"transforms\.json: expected JSON in UTF-8, got text in another encoding .* save it"
    ):
        eg.load_cameras(file)
    file.write_text(text)
    with pytest.raises(ValueError, match=r"the frames of a transforms\.json; read it by load_cameras\(\)"):
        eg.load_camera(file)
    for content, got in (("[1]", "list"), ('{"w": 3, "h": 4}', "h, w"), ("{}", "an empty object"), ("3", "int")):
        file.write_text(content)
        with pytest.raises(ValueError, match=rf"json: expected a JSON object with .* or with frames, .*; got {got}$"):
            eg.load_cameras(file)
    for content in ("{", "[" * 100000):
        file.write_text(content)
        with pytest.raises(ValueError, match=r"transforms\.json: expected JSON, got something else"):
            eg.load_cameras(file)


# -- our own ---------------------------------------------------------------------------------------------------------------


def test_our_own(tmp_path) -> None:
    camera = eg.Camera(pose(), torch.from_numpy(K), SIZE)
    eg.save_camera(tmp_path / "a.json", eg.Camera.stack([camera, camera]))
    views = eg.load_cameras(tmp_path / "a.json", dtype=F64)
    assert list(views) == ["0", "1"]
    agree(views["1"].camera.K, camera.K)
