"""Masks are the coverage that was written, in every kind of file."""

import io
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
import torch
from PIL import Image, ImageFilter

import edgegrad as eg

pytestmark = pytest.mark.filterwarnings("error::UserWarning")  # those that are expected are caught
SHARES = np.array([[0, 51, 128], [204, 255, 1]], np.uint8)
LABELS = np.array([[0, 0, 1, 1], [0, 3, 1, 1], [0, 7, 7, 0]], np.uint8)


def agree(path: Path, expected: np.ndarray, label: int | None = None) -> None:
    mask = eg.read_mask(path, label)
    assert mask.dtype == torch.float32 and mask.is_contiguous()
    np.testing.assert_allclose(mask.numpy(), expected, rtol=0, atol=1e-6)


def palette(numbers: np.ndarray, *colors: tuple[int, int, int]) -> Image.Image:
    image = Image.new("P", numbers.shape[::-1])
    image.putdata(numbers.ravel().tolist())
    image.putpalette([value for color in colors for value in color])
    return image


def exr(path: Path, values: np.ndarray, names: tuple[str, ...]) -> None:
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], len(names), oiio.FLOAT)
    spec.channelnames = names
    spec.alpha_channel = names.index("A") if "A" in names else -1
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(np.ascontiguousarray(values, np.float32))
    output.close()


@pytest.mark.parametrize("ending", ["png", "bmp", "tif"])
def test_greys_are_coverage_without_a_curve(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a.{ending}"
    Image.fromarray(SHARES).save(path)
    agree(path, SHARES / 255)
    Image.fromarray(np.stack([SHARES] * 3, -1)).save(path)
    agree(path, SHARES / 255)
    Image.fromarray(SHARES > 100).save(path)
    agree(path, SHARES > 100)


def test_deep_and_float_greys(tmp_path: Path) -> None:
    deep = SHARES.astype(np.uint16) * 257 + (SHARES == 128)
    Image.fromarray(deep).save(tmp_path / "a.png")
    agree(tmp_path / "a.png", deep / 65535)
    tifffile.imwrite(tmp_path / "a.tif", SHARES / np.float32(255))
    agree(tmp_path / "a.tif", SHARES / 255)
    exr(tmp_path / "a.exr", SHARES[..., None] / 255, ("Y",))
    agree(tmp_path / "a.exr", SHARES / 255)
    exr(tmp_path / "faint.exr", SHARES[..., None] / 25500, ("Y",))  # floats are no labels, however small
    agree(tmp_path / "faint.exr", SHARES / 25500)


def test_jpeg_is_coverage_but_for_its_noise(tmp_path: Path) -> None:
    wide = np.kron(SHARES, np.ones((16, 16), np.uint8))
    for name, stored in (("grey", wide), ("rgb", np.stack([wide] * 3, -1)), ("black", np.minimum(wide, 2))):
        Image.fromarray(stored).save(tmp_path / f"{name}.jpg", quality=90)
        found = eg.read_mask(tmp_path / f"{name}.jpg").numpy() * 255
        assert np.abs(found - (stored if stored.ndim == 2 else wide)).max() < 12


def test_alpha_that_varies_goes_before_colours(tmp_path: Path) -> None:
    rgba = np.random.default_rng(0).integers(0, 256, (2, 3, 4), dtype=np.uint8)
    rgba[..., 3] = SHARES
    for ending in ("png", "bmp", "tif"):
        Image.fromarray(rgba).save(tmp_path / f"a.{ending}")
        agree(tmp_path / f"a.{ending}", SHARES / 255)
    Image.fromarray(rgba[..., 2:]).save(tmp_path / "la.png")
    agree(tmp_path / "la.png", SHARES / 255)
    opaque = np.dstack([SHARES, SHARES, SHARES, np.full_like(SHARES, 255)])
    Image.fromarray(opaque).save(tmp_path / "opaque.png")
    agree(tmp_path / "opaque.png", SHARES / 255)
    exr(tmp_path / "rgba.exr", np.dstack([SHARES * 0, SHARES * 0, SHARES * 0, SHARES / 255]), ("R", "G", "B", "A"))
    agree(tmp_path / "rgba.exr", SHARES / 255)
    exr(tmp_path / "alone.exr", SHARES[..., None] / 255, ("A",))
    agree(tmp_path / "alone.exr", SHARES / 255)
    tifffile.imwrite(tmp_path / "associated.tif", rgba, photometric="rgb", extrasamples=["assocalpha"])
    agree(tmp_path / "associated.tif", SHARES / 255)
    clear = palette(LABELS, (0, 0, 0), (9, 99, 200))
    clear.save(tmp_path / "clear.png", transparency=0)
    agree(tmp_path / "clear.png", LABELS != 0)


def test_labels_of_zero_and_one(tmp_path: Path) -> None:
    ones = LABELS == 1
    for name, dtype in (("a.png", np.uint8), ("b.png", np.uint16)):
        Image.fromarray(ones.astype(dtype)).save(tmp_path / name)
        agree(tmp_path / name, ones)
    for dtype in (np.uint8, np.int8, np.uint16, np.int32, np.float32):
        tifffile.imwrite(tmp_path / "a.tif", ones.astype(dtype))
        agree(tmp_path / "a.tif", ones)
    Image.fromarray(np.zeros((2, 3), np.uint8)).save(tmp_path / "empty.png")
    agree(tmp_path / "empty.png", np.zeros((2, 3)))


@pytest.mark.parametrize(
    "name, dtype", [("a.png", np.uint8), ("a.png", np.uint16), ("a.tif", np.int32), ("a.tif", np.float32)]
)
def test_several_labels_are_named_and_chosen(tmp_path: Path, name: str, dtype: type) -> None:
    path = tmp_path / name
    tifffile.imwrite(path, LABELS.astype(dtype)) if name.endswith("tif") else Image.fromarray(
        LABELS.astype(dtype)
    ).save(path)
    fault = "coverage from 0 to 1, got 0 to 7; .* label=" if dtype is np.float32 else "labels 0, 1, 3, 7 .* label="
    with pytest.raises(ValueError, match=rf"{name}: expected .*{fault}"):
        eg.read_mask(path)
    for label in (0, 1, 3, 7):
        agree(path, np.equal(LABELS, label), label)
    with pytest.raises(
        ValueError, match=rf"{name}: expected label 9 in it, got the labels 0(\.0)?, 1.*, 7(\.0)?; choose one"
    ):
        eg.read_mask(path, 9)


def regions(*numbers: int) -> np.ndarray:
    """Return labels in bands, and the last one on a disc."""
    y, x = np.mgrid[:48, :64]
    image = np.array(numbers[:-1])[y * (len(numbers) - 1) // 48]
    image[(x - 30) ** 2 + (y - 25) ** 2 < 150] = numbers[-1]
    return image


@pytest.mark.parametrize(
    "numbers",
    [
        (0, 7, 33, 26),
        (0, 1, 18, 90, 255),
        (0, 12, 150),
        (0, 255, 1),
        (255, 0, 1),
        (0, 128, 255),
        (26, 33),
        (*range(0, 256, 51),),
    ],
)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_labels_that_reach_beyond_an_eighth_of_white(tmp_path: Path, numbers: tuple[int, ...], dtype: type) -> None:
    """The labels are those of Cityscapes, COCO and ADE, and a void of 255."""
    labels = regions(*numbers)
    stored = (labels * (1 if dtype is np.uint8 else 257)).astype(dtype)
    Image.fromarray(stored).save(tmp_path / "a.png")
    listed = ", ".join(map(str, np.unique(stored)[:8]))
    with pytest.raises(
        ValueError, match=rf"a\.png: expected a mask of one object, got the labels {listed}.* label=, or save cov"
    ):
        eg.read_mask(tmp_path / "a.png")
    for label in np.unique(stored):
        agree(tmp_path / "a.png", stored == label, int(label))
    rgb = np.stack([labels.astype(np.uint8)] * 3, -1)
    Image.fromarray(rgb).save(tmp_path / "b.png")
    with pytest.raises(ValueError, match=r"b\.png: expected a mask of one object"):
        eg.read_mask(tmp_path / "b.png")


def test_borders_that_are_smooth_are_coverage(tmp_path: Path) -> None:
    fine = Image.fromarray(np.kron(regions(0, 1), np.ones((8, 8), np.int64)).astype(np.uint8) * 255)
    exact = fine.resize((64, 48), Image.Resampling.BOX)
    jpeg = io.BytesIO()
    fine.save(jpeg, "jpeg", quality=75)
    spot = np.array(exact)
    spot[0, 0] = 1
    blurred = [
        image.filter(ImageFilter.GaussianBlur(r)) for image in (fine, exact.point(lambda x: x // 4)) for r in (1, 4)
    ]
    several = [
        exact,
        exact.resize((128, 96), Image.Resampling.NEAREST),
        Image.open(jpeg),
        Image.fromarray(spot),
        *blurred,
    ]
    for i, image in enumerate([*several, Image.fromarray(regions(0, 128).astype(np.uint8))]):
        image.save(tmp_path / f"{i}.png")
        agree(tmp_path / f"{i}.png", np.array(image) / 255)
    tifffile.imwrite(tmp_path / "three.tif", regions(0, 128, 255) / np.float32(255))  # floats are no labels
    agree(tmp_path / "three.tif", regions(0, 128, 255) / 255)


def test_labels_beyond_what_float32_holds(tmp_path: Path) -> None:
    many = np.array([[0, 1, 16777216], [16777217, 4294967294, 4294967295]], np.uint32)
    tifffile.imwrite(tmp_path / "a.tif", many)
    for label in many.ravel().tolist():
        agree(tmp_path / "a.tif", many == label, label)
    spec = oiio.ImageSpec(3, 2, 1, oiio.UINT32)
    output = oiio.ImageOutput.create(str(tmp_path / "a.exr"))
    assert output.open(str(tmp_path / "a.exr"), spec) and output.write_image(many[..., None])
    output.close()
    for label in many.ravel().tolist():
        agree(tmp_path / "a.exr", many == label, label)
    tifffile.imwrite(tmp_path / "b.tif", (many > 1).astype(np.uint32))
    agree(tmp_path / "b.tif", many > 1)
    for dtype in (np.int64, np.uint64):
        tifffile.imwrite(tmp_path / "c.tif", many.astype(dtype))
        with pytest.raises(ValueError, match=r"c\.tif: .* 64 bits per sample.*; save it as 8, 16 or 32 bit"):
            eg.read_mask(tmp_path / "c.tif")


def test_eight_bits_in_sixteen_are_named(tmp_path: Path) -> None:
    Image.fromarray(np.uint16([[0, 255], [255, 0]])).save(tmp_path / "a.png")
    with pytest.raises(
        ValueError, match=r"labels 0, 255 \(coverage of 16 bits goes up to 65535: is it 8 bits, saved in more"
    ):
        eg.read_mask(tmp_path / "a.png")


def test_inverted_masks_are_named(tmp_path: Path) -> None:
    for name, numbers in (("object", (0, 255)), ("inverted", (255, 0)), ("all", (255, 255))):
        Image.fromarray(regions(*numbers).astype(np.uint8)).save(tmp_path / f"{name}.png")
    eg.read_mask(tmp_path / "object.png")
    eg.read_mask(tmp_path / "all.png")
    left = (regions(1, 0)[12:36, 16:48]).mean()
    with pytest.warns(
        UserWarning, match=rf"inverted\.png: the mask covers the border .* and {left:.0%} of its middle; .* 1 - mask"
    ):
        agree(tmp_path / "inverted.png", regions(1, 0))
    agree(tmp_path / "inverted.png", regions(1, 0), 255)  # as was asked for


def test_palettes(tmp_path: Path) -> None:
    one = np.where(LABELS == 1, 1, 0)
    path = tmp_path / "a.png"
    # As of DAVIS and VOC: a dark red, 0.1 of white by its luminance.
    palette(one, (0, 0, 0), (128, 0, 0)).save(path)
    agree(path, one)
    palette(one, (0, 0, 0), (128, 0, 0)).save(tmp_path / "a.bmp")
    agree(tmp_path / "a.bmp", one)
    palette(one, (128, 0, 0), (0, 0, 0)).save(path)  # black is the background, whatever its number
    agree(path, 1 - one)
    palette(one, (0, 90, 0), (128, 0, 0)).save(path)
    agree(path, one)
    palette(one * 0 + 1, (0, 0, 0), (128, 0, 0)).save(path)  # the object fills the image
    agree(path, one * 0 + 1)
    ramp = palette(SHARES, *[(value, value, value) for value in range(256)])
    ramp.save(path)
    agree(path, SHARES / 255)
    palette(LABELS, *[(0, 0, 0), *[(20 * k, 0, 255 - k) for k in range(1, 8)]]).save(path)
    with pytest.raises(
        ValueError, match=r"expected a mask of one object, got the labels 0, 1, 3, 7; choose one with label="
    ):
        eg.read_mask(path)
    for label in (0, 1, 3, 7):
        agree(path, np.equal(LABELS, label), label)
    two = np.where(LABELS == 3, 2, one)
    palette(two, (0, 0, 0), (0, 0, 0), (128, 0, 0)).save(path)  # a second black is a label
    with pytest.raises(ValueError, match=r"got the labels 0, 1, 2; choose"):
        eg.read_mask(path)
    palette(LABELS, *[(0, 0, 0)] * 8).save(path)  # labels that no colour separates
    agree(path, LABELS == 3, 3)
    Image.fromarray(LABELS == 1).save(path)
    agree(path, LABELS == 1, 1)


def test_two_colours_are_a_mask_and_a_photograph_is_none(tmp_path: Path) -> None:
    red = np.zeros((3, 4, 3), np.uint8)
    red[LABELS == 1] = 200, 0, 0
    Image.fromarray(red).save(tmp_path / "red.png")
    agree(tmp_path / "red.png", LABELS == 1)
    for dark in (1, 9):  # a number in one channel is no grey
        Image.fromarray(np.where(red > 0, dark, red).astype(np.uint8)).save(tmp_path / "dark.png")
        agree(tmp_path / "dark.png", LABELS == 1)
    green = np.where(red[..., :1] > 0, (200, 0, 0), (0, 200, 0)).astype(np.uint8)
    Image.fromarray(green).save(tmp_path / "green.png")
    with pytest.raises(ValueError, match=r"green\.png: expected a mask in grey, .* got a picture of 2 colours"):
        eg.read_mask(tmp_path / "green.png")
    noisy = np.stack([np.full((3, 4), 200), np.full((3, 4), 203), np.full((3, 4), 198)], -1).astype(np.uint8)
    Image.fromarray(noisy).save(tmp_path / "noisy.png")  # once a JPEG
    np.testing.assert_allclose(eg.read_mask(tmp_path / "noisy.png").numpy(), 601 / 765, atol=1e-6)
    with pytest.raises(ValueError, match=r"red\.png: expected labels in grey or in a palette for label=, got colours"):
        eg.read_mask(tmp_path / "red.png", 1)
    photo = np.random.default_rng(1).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    Image.fromarray(photo).save(tmp_path / "photo.png")
    with pytest.raises(ValueError, match=r"photo\.png: expected a mask in grey, .* got a picture of 64 colours"):
        eg.read_mask(tmp_path / "photo.png")


def test_masks_stand_upright(tmp_path: Path) -> None:
    turned = palette(LABELS, (0, 0, 0), *[(20 * k, 0, 255 - k) for k in range(1, 8)])
    exif = turned.getexif()
    exif[0x112] = 6  # to be shown turned clockwise by a quarter
    turned.save(tmp_path / "labels.png", exif=exif)
    agree(tmp_path / "labels.png", np.rot90(LABELS, -1) == 7, 7)
    Image.fromarray(SHARES).save(tmp_path / "grey.png", exif=exif)
    agree(tmp_path / "grey.png", np.rot90(SHARES, -1) / 255)


def test_mask_faults(tmp_path: Path) -> None:
    for values, got in (
        (SHARES / 100.0, "0 to 2.55"),
        (SHARES / 255.0 - 0.5, "-0.5 to 0.5"),
        (SHARES * np.nan, "nan to nan"),
    ):
        exr(tmp_path / "a.exr", values[..., None], ("Y",))
        with pytest.raises(ValueError, match=rf"a\.exr: expected coverage from 0 to 1, got {got}"):
            eg.read_mask(tmp_path / "a.exr")
    exr(tmp_path / "a.exr", np.zeros((2, 3, 5)), tuple("uvwxy"))
    with pytest.raises(ValueError, match=r"a\.exr: expected a mask in grey or in an alpha channel, got 5 channels"):
        eg.read_mask(tmp_path / "a.exr")
    with pytest.raises(FileNotFoundError, match=r"gone\.png"):
        eg.read_mask(tmp_path / "gone.png")
    with pytest.raises(TypeError, match="label: expected"):
        eg.read_mask(tmp_path / "a.exr", "object")
    with pytest.raises(ValueError, match="label: expected an int from 0"):
        eg.read_mask(tmp_path / "a.exr", -1)
