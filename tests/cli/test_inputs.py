"""What commands read: depth, poses, labels, weights, and the focal length in a photograph."""

import argparse
import json
import math

import numpy as np
import pytest
import torch
from brackets import START
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

import edgegrad as eg
from edgegrad.cli import inputs

pytestmark = [pytest.mark.quick, pytest.mark.unsanitized]


def test_depth_files(tmp_path):
    """They hold whole numbers of 16 bits with a scale, or floating-point numbers, with NaN where nothing was
    measured."""
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
    """The photograph is 3 : 2, as 35 mm film is."""
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


def test_a_label_is_chosen(tmp_path):
    labels = np.zeros((4, 4), np.uint8)
    labels[1:3], labels[3] = 5, 2
    Image.fromarray(labels).save(tmp_path / "labels.png")
    assert inputs.read_coverage(tmp_path / "labels.png", 5).tolist() == (labels == 5).tolist()


def test_weights_of_three_levels_are_no_labels(tmp_path):
    levels = np.repeat(np.uint8([0, 128, 255]), 16)[:, None].repeat(48, 1)
    Image.fromarray(levels).save(tmp_path / "weight.png")
    np.testing.assert_allclose(inputs.read_weight(tmp_path / "weight.png").numpy(), levels / 255, atol=1e-6)
