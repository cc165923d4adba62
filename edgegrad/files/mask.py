"""Masks from image files: how much of each pixel an object covers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..check import check_int
from ..optional import require
from .image import DISPLAY, read_stored
from .paths import PathLike

GREY = 8 / 255  # by which channels of a grey image may differ, for JPEG does not keep them equal; unless all are faint
FAINT = 1 / 8  # whole numbers below this share of their range are labels: no mask covers so little at most
LOSSY = (".jpg", ".jpeg")  # whose black is noise, and no label
ROUNDING = 1e-3  # of coverage outside 0 … 1
LISTED = 8  # labels in an error


def read_mask(path: PathLike, label: int | None = None) -> Tensor:
    """(H, W) float32 from an image file: the share of each pixel that the object covers, from 0 to 1. Row 0 on top, upright as
    its EXIF orientation says.

    Numbers are taken as they are, without the sRGB curve: 128 of 255 is 0.5. (write_image() encodes by that curve: a mask is
    written by write_image(path, srgb_to_linear(mask)).) What counts is, in this order:

    - the alpha channel, unless it is 1 everywhere
    - grey: 1, 8 and 16 bit from black to white, floating point (EXR, float TIFF) from 0 to 1. Whole numbers of which the
      largest is 1 are labels: 0 beside the object, 1 on it
    - black and one other colour, or of a palette number 0 and another: 1 where it is the other

    label  the number of the object in an image of labels: grey of whole numbers, or a palette's numbers. 1 where the image has
           it, 0 elsewhere, also if it is nowhere. The mask of several is the sum of theirs

    Raises ValueError where it is none of these: several labels without label=, which are named, or a picture in colours; and what
    read_image() raises. Palettes need Pillow (edgegrad[files]).
    """
    if label is not None:
        check_int("label", label, 0, 2**32 - 1)
    color, alpha, largest = read_stored(path)
    if label is not None:
        return (_numbers(path, color, largest) == label).float()
    if alpha is not None and bool((alpha != 1.0).any()):
        return _coverage(path, alpha[..., 0])
    if color.shape[-1] not in (1, 3):
        raise ValueError(
            f"{path}: expected a mask in grey or in an alpha channel, got {color.shape[-1]} channels; save it as one"
        )
    if not _is_grey(color):
        return _two_colors(path, color)
    grey = color.mean(-1)
    if largest is None or float(grey.max()) >= FAINT or Path(path).suffix.lower() in LOSSY:
        return _coverage(path, grey)
    numbers = _whole(grey, largest)
    if int(numbers.max()) > 1:
        raise _several(path, numbers.unique().tolist(), " (nothing reaches an eighth of white, so it is no coverage)")
    return numbers.float()


def _is_grey(color: Tensor) -> bool:
    apart = float((color.amax(-1) - color.amin(-1)).max())
    return not apart > (GREY if float(color.max()) >= FAINT else 0.0)  # also where it is NaN, which is no colour


def _coverage(path: PathLike, values: Tensor) -> Tensor:
    """Raises ValueError unless they are from 0 to 1."""
    if not bool(((values >= -ROUNDING) & (values <= 1.0 + ROUNDING)).all()):  # nor NaN
        raise ValueError(
            f"{path}: expected coverage from 0 to 1, got {float(values.min()):g} to {float(values.max()):g}; of an image of "
            "labels choose one with label="
        )
    return values.clamp(0.0, 1.0).contiguous()


def _numbers(path: PathLike, color: Tensor, largest: int | None) -> Tensor:
    """(H, W) labels: a palette's numbers, or grey as it is stored. Raises ValueError or ImportError."""
    indexed = _indexed(path)
    if indexed is not None:
        return indexed[0]
    if color.shape[-1] not in (1, 3) or not _is_grey(color):
        raise ValueError(f"{path}: expected labels in grey or in a palette for label=, got colours; save their numbers")
    return color.mean(-1) if largest is None else _whole(color.mean(-1), largest)


def _whole(grey: Tensor, largest: int) -> Tensor:
    """int64, as they are stored."""
    return (grey.double() * largest).round().long()


def _two_colors(path: PathLike, color: Tensor) -> Tensor:
    """1 where the image is not its background. Raises ValueError or ImportError."""
    indexed = _indexed(path)
    if indexed is None:
        red, green, blue = (color.clamp(0.0, 1.0) * 255.0).round().long().unbind(-1)
        numbers, black = red << 16 | green << 8 | blue, [0]
    else:
        numbers, black = indexed
    used = torch.bincount(numbers.flatten()).nonzero().flatten().tolist()  # far faster than unique()
    # Number 0 of most palettes is black.
    background = [0] if 0 in black else [number for number in used if number in black] or [0]
    labels = [number for number in used if number not in background]
    if indexed is not None and len(labels) > 1:
        raise _several(path, [*background, *labels])
    if len(labels) > 1:
        raise ValueError(
            f"{path}: expected a mask in grey, in black and one colour, or in an alpha channel, got a picture of {len(used)} "
            "colours; make its mask first"
        )
    return (numbers == labels[0]).float() if labels else torch.zeros(numbers.shape)


def _several(path: PathLike, labels: list[int], why: str = "") -> ValueError:
    shown = ", ".join(map(str, sorted(labels)[:LISTED])) + ", …" * (len(labels) > LISTED)
    return ValueError(f"{path}: expected a mask of one object, got the labels {shown}{why}; choose one with label=")


def _indexed(path: PathLike) -> tuple[Tensor, list[int]] | None:
    """(H, W) int64 numbers of an image with a palette or of one bit, which OpenImageIO replaces by colours, and which of them are
    black; None of another. Raises ImportError without Pillow."""
    if Path(path).suffix.lower() not in DISPLAY:
        return None
    pillow = require("PIL.Image", "edgegrad[files]", "reading labels")
    turned = require("PIL.ImageOps", "edgegrad[files]", "reading labels").exif_transpose
    try:
        with pillow.open(path) as stored:
            if stored.mode not in ("P", "1"):
                return None
            image = turned(stored)
    except (
        OSError,
        SyntaxError,
        ValueError,
        pillow.DecompressionBombError,
    ):  # Pillow does not know all that OpenImageIO does
        return None
    numbers = torch.from_numpy(np.array(image, np.int64))
    if image.mode == "1":
        return numbers, [0]
    colors = np.asarray(image.getpalette("RGB")).reshape(-1, 3)
    return numbers, np.flatnonzero((colors == 0).all(1)).tolist()
