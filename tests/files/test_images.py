"""Images are read and written by the sRGB curve, in every kind of file, and errors name the file."""

import os

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
import torch
from mesh_files import TEXTURED, linear, saved, square_glb, write
from PIL import Image

import edgegrad as eg
from edgegrad.files.image import linear_to_srgb, read_image, srgb_to_linear, write_image

pytestmark = pytest.mark.unsanitized


def test_srgb_curve_is_the_standard_s_and_inverts():
    codes = np.arange(256)
    got = srgb_to_linear(torch.tensor(codes / 255.0))
    np.testing.assert_allclose(got.numpy(), linear(codes), rtol=1e-12, atol=0)
    assert got[0] == 0.0 and got[255] == 1.0
    # The constants of the standard are rounded, so the two halves of the curve meet only to about 1e-6.
    np.testing.assert_allclose(linear_to_srgb(got).numpy() * 255, codes, rtol=0, atol=2e-4)
    assert float(srgb_to_linear(torch.tensor(0.5))) == pytest.approx(0.21404114, rel=1e-6)


def test_srgb_curve_has_finite_gradients_at_zero():
    for curve in (srgb_to_linear, linear_to_srgb):
        x = torch.zeros(3, requires_grad=True)
        curve(x).sum().backward()
        assert torch.isfinite(x.grad).all() and (x.grad > 0).all()


def test_webp_is_read(tmp_path):
    """It has the stored values and their alpha. A file that ends early is no image."""
    pixels = np.random.default_rng(0).integers(40, 256, (20, 30, 4)).astype(np.uint8)
    file = tmp_path / "a.webp"
    Image.fromarray(pixels).save(file, lossless=True, exact=True)
    read = read_image(file)
    assert torch.equal((linear_to_srgb(read[..., :3]) * 255.0).round().byte(), torch.from_numpy(pixels[..., :3]))
    assert torch.equal((read[..., 3] * 255.0).round().byte(), torch.from_numpy(pixels[..., 3]))
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"a\.webp: expected a whole image"):
        read_image(file)


@pytest.mark.parametrize("suffix", ["png", "bmp", "tif", "exr", "hdr", "jpg"])
def test_image_round_trip(tmp_path, suffix):
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(6, 9, 3, generator=generator)
    if suffix == "jpg":  # smooth, since JPEG keeps little else
        image = image[:1, :1].expand(16, 24, 3) * torch.linspace(0.5, 1, 24)[:, None]
    path = tmp_path / f"a.{suffix}"
    write_image(path, image)
    back = read_image(path)
    assert back.dtype == torch.float32 and back.shape == image.shape and back.is_contiguous()
    if suffix == "exr":
        assert torch.equal(back, image)
    elif suffix == "hdr":
        assert ((back - image).abs() <= image.amax(-1, keepdim=True) / 128).all()  # one exponent for three channels
    else:
        steps = (linear_to_srgb(back) - linear_to_srgb(image)).abs() * 255
        assert float(steps.max()) <= (3.0 if suffix == "jpg" else 0.5001)
    assert [file.name for file in tmp_path.iterdir()] == [f"a.{suffix}"]  # no temporary file is left


def test_png_values_are_srgb_rounded_to_nearest_and_clipped(tmp_path):
    codes = torch.arange(256, dtype=torch.float64)
    shifted = torch.stack([codes - 0.49, codes, codes + 0.49]) / 255
    write_image(tmp_path / "r.png", srgb_to_linear(shifted))
    stored = np.asarray(Image.open(tmp_path / "r.png"))
    np.testing.assert_array_equal(stored, np.tile(np.arange(256), (3, 1)))
    np.testing.assert_allclose(read_image(tmp_path / "r.png")[0, :, 0].numpy(), linear(np.arange(256)), atol=2e-7)
    write_image(tmp_path / "c.png", torch.tensor([[-1.0, 7.0, 0.5]]))
    assert np.asarray(Image.open(tmp_path / "c.png")).tolist() == [[0, 255, 188]]


def test_alpha_is_kept_apart(tmp_path):
    stored = np.array([[[200, 100, 50, 128], [255, 255, 255, 0], [1, 2, 3, 255]]], np.uint8)
    Image.fromarray(stored).save(tmp_path / "a.png")
    image = read_image(tmp_path / "a.png")
    np.testing.assert_allclose(image[..., :3].numpy(), linear(stored[..., :3]), atol=1e-6)
    np.testing.assert_allclose(image[..., 3].numpy(), stored[..., 3] / 255.0, atol=1e-6)
    assert torch.equal(read_image(tmp_path / "a.png", channels=3), image[..., :3])
    write_image(tmp_path / "b.png", image)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "b.png")), stored)
    grey = torch.tensor([[[0.5, 0.25], [0.1, 1.0]]])
    write_image(tmp_path / "la.png", grey)
    np.testing.assert_allclose(read_image(tmp_path / "la.png").numpy(), grey.numpy(), atol=5e-3)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float16, np.float32])
@pytest.mark.parametrize("planes", ["contig", "separate"])
def test_colours_of_a_tiff_are_not_multiplied_by_alpha(tmp_path, dtype, planes):
    """TIFF 6.0 defines associated alpha: a file holds the colour times alpha."""
    one = 1.0 if np.dtype(dtype).kind == "f" else float(np.iinfo(dtype).max)
    half = round(one / 2) / one if one > 1 else 0.5
    straight = np.array([[[1.0, 0, 0, half], [0.2, 0.6, 1, 0.8]], [[0, 0, 0, 0], [0.5, 0.25, 0.75, 1]]])
    associated = straight.copy()
    associated[..., :3] *= straight[..., 3:]
    curve = (lambda x: x) if one == 1.0 else (lambda x: linear(255.0 * x))
    for name, stored in (("assocalpha", associated), ("unassalpha", straight)):
        numbers = (stored if one == 1.0 else np.round(stored * one)).astype(dtype)
        numbers = np.moveaxis(numbers, -1, 0) if planes == "separate" else numbers
        tifffile.imwrite(tmp_path / "a.tif", numbers, photometric="rgb", extrasamples=[name], planarconfig=planes)
        image = read_image(tmp_path / "a.tif").numpy()
        rounding = 2 / min(one, 2048) if one == 1.0 else 2 / one
        np.testing.assert_allclose(image[..., :3], curve(straight[..., :3]), rtol=0, atol=rounding)
        np.testing.assert_allclose(image[..., 3], straight[..., 3], rtol=0, atol=rounding)
        np.testing.assert_allclose(image[0, 0], [1, 0, 0, half], rtol=0, atol=1e-6)
    # More than alpha allows is white.
    over = np.array([[[one, 0.25 * one, 0, 0.5 * one]]])
    tifffile.imwrite(tmp_path / "a.tif", over.astype(dtype), photometric="rgb", extrasamples=["assocalpha"])
    np.testing.assert_allclose(read_image(tmp_path / "a.tif")[0, 0, 0], 2.0 if one == 1.0 else 1.0, atol=4e-3)
    # Light where nothing covers the pixel: there is nothing to divide by.
    glow = np.full((2, 2, 4), 0.25 * one)
    glow[..., 3] = 0
    tifffile.imwrite(tmp_path / "a.tif", glow.astype(dtype), photometric="rgb", extrasamples=["assocalpha"])
    np.testing.assert_allclose(read_image(tmp_path / "a.tif")[..., 0].numpy(), curve(0.25), atol=4e-3)


def test_an_exr_of_channels_first(tmp_path):
    values = torch.rand(3, 4, 5).permute(1, 2, 0)
    write_image(tmp_path / "a.exr", values)
    assert torch.equal(read_image(tmp_path / "a.exr"), values)


def test_an_exr_stays_multiplied_and_alpha_alone_is_an_image(tmp_path):
    values = torch.tensor([[[0.5, 0.0, 0.0, 0.5], [0.1, 0.2, 0.3, 0.0]]])
    write_image(tmp_path / "a.exr", values)
    assert torch.equal(read_image(tmp_path / "a.exr"), values)
    spec = oiio.ImageSpec(2, 1, 1, oiio.FLOAT)
    spec.channelnames, spec.alpha_channel = ("A",), 0
    output = oiio.ImageOutput.create(str(tmp_path / "b.exr"))
    assert output.open(str(tmp_path / "b.exr"), spec) and output.write_image(np.array([[[0.25], [0.5]]], np.float32))
    output.close()
    assert read_image(tmp_path / "b.exr").tolist() == [[[0.25], [0.5]]]


def test_cmyk_jpeg_and_exif_orientation(tmp_path):
    stored = np.full((8, 8, 3), (200, 100, 50), np.uint8)
    Image.fromarray(stored).convert("CMYK").save(tmp_path / "cmyk.jpg", quality=100)
    expected = linear(np.asarray(Image.open(tmp_path / "cmyk.jpg").convert("RGB")))
    np.testing.assert_allclose(read_image(tmp_path / "cmyk.jpg").numpy(), expected, atol=0.02)
    wide = Image.fromarray(np.random.default_rng(4).integers(0, 256, (3, 5, 3), dtype=np.uint8))
    exif = wide.getexif()
    exif[0x112] = 6  # to be shown turned clockwise by a quarter
    wide.save(tmp_path / "turned.png", exif=exif)
    expected = linear(np.rot90(np.asarray(wide), -1))
    np.testing.assert_allclose(read_image(tmp_path / "turned.png").numpy(), expected, atol=1e-6)


def test_further_images_of_a_file_are_named(tmp_path):
    pages = np.stack([np.full((2, 3), value, np.uint8) for value in (255, 0, 0)])
    tifffile.imwrite(tmp_path / "a.tif", pages, photometric="minisblack")
    with pytest.warns(UserWarning, match=r"a\.tif: the first of its images is read"):
        assert read_image(tmp_path / "a.tif").tolist() == np.ones((2, 3, 1)).tolist()


def test_channels_convert(tmp_path):
    write_image(tmp_path / "rgb.exr", torch.tensor([[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.5, 0.5, 0.5]]]))
    grey = read_image(tmp_path / "rgb.exr", channels=1)
    np.testing.assert_allclose(grey[0, :, 0].numpy(), [0.2126, 0.7152, 0.5], atol=1e-6)
    assert read_image(tmp_path / "rgb.exr", channels=4)[0, 0].tolist() == [1, 0, 0, 1]
    write_image(tmp_path / "y.exr", torch.tensor([[0.25, 2.0]]))
    assert read_image(tmp_path / "y.exr").shape == (1, 2, 1)
    assert read_image(tmp_path / "y.exr", channels=3)[0, 1].tolist() == [2, 2, 2]
    write_image(tmp_path / "many.exr", torch.arange(24.0).reshape(1, 2, 12))
    assert torch.equal(read_image(tmp_path / "many.exr"), torch.arange(24.0).reshape(1, 2, 12))
    with pytest.raises(ValueError, match=r"many\.exr: expected 1 or 3 colour channels, got 12"):
        read_image(tmp_path / "many.exr", channels=3)
    with pytest.raises(ValueError, match="channels: expected None, 1, 3 or 4"):
        read_image(tmp_path / "y.exr", channels=2)


def test_write_image_takes_what_a_loop_has_at_hand(tmp_path):
    values = torch.rand(3, 4, 3, dtype=torch.float64, requires_grad=True)
    write_image(tmp_path / "a.exr", values)
    assert torch.equal(read_image(tmp_path / "a.exr"), values.detach().float())
    for image in (values.detach().numpy(), values.half(), values.bfloat16(), values.transpose(0, 1), values.flip(0)):
        write_image(tmp_path / "b.png", image)
    write_image(str(tmp_path / "c.PNG"), values[..., 0])
    assert read_image(tmp_path / "c.PNG").shape == (3, 4, 1)


def test_curves_of_cameras(tmp_path):
    """Exponents, tables and functions agree with the formula for each value."""
    codes = np.arange(256, dtype=np.uint8)
    stored = np.stack([codes, codes[::-1], np.full(256, 100, np.uint8)], -1)[None]
    path = tmp_path / "a.png"
    Image.fromarray(stored).save(path)
    values = stored / 255.0
    tables = np.stack([np.linspace(0, 1, 256) ** g for g in (1.8, 2.2, 2.6)], -1)
    coarse = np.array([0.0, 0.1, 0.4, 1.0])
    for curve, expected in (
        (2.2, values**2.2),
        (1, values),
        (torch.from_numpy(tables), np.stack([tables[stored[..., c], c] for c in range(3)], -1)),
        (coarse, np.interp(values, np.linspace(0, 1, 4), coarse)),
        ([0.0, 4.0], 4.0 * values),
        (lambda v: 2.0 * v * v, 2.0 * values**2),
        ("srgb", linear(stored.astype(int))),
    ):
        np.testing.assert_allclose(read_image(path, curve=curve).numpy(), expected, atol=1e-6)
    grey = tmp_path / "grey.png"
    Image.fromarray(stored[..., 0]).save(grey)
    np.testing.assert_allclose(
        read_image(grey, curve=coarse)[..., 0], np.interp(values[..., 0], np.linspace(0, 1, 4), coarse), atol=1e-6
    )
    rgba = np.concatenate([stored, stored[..., :1]], -1)
    Image.fromarray(rgba).save(path)
    np.testing.assert_allclose(read_image(path, curve=2.0)[..., 3], values[..., 0], atol=1e-6)  # alpha has no curve


@pytest.mark.parametrize(
    ("curve", "error", "message"),
    [
        ("rec709", ValueError, "curve: expected \"srgb\", an exponent, a table or a function, got 'rec709'"),
        (0.0, ValueError, "curve: expected an exponent above 0 and up to 10, such as 2.2, got 0; 1 leaves"),
        (float("nan"), ValueError, "curve: expected an exponent above 0"),
        (None, TypeError, "curve: expected .* got None"),
        (True, TypeError, "curve: expected .* got True"),
        (
            [0.0, 0.5, 0.4, 1.0],
            ValueError,
            r"that rise with the value, got \[0.5\] and then \[0.4\] at entries 1 and 2; sort",
        ),
        ([0.3, 0.3], ValueError, "that rise with the value, got 0.3 everywhere"),
        ([-1.0, 1.0], ValueError, r"radiances from 0 up, got -1; take exp\(\) of logarithms"),
        ([0.0, float("inf")], ValueError, "curve: expected finite"),
        ([1.0], ValueError, r"curve: expected a table \(N,\), or \(N, 3\) .* got shape \(1,\)"),
        (torch.ones(256, 2), ValueError, r"curve: expected a table .* got shape \(256, 2\)"),
        (torch.linspace(0, 1, 9)[:, None].expand(9, 3), ValueError, r"for an image of 1 channel\(s\), got 3 columns"),
        (lambda v: v.sum(), ValueError, r"curve: expected a function that gives radiances in the shape .* got \(\)"),
        (lambda v: v / 0, ValueError, "curve: radiances: expected finite"),
    ],
)
def test_faults_of_curves(tmp_path, curve, error, message):
    path = tmp_path / "a.png"
    Image.fromarray(np.zeros((2, 3), np.uint8)).save(path)
    with pytest.raises(error, match=message):
        read_image(path, curve=curve)


def test_linear_files_have_no_curve(tmp_path):
    write_image(tmp_path / "a.exr", torch.ones(2, 2, 3))
    with pytest.raises(ValueError, match=r"curve: expected none for .*a.exr, whose floating-point pixels are linear"):
        read_image(tmp_path / "a.exr", curve=2.2)


def test_image_faults(tmp_path):
    image = torch.rand(3, 4, 3)
    with pytest.raises(ValueError, match=r"a\.gif: expected a file name that ends in \.png, \.jpg.*\.exr, \.hdr"):
        write_image(tmp_path / "a.gif", image)
    (tmp_path / "file").write_text("")
    with pytest.raises(
        OSError, match=r"a\.png: expected a folder to write to, got .*file \(Not a directory\)|File exists"
    ):
        write_image(tmp_path / "file" / "a.png", image)
    write_image(tmp_path / "new" / "folders" / "a.png", image)
    assert read_image(tmp_path / "new" / "folders" / "a.png").shape == (3, 4, 3)
    with pytest.raises(ValueError, match=r"img: expected finite numbers, got nan at \[1, 2, 0\]"):
        image_nan = image.clone()
        image_nan[1, 2, 0] = float("nan")
        write_image(tmp_path / "a.png", image_nan)
    with pytest.raises(TypeError, match=r"img: expected linear radiance of a floating dtype, got torch\.uint8"):
        write_image(tmp_path / "a.png", torch.zeros(2, 2, 3, dtype=torch.uint8))
    with pytest.raises(ValueError, match="img: expected shape"):
        write_image(tmp_path / "a.png", torch.zeros(2))
    for suffix, channels in (("png", 5), ("jpg", 4), ("jpg", 2), ("hdr", 1), ("bmp", 2)):
        with pytest.raises(ValueError, match=rf"a\.{suffix}: expected .* channels in a .* file, got {channels}"):
            write_image(tmp_path / f"a.{suffix}", torch.zeros(2, 2, channels))
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(ValueError, match=r"folder\.png: expected a file name, got a directory"):
        write_image(tmp_path / "folder.png", image)
    with pytest.raises(ValueError, match=r"folder\.png: expected a file, got a directory"):
        read_image(tmp_path / "folder.png")
    (tmp_path / "folder.png").rmdir()
    with pytest.raises(FileNotFoundError, match=r"gone\.png"):
        read_image(tmp_path / "gone.png")
    with pytest.raises(ValueError, match=r"a\.webm: expected a file name that ends in"):
        read_image(tmp_path / "a.webm")
    (tmp_path / "zero.png").write_bytes(b"")
    with pytest.raises(ValueError, match=r"zero\.png: expected data, got an empty file"):
        read_image(tmp_path / "zero.png")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["file", "new", "zero.png"]


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "tif", "exr", "hdr"])
def test_damaged_images(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    write_image(path, torch.rand(64, 64, 3))
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 3], b"not an image at all"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=rf"a\.{suffix}: expected a whole image") as caught:
            read_image(path)
        assert str(caught.value).count("ould not open file") <= 2  # the library keeps the errors of all its attempts


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    write_image(path, torch.zeros(2, 2, 3))
    before = path.read_bytes()

    def fail(*_):
        raise OSError("no space left")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="no space"):
        write_image(path, torch.ones(2, 2, 3))
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


STORED = np.random.default_rng(5).integers(0, 256, (4, 5, 4), dtype=np.uint8)


@pytest.mark.parametrize(
    "mode, channels",
    [("1", 1), ("L", 1), ("LA", 2), ("P", 3), ("RGB", 3), ("RGBA", 4), ("I;16", 1)],
)
def test_modes_of_png_and_tiff(tmp_path, mode, channels):
    """As textures they lose their alpha."""
    if mode == "I;16":
        image = Image.fromarray(np.random.default_rng(6).integers(0, 65536, (4, 5), dtype=np.uint16))
        values = np.asarray(image)[..., None] / 257.0
    else:
        image = Image.fromarray(STORED).convert("RGB").convert(mode) if mode != "RGBA" else Image.fromarray(STORED)
        if mode == "LA":
            image.putalpha(Image.fromarray(STORED[..., 3]))
        values = np.asarray(image.convert({"P": "RGB", "1": "L"}.get(mode, mode)), np.float64).reshape(4, 5, -1)
    colors = channels - (channels in (2, 4))
    expected = np.concatenate([linear(values[..., :colors]), values[..., colors:] / 255.0], -1)
    for suffix in ("png", "tif"):
        image.save(tmp_path / f"a.{suffix}")
        found = eg.read_image(tmp_path / f"a.{suffix}")
        assert found.shape == (4, 5, channels)
        # Pillow writes the 16-bit palette of a TIFF as 256 times the byte, not 257.
        loose = mode == "P" and suffix == "tif"
        np.testing.assert_allclose(found.numpy(), expected, atol=0.01 if loose else 1e-6)
    material = {"images": [{"bufferView": 3}], "textures": [{"source": 0}], "extra": [saved("PNG", image)]}
    mesh = eg.load_mesh(write(tmp_path, "a.glb", square_glb(TEXTURED, uv=True, **material)))
    np.testing.assert_allclose(mesh.texture.numpy(), np.broadcast_to(expected[..., :colors], (4, 5, 3)), atol=1e-6)
