"""Images in and out through OpenImageIO, and the sRGB curve between files and linear radiance."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..camera.convention_warnings import warn_of_bytes
from ..check import as_tensor, check_finite, check_not_meta, check_shape
from ..optional import require
from ..warnings import warn
from .curve import Curve, decoder
from .paths import PathLike, StoredPath, check_readable, check_suffix, replacing

DISPLAY = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")  # 8 bit, sRGB
RADIANCE = (".exr", ".hdr")  # floating point, linear
IMAGES = (*DISPLAY, *RADIANCE)
READABLE = (*IMAGES, ".webp")
MULTI_IMAGE = (".tif", ".tiff", ".exr", ".webp")  # may hold more images than one
MOST_NUMBERS = 1 << 30  # pixels times channels, four bytes each; a small file may announce more
_LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear Rec. 709 primaries, which sRGB shares


def srgb_to_linear(values: Tensor) -> Tensor:
    """Return the linear radiance of sRGB values, differentiable; the curve is IEC 61966-2-1's.

    Parameters
    ----------
    values : Tensor
        Of any shape, 0 … 1. The result has the same shape.

    Examples
    --------
    >>> import torch, edgegrad as eg
    >>> eg.image.srgb_to_linear(torch.tensor([0.0, 0.5, 1.0]))
    tensor([0.0000, 0.2140, 1.0000])
    """
    # The clamp keeps the power's unused branch, and its gradient, finite.
    curve = ((values.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(values <= 0.04045, values / 12.92, curve)


def linear_to_srgb(values: Tensor) -> Tensor:
    """Return the sRGB values of linear radiance of any shape, 0 … 1; differentiable. It inverts srgb_to_linear()."""
    curve = 1.055 * values.clamp(min=0.0031308) ** (1.0 / 2.4) - 0.055
    return torch.where(values <= 0.0031308, values * 12.92, curve)


def srgb_slope(values: Tensor) -> Tensor:
    """Return the derivative of linear_to_srgb(), of any shape, where it gives the sRGB `values`."""
    # The inverse of the other curve's slope.
    curve = (2.4 / 1.055 * ((values.clamp(min=0.04045) + 0.055) / 1.055) ** 1.4).reciprocal()
    return torch.where(values <= 0.04045, torch.full_like(values, 12.92), curve)


class Stored(NamedTuple):
    """The numbers of an image file: upright, or for a StoredPath as they are stored."""

    # (H, W, C) float32 or, where asked for, float64; not multiplied by alpha unless the file is an EXR; integers are from 0 to 1
    color: Tensor
    alpha: Tensor | None  # (H, W, 1)
    largest: int | None  # the integer that became 1; None for floating point


def read_stored(path: PathLike, exact: bool = False) -> Stored:
    """Return the numbers of an image file. With `exact`, integers of 32 bits become float64, which holds them all. Raises what
    read_image() raises."""
    file = check_readable(path, READABLE)
    oiio = require("OpenImageIO", "OpenImageIO", "reading images")
    hint = oiio.ImageSpec()
    hint["oiio:UnassociatedAlpha"] = 1
    stored = oiio.ImageBuf(str(file), 0, 0, hint)
    spec = stored.spec()  # from the header alone
    if (
        spec.full_width * spec.full_height * spec.nchannels > MOST_NUMBERS
        or spec.image_pixels() * spec.nchannels > MOST_NUMBERS
    ):
        raise ValueError(
            f"{path}: expected at most {MOST_NUMBERS} pixels times channels, got {spec.full_height} × {spec.full_width} × "
            f"{spec.nchannels}; make it smaller"
        )
    native = stored.nativespec().format
    deep = exact and native.basetype in (oiio.UINT32, oiio.INT32)  # even to doubles OpenImageIO converts them by floats
    kind = native.basetype if deep else oiio.FLOAT
    whole = stored if stored.read(0, 0, True, kind) else None
    if whole is not None and not isinstance(path, StoredPath):
        whole = oiio.ImageBufAlgo.reorient(whole)
    pixels = None if whole is None else whole.get_pixels(kind, whole.roi_full)
    if pixels is None or (stored.file_format_name == "jpeg" and not _jpeg_ends(file.read_bytes())):
        reason = _reason(stored)
        fix = "; save it as 8, 16 or 32 bit, by array.astype(numpy.uint16)" * ("64 bits per sample" in reason)
        raise ValueError(f"{path}: expected a whole image, got one that cannot be read ({reason}){fix}")
    if file.suffix.lower() in MULTI_IMAGE and (opened := oiio.ImageInput.open(str(file))) is not None:
        if opened.seek_subimage(1, 0):
            warn(f"images of {path}", f"{path}: the first of its images is read; save the others as files of their own")
        opened.close()
    largest = None
    if native.basetype not in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE):
        signed = native.basetype in (oiio.INT8, oiio.INT16, oiio.INT32, oiio.INT64)
        largest = 2 ** (8 * native.basesize() - signed) - 1
    image = torch.from_numpy(np.ascontiguousarray(pixels / np.float64(largest) if deep else pixels))
    a = stored.spec().alpha_channel
    if a < 0 or image.shape[-1] == 1:
        return Stored(image, None, largest)
    alpha, color = image[..., a : a + 1], torch.cat([image[..., :a], image[..., a + 1 :]], -1)
    # OpenImageIO divides only where it is told that the numbers may be unassociated, which a TIFF says of itself.
    if stored.file_format_name == "tiff" and not stored.spec().getattribute("oiio:UnassociatedAlpha"):
        color = torch.where(alpha > 0.0, color / alpha, color)
        color = color if largest is None else color.clamp(max=1.0)
    return Stored(color, alpha, largest)


def read_image(path: PathLike, channels: int | None = None, curve: Curve = "srgb") -> Tensor:
    """Return an image file as linear radiance (H, W, C) float32, row 0 on top, upright as its EXIF orientation says.

    A path that load_cameras() found is read as it is stored, because its camera describes these pixels. Integer pixels (PNG,
    JPEG, BMP, WebP, most TIFF; 8 or 16 bit, palette, CMYK) are sRGB and become linear, 0 … 1; floating-point pixels (EXR, HDR,
    float TIFF) are linear already. Alpha is the last channel, not gamma-corrected and not multiplied into the colours: a
    TIFF's associated alpha is divided out where it is above 0. EXR files hold colours times alpha, and these stay so. At most
    2³⁰ pixels times channels are read. read_mask() reads masks.

    Parameters
    ----------
    path : str or Path
    channels : None, 1, 3 or 4
        None keeps the channels of the file. 1 gives the luminance and 3 the colours, both without alpha; 4 adds an alpha of 1
        where the file has none.
    curve : "srgb", float, table or function, default "srgb"
        How integer pixels, as values v from 0 to 1, become radiance. A number γ means vᵞ, 1 for pixels that are linear
        already. A table (N,), or (N, 3) with a column for each colour, has the radiances of N values evenly spaced from 0 to
        1, as calibrations of a camera's response give it, and must rise. A function maps a tensor (n, C), float64, as those of
        colour-science do. Floating-point pixels take no curve.

    Raises
    ------
    FileNotFoundError, PermissionError, ValueError, TypeError, ImportError
        ValueError: the file is of another kind, damaged or too large, or its colours do not convert. ImportError: OpenImageIO
        is missing.
    """
    if channels not in (None, 1, 3, 4):
        raise ValueError(f"channels: expected None, 1, 3 or 4, got {channels!r}")
    decoded = decoder(curve, srgb_to_linear)
    color, alpha, largest = read_stored(path)
    if largest is None and decoded is not srgb_to_linear:
        raise ValueError(
            f"curve: expected none for {path}, whose floating-point pixels are linear, got one; leave it out"
        )
    # OpenImageIO's own conversion depends on the OCIO configuration that it finds.
    if largest is not None:
        for rows in color.split(
            max(1, (1 << 20) // color[0].numel())
        ):  # in place: doubles of all would be twice the image
            rows.copy_(decoded(rows.double().flatten(0, 1)).reshape(rows.shape))
    if channels is not None and color.shape[-1] not in (1, 3):
        raise ValueError(f"{path}: expected 1 or 3 colour channels, got {color.shape[-1]}; read it without channels=…")
    if channels == 1 and color.shape[-1] == 3:
        color = color @ color.new_tensor(_LUMINANCE)[:, None]
    elif channels in (3, 4) and color.shape[-1] == 1:
        color = color.expand(-1, -1, 3)
    if channels == 4 and alpha is None:
        alpha = torch.ones_like(color[..., :1])
    return (color if alpha is None or channels in (1, 3) else torch.cat([color, alpha], -1)).contiguous()


def read_size(path: PathLike) -> tuple[int, int]:
    """Return the size (H, W) that read_image() would give, from the header alone. Raises what read_image() raises."""
    spec = _header(path).spec()
    turned = spec.getattribute("Orientation") in (5, 6, 7, 8) and not isinstance(path, StoredPath)
    return (spec.full_width, spec.full_height) if turned else (spec.full_height, spec.full_width)


def read_orientation(path: PathLike) -> int:
    """Return the EXIF orientation of an image file, 1 to 8, or 1 without one. Raises what read_image() raises."""
    return _header(path).spec().getattribute("Orientation") or 1


def _header(path: PathLike) -> Any:
    file = check_readable(path, READABLE)
    stored = require("OpenImageIO", "OpenImageIO", "reading images").ImageBuf(str(file))
    spec = stored.spec()
    if not spec.full_width or not spec.full_height:
        raise ValueError(f"{path}: expected a whole image, got one that cannot be read ({_reason(stored)})")
    return stored


def write_image(path: PathLike, img: Tensor) -> None:
    """Write linear radiance to an image file.

    PNG, JPEG, BMP and TIFF are clipped to 0 … 1, sRGB, 8 bit, rounded to nearest, with up to 4 channels (of 2 and 4 the last
    is alpha, not gamma-corrected; JPEG holds 1 or 3). HDR is linear with 3 channels. EXR is linear float32 with any number.
    The file appears whole or not at all; an existing one is replaced, and missing folders are made. Masks, which read_mask()
    takes as they are, are written as eg.image.srgb_to_linear(mask); depths as EXR.

    Parameters
    ----------
    path : str or Path
    img : (H, W) or (H, W, C) tensor of any floating dtype, on any device
        Radiance, row 0 on top.

    Raises
    ------
    ValueError, TypeError, OSError, ImportError
        ValueError: unknown ending, wrong shape, NaN or infinity. TypeError: not floating-point. OSError: it cannot be written.
        ImportError: OpenImageIO is missing.

    Examples
    --------
    >>> import tempfile, torch, edgegrad as eg
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     eg.write_image(f"{folder}/grey.png", torch.full((2, 3, 3), 0.2140))
    ...     eg.read_image(f"{folder}/grey.png").shape
    torch.Size([2, 3, 3])
    """
    file = check_suffix(path, IMAGES)
    image = as_tensor("img", img).detach()
    if not image.is_floating_point():
        raise TypeError(
            f"img: expected linear radiance of a floating dtype, got {image.dtype}; "
            "for 8-bit sRGB values use srgb_to_linear(img / 255)"
        )
    check_not_meta("img", image)
    check_shape("img", image, ("H", "W"), ("H", "W", "C"))
    image = image.cpu().float().reshape(*image.shape[:2], -1)
    check_finite("img", image)
    warn_of_bytes("img", image)
    H, W, C = image.shape
    suffix = file.suffix.lower()
    allowed = {".jpg": (1, 3), ".jpeg": (1, 3), ".bmp": (1, 3, 4), ".hdr": (3,)}.get(suffix, (1, 2, 3, 4))
    if suffix != ".exr" and C not in allowed:
        good = " or ".join(map(str, allowed))
        raise ValueError(f"{path}: expected {good} channels in a {suffix} file, got {C}; pick some, or write an .exr")

    oiio = require("OpenImageIO", "OpenImageIO", "writing images")
    spec = oiio.ImageSpec(W, H, C, oiio.FLOAT if suffix in RADIANCE else oiio.UINT8)
    if suffix in RADIANCE:
        pixels = image.numpy()
        if C == 2 or C > 4:
            # EXR sorts channels by name: numbers of equal length keep their order, and no name makes one an alpha.
            spec.channelnames = tuple(f"c{c:05d}" for c in range(C))
    else:
        shown = image.clamp(0.0, 1.0)
        color = shown if C in (1, 3) else shown[..., :-1]
        encoded = torch.cat([linear_to_srgb(color), shown[..., color.shape[-1] :]], -1)
        pixels = (encoded * 255.0).round().to(torch.uint8).numpy()
        spec["oiio:ColorSpace"] = "srgb_rec709_scene"
        spec["oiio:UnassociatedAlpha"] = 1
        spec.alpha_channel = -1 if C in (1, 3) else C - 1
        spec["Compression"] = {".jpg": "jpeg:95", ".jpeg": "jpeg:95", ".tif": "zip", ".tiff": "zip"}.get(suffix, "")
        spec["jpeg:subsampling"] = "4:4:4"
    with replacing(path) as temporary:
        output = oiio.ImageOutput.create(str(temporary))
        if output is None:
            raise OSError(f"{path}: cannot write a {suffix} file ({oiio.geterror()})")
        done = output.open(str(temporary), spec) and output.write_image(np.ascontiguousarray(pixels))
        reason = _reason(output)
        if not (output.close() and done):
            raise OSError(f"{path}: cannot write the image ({reason})")


def to_bytes(values: Tensor, linear: bool = False) -> np.ndarray:
    """Return uint8 (…, 3) of values (…, 1) or (…, 3), clipped to 0 … 1; as sRGB unless `linear`."""
    values = values.detach().cpu().double().clamp(0.0, 1.0)
    values = values.expand(*values.shape[:-1], 3)
    return ((values if linear else linear_to_srgb(values)) * 255.0).round().to(torch.uint8).contiguous().numpy()


def _reason(source: object) -> str:
    """Return the errors of an OpenImageIO object, each once, on one line."""
    try:
        lines = dict.fromkeys(" ".join(line.split()) for line in source.geterror().splitlines())  # type: ignore[attr-defined]
        return " ".join(lines) or "it ends early"
    except UnicodeDecodeError:  # it quotes the damaged file
        return "damaged header"


def _jpeg_ends(data: bytes) -> bool:
    """Return whether a JPEG has its end marker; without it, the decoder silently fills the rest with grey."""
    at = 2
    # Past the header first: a thumbnail in it has an end marker of its own.
    while data[at : at + 1] == b"\xff" and data[at : at + 2] != b"\xff\xda":
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return data.find(b"\xff\xd9", at) >= 0
