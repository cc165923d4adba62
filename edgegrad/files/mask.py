"""Masks from image files: how much of each pixel an object covers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..check import check_int
from ..optional import require
from ..warnings import warn
from .image import DISPLAY, read_stored
from .paths import PathLike, StoredPath

GREY = 8 / 255  # by which channels of a grey image may differ, for JPEG does not keep them equal; unless all are faint
FAINT = 1 / 8  # whole numbers below this share of their range are labels: no mask covers so little at most
LOSSY = (".jpg", ".jpeg", ".webp")  # whose black is noise, and no label
ROUNDING = 1e-3  # of coverage outside 0 … 1
FLAT = 0.5  # of pixels of labels that have the same all around; of those of a smooth border there are far fewer
MOST_LABELS = 64
BYTE = 255
LISTED = 8  # labels in an error


def read_mask(path: PathLike, label: int | None = None) -> Tensor:
    """Return a mask (H, W) float32 from an image file: the share of each pixel that the object covers, from 0 to 1.

    Row 0 is on top, upright as the EXIF orientation says. Numbers are taken as they are, without the sRGB curve: 128 of 255 is
    0.5. (write_image() applies that curve: write a mask by write_image(path, srgb_to_linear(mask)).) The first of these that
    applies counts:

    - The alpha channel, unless it is 1 everywhere.
    - Grey: 1, 8 and 16 bit from black to white, floating point (EXR, float TIFF) from 0 to 1. Whole numbers up to 1 are
      labels: 0 off the object, 1 on it. There are several labels where few numbers, none of which is 0 or the largest, fill
      areas, as the greys of a smooth border do not.
    - Black and one other colour, or number 0 of a palette and another: 1 at the other.

    A warning tells of what appears to be an inverted mask. Palettes need Pillow (edgegrad[files]).

    Parameters
    ----------
    path : str or Path
    label : int, default none
        Number of the object in an image of labels: grey of whole numbers, or a palette's numbers. The mask is 1 at this label
        and 0 elsewhere; add masks for several objects.

    Raises
    ------
    ValueError
        There are several labels without label=, or not this one (the message names those that occur), or a picture in colours.
        And what read_image() raises.
    """
    if label is not None:
        check_int("label", label, 0, 2**32 - 1)
    color, alpha, largest = read_stored(path, exact=True)
    if label is not None:
        numbers = _numbers(path, color, largest)
        chosen = (numbers == label).float()
        if not bool(chosen.any()):
            raise ValueError(
                f"{path}: expected label {label} in it, got {_listed(_used(numbers))}; choose one with label="
            )
        return chosen
    mask = _covered(path, color, alpha, largest)
    _warn_of_inverted(path, mask)
    return mask


def read_weight(path: PathLike) -> Tensor:
    """Return weights (H, W) float32 from an image file, from 0 to 1 without the sRGB curve. They are its alpha unless that is 1
    everywhere, else its grey. Whole numbers are no labels here. Raises what read_mask() raises."""
    color, alpha, _ = read_stored(path)
    if alpha is not None and bool((alpha != 1.0).any()):
        return _coverage(path, alpha[..., 0])
    if color.shape[-1] not in (1, 3) or not _is_grey(color):
        raise ValueError(f"{path}: expected weights in grey or in an alpha channel, got colours; save them as one")
    return _coverage(path, color.mean(-1))


def _covered(path: PathLike, color: Tensor, alpha: Tensor | None, largest: int | None) -> Tensor:
    if alpha is not None and bool((alpha != 1.0).any()):
        return _coverage(path, alpha[..., 0])
    if color.shape[-1] not in (1, 3):
        raise ValueError(
            f"{path}: expected a mask in grey or in an alpha channel, got {color.shape[-1]} channels; save it as one"
        )
    if not _is_grey(color):
        return _two_colors(path, color)
    grey = color.mean(-1)
    if largest is None or Path(path).suffix.lower() in LOSSY:
        return _coverage(path, grey)
    if float(grey.max()) >= FAINT:
        if (labels := _areas(grey, largest)) is not None:
            raise _several(
                path,
                labels,
                " (greys between fill areas, as at no smooth border)",
                ", or save coverage as floating point",
            )
        return _coverage(path, grey)
    numbers = _whole(grey, largest)
    most = int(numbers.max())
    if most > 1:
        why = " (nothing reaches an eighth of white, so it is no coverage)"
        if largest > BYTE and BYTE // 2 <= most <= BYTE:
            why = f" (coverage of {8 * (largest.bit_length() // 8)} bits goes up to {largest}: is it 8 bits, saved in more?)"
        raise _several(path, _used(numbers), why)
    return numbers.float()


def _areas(grey: Tensor, largest: int) -> list[int] | None:
    """Return the numbers of an image (H, W) that appear to be labels, else None. A smooth border is one to a few pixels wide,
    and its greys differ from one pixel to the next. Nearly none has the same grey all around, as nearly all pixels inside a
    label have."""
    between = (grey > 0.0) & (grey < grey.max())
    count = int(between.sum())
    if count == 0 or min(grey.shape) < 3:
        return None
    low, high = (
        sign * torch.nn.functional.max_pool2d((sign * grey)[None, None], 3, stride=1)[0, 0] for sign in (-1.0, 1.0)
    )
    if int(((low == high) & between[1:-1, 1:-1]).sum()) < FLAT * count:
        return None
    numbers = _used(_whole(grey, largest))
    return numbers if len(numbers) <= MOST_LABELS else None


def _warn_of_inverted(path: PathLike, mask: Tensor) -> None:
    height, width = mask.shape
    if min(height, width) < 8:
        return
    border = torch.cat([mask[0], mask[-1], mask[1:-1, 0], mask[1:-1, -1]])
    middle = mask[height // 4 : height - height // 4, width // 4 : width - width // 4]
    if float(border.mean()) > 0.95 and float(middle.mean()) < 0.9:
        warn(
            f"inverted {path}",
            f"{path}: the mask covers the border of the image and {float(middle.mean()):.0%} of its middle; if the object is "
            "what it leaves out, invert it: 1 - mask",
        )


def _is_grey(color: Tensor) -> bool:
    apart = float((color.amax(-1) - color.amin(-1)).max())
    return not apart > (GREY if float(color.max()) >= FAINT else 0.0)  # also where it is NaN, which is no colour


def _coverage(path: PathLike, values: Tensor) -> Tensor:
    """Return the values as a mask. Raises ValueError unless they are from 0 to 1."""
    if not bool(((values >= -ROUNDING) & (values <= 1.0 + ROUNDING)).all()):  # nor NaN
        raise ValueError(
            f"{path}: expected coverage from 0 to 1, got {float(values.min()):g} to {float(values.max()):g}; of an image of "
            "labels choose one with label="
        )
    return values.clamp(0.0, 1.0).float().contiguous()


def _numbers(path: PathLike, color: Tensor, largest: int | None) -> Tensor:
    """Return labels (H, W): a palette's numbers, or grey as it is stored. Raises ValueError or ImportError."""
    indexed = _indexed(path)
    if indexed is not None:
        return indexed[0]
    if color.shape[-1] not in (1, 3) or not _is_grey(color):
        raise ValueError(f"{path}: expected labels in grey or in a palette for label=, got colours; save their numbers")
    return color.mean(-1) if largest is None else _whole(color.mean(-1), largest)


def _whole(grey: Tensor, largest: int) -> Tensor:
    return (grey.double() * largest).round().long()


def _two_colors(path: PathLike, color: Tensor) -> Tensor:
    """Return 1 where the image is not its background. Raises ValueError or ImportError."""
    indexed = _indexed(path)
    if indexed is None:
        red, green, blue = (color.clamp(0.0, 1.0) * 255.0).round().long().unbind(-1)
        numbers, black = red << 16 | green << 8 | blue, [0]
    else:
        numbers, black = indexed
    used = _used(numbers)
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


def _several(path: PathLike, labels: list[int], why: str = "", otherwise: str = "") -> ValueError:
    return ValueError(
        f"{path}: expected a mask of one object, got {_listed(labels)}{why}; choose one with label={otherwise}"
    )


def _listed(labels: list[int]) -> str:
    return "the labels " + ", ".join(map(str, sorted(labels)[:LISTED])) + ", …" * (len(labels) > LISTED)


def _used(numbers: Tensor) -> list[int]:
    if numbers.is_floating_point() or int(numbers.min()) < 0 or int(numbers.max()) > 65535:
        return numbers.unique().tolist()
    return torch.bincount(numbers.flatten()).nonzero().flatten().tolist()  # far faster


def _indexed(path: PathLike) -> tuple[Tensor, list[int]] | None:
    """Return the numbers (H, W) int64 of an image with a palette or of one bit, and which of them are black; else None.
    OpenImageIO replaces these numbers by colours. Raises ImportError without Pillow."""
    if Path(path).suffix.lower() not in DISPLAY:
        return None
    pillow = require("PIL.Image", "edgegrad[files]", "reading labels")
    turned = require("PIL.ImageOps", "edgegrad[files]", "reading labels").exif_transpose
    try:
        with pillow.open(path) as stored:
            if stored.mode not in ("P", "1"):
                return None
            image = stored.copy() if isinstance(path, StoredPath) else turned(stored)
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
