"""A view's camera agrees with the pixels that read_image() gives of its image, whatever the image's header says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import edgegrad as eg
from edgegrad.cli.inputs import seen_by
from edgegrad.files.formats.views import View
from edgegrad.files.image import linear_to_srgb

TRIANGLE = eg.Mesh(
    torch.tensor([[-0.9, -0.5, 0], [0.8, -0.7, 0], [0.3, 0.9, 0]]),
    torch.tensor([[0, 1, 2]]),
    colors=torch.tensor([[1.0, 0.1, 0.1], [0.1, 1.0, 0.1], [0.1, 0.1, 1.0]]),
)
EYE = torch.eye(4)
EYE[2, 3] = 4.0


def camera_of(height: int, width: int) -> eg.Camera:
    K = torch.tensor([[80.0, 0, width / 2 + 1], [0, 80, height / 2 - 2], [0, 0, 1]])
    return eg.Camera(EYE, K, (height, width))


def picture_of(camera: eg.Camera) -> np.ndarray:
    return (linear_to_srgb(eg.render(TRIANGLE, camera, 64, seed=0)) * 255.0).round().byte().numpy()


def write(path: Path, pixels: np.ndarray, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x112] = orientation
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, exif=exif)


def write_colmap(folder: Path, camera: eg.Camera) -> None:
    (H, W), (fx, fy, cx, cy) = camera.size, camera.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "sparse" / "0" / "cameras.txt").write_text(f"1 PINHOLE {W} {H} {fx} {fy} {cx} {cy}\n")
    (folder / "sparse" / "0" / "images.txt").write_text("1 1 0 0 0 0 0 4 1 a.png\n\n")


def write_transforms(folder: Path, camera: eg.Camera, **sizes: int) -> None:
    (fx, fy, cx, cy) = camera.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    pose = torch.linalg.inv(camera.world_to_camera.double()) @ torch.diag(torch.tensor([1.0, -1, -1, 1])).double()
    frames = [{"file_path": "images/a.png", "transform_matrix": pose.tolist()}]
    fields = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, **sizes, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(fields))


def check(view: View) -> None:
    """Check that the image is a render by the camera, to the rounding of its 8 bits and the noise of its samples."""
    assert view.image is not None
    seen, again = eg.read_image(view.image, channels=3), eg.render(TRIANGLE, view.camera, 64, seed=0)
    assert seen.shape == again.shape
    assert float((seen - again).abs().mean()) < 0.01 * float(again.mean())


@pytest.mark.parametrize("orientation", range(1, 9))
def test_cameras_speak_of_the_pixels_that_are_stored(orientation: int, tmp_path) -> None:
    for size in ((48, 48), (36, 48)):
        camera = camera_of(*size)
        for kind, make in (("c", write_colmap), ("t", write_transforms)):
            folder = tmp_path / f"{kind}{size[0]}"
            write(folder / "images" / "a.png", picture_of(camera), orientation)
            make(folder, camera)
            (view,) = eg.load_cameras(folder).values()
            check(view)
            assert view.camera.size == size


def test_a_camera_of_the_upright_size_speaks_of_the_upright_image(tmp_path) -> None:
    """Some programs write such cameras, since they rotate images before they use them."""
    camera = camera_of(48, 36)
    upright = picture_of(camera)
    write(tmp_path / "images" / "a.png", np.rot90(upright), 6)  # to be turned clockwise
    write_colmap(tmp_path, camera)
    (view,) = eg.load_cameras(tmp_path).values()
    assert view.camera.size == (48, 36)
    check(view)


def test_masks_and_depth_of_a_view_are_its_pixels(tmp_path) -> None:
    (tmp_path / "images").mkdir()
    write_colmap(tmp_path, camera_of(48, 48))
    write(tmp_path / "images" / "a.png", np.full((48, 48, 3), 255, np.uint8), 6)
    (view,) = eg.load_cameras(tmp_path).values()
    labels = np.zeros((48, 48), np.uint8)
    labels[:12] = 3
    paletted = Image.fromarray(labels).convert("P")
    exif = Image.Exif()
    exif[0x112] = 6
    paletted.save(tmp_path / "images" / "labels.png", exif=exif)
    Image.fromarray(labels.astype(np.uint16) * 100).save(tmp_path / "images" / "depth.png", exif=exif)
    assert torch.equal(eg.read_mask(view.image.with_name("labels.png"), label=3), torch.tensor(labels == 3).float())
    assert torch.equal(eg.read_depth(view.image.with_name("depth.png"), 0.01), torch.tensor(labels).float())
    # By a path of one's own they are upright.
    assert torch.equal(
        eg.read_depth(tmp_path / "images" / "depth.png", 0.01), torch.tensor(np.rot90(labels, -1).copy()).float()
    )


@pytest.mark.parametrize("make", [write_colmap, lambda f, c: write_transforms(f, c, w=c.size[1], h=c.size[0])])
def test_images_of_another_size_scale_their_cameras(make, tmp_path) -> None:
    camera = camera_of(96, 128)
    make(tmp_path, camera)
    write(tmp_path / "images" / "a.png", picture_of(camera.resized((48, 64))), 1)
    with pytest.warns(UserWarning, match=r"1 of 1 images, as '.*a\.png' \(64 × 48, 128 × 96 pixels.*cameras scaled"):
        (view,) = eg.load_cameras(tmp_path).values()
    assert view.camera.size == (48, 64) and float(view.camera.K[0, 0]) == 40.0
    check(view)
    # A crop is no scaled image.
    write(tmp_path / "images" / "a.png", picture_of(camera)[:80], 1)
    with pytest.warns(
        UserWarning, match=r"'.*a\.png' \(128 × 80, 128 × 96 pixels.*not in proportion.*View\.image is None"
    ):
        (view,) = eg.load_cameras(tmp_path).values()
    assert view.camera.size == (96, 128) and view.image is None


def test_what_is_no_image_is_named_by_who_reads_it(tmp_path) -> None:
    write_colmap(tmp_path, camera_of(48, 48))
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.png").write_text("no image")
    (view,) = eg.load_cameras(tmp_path).values()
    with pytest.raises(ValueError, match=r"a\.png: expected a whole image"):
        eg.read_image(view.image)


def test_a_texture_is_laid_on_as_it_is_stored(tmp_path) -> None:
    """The texture is as the OBJ names it, and as Blender shows it."""
    pixels = np.random.default_rng(0).integers(0, 256, (4, 4, 3), dtype=np.uint8)
    write(tmp_path / "a.png", pixels, 6)
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd a.png\n")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    )
    named = eg.load_mesh(tmp_path / "a.obj")
    given = eg.load_mesh(tmp_path / "a.obj", texture=tmp_path / "a.png")
    assert torch.allclose(named.texture, given.texture, atol=1e-6)


def test_commands_read_pictures_as_their_camera_speaks_of_them(tmp_path, capsys) -> None:
    camera = camera_of(36, 48)
    eg.save_camera(tmp_path / "c.json", camera)
    write(tmp_path / "a.png", picture_of(camera), 6)
    check(View(camera, seen_by(tmp_path / "c.json", tmp_path / "a.png")))
    write(tmp_path / "b.png", np.rot90(picture_of(camera)), 6)
    check(View(camera, seen_by(tmp_path / "c.json", tmp_path / "b.png")))
    assert capsys.readouterr().err == ""
    write(tmp_path / "b.png", np.rot90(picture_of(camera), 2), 3)
    check(View(camera, seen_by(tmp_path / "c.json", tmp_path / "b.png")))
    assert "b.png: read upright, as its EXIF orientation 3 says" in capsys.readouterr().err
