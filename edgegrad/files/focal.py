"""The focal length that a photograph's EXIF data states."""

from __future__ import annotations

import math
from typing import NamedTuple

from ..optional import require
from .paths import PathLike

FILM = math.hypot(36.0, 24.0)  # mm, the diagonal of 35 mm film, which equivalent focal lengths refer to
LONGEST = 10_000.0  # mm, equivalent for 35 mm film: no lens of a camera is longer, and 65535 stands for an unknown one
UNITS = {2: 25.4, 3: 10.0, 4: 1.0}  # mm, of EXIF's FocalPlaneResolutionUnit


class FocalLength(NamedTuple):
    """The focal length that EXIF data states."""

    pixels: float  # of the image as it is stored
    words: str  # where it comes from


def read_focal(path: PathLike) -> FocalLength | None:
    """Return the focal length of a photograph, or None where its EXIF data does not state it.

    It comes from the equivalent focal length for 35 mm film, or else from the focal length in mm and the sensor's pixels per
    length. An image that was cropped after it was taken has another one. Raises ImportError without OpenImageIO.
    """
    oiio = require("OpenImageIO", "OpenImageIO", "reading images")
    opened = oiio.ImageInput.open(str(path))
    if opened is None:
        return None
    spec = opened.spec()
    opened.close()

    def number(name: str) -> float:
        value = spec.getattribute(name)
        return float(value) if isinstance(value, (int, float)) and value > 0.0 else 0.0

    film = number("Exif:FocalLengthIn35mmFilm")
    if 0.0 < film < LONGEST:
        pixels = film / FILM * math.hypot(spec.width, spec.height)
        return FocalLength(pixels, f"{film:g} mm, equivalent for 35 mm film")
    length, resolution = number("Exif:FocalLength"), number("Exif:FocalPlaneXResolution")
    if not length or not resolution:
        return None
    taken = number("Exif:PixelXDimension") or spec.width
    unit = UNITS.get(int(number("Exif:FocalPlaneResolutionUnit")), UNITS[2])
    pixels = length * resolution / unit * spec.width / taken
    if not pixels * FILM < LONGEST * math.hypot(spec.width, spec.height):
        return None
    return FocalLength(pixels, f"{length:g} mm, and the sensor's resolution")
