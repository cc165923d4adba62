"""Depth from image files: the distance along the camera's axis of what each pixel shows."""

from __future__ import annotations

import math

from torch import Tensor

from .image import read_stored
from .paths import PathLike

LEAST_BITS = 16  # of whole numbers: 256 steps are a picture of depth


def read_depth(path: PathLike, scale: float | None = None) -> Tensor:
    """Return depth (H, W) float32 from an image file of one channel.

    Values are distances along +Z of the camera in world units, 0 or NaN where there is none, as `depth=` of fits takes them.
    Row 0 is on top, upright as the EXIF orientation says.

    Parameters
    ----------
    path : str or Path
    scale : float, default none
        Length of one unit of the file in world units: 0.001 where it has millimetres and the mesh is in metres. Data sets call
        it `depth_scale`; that of BOP is in millimetres. Whole numbers (PNG, TIFF of 16 or 32 bits) need it; floating-point
        numbers (EXR, float TIFF) count as they are without it.

    Raises
    ------
    TypeError, ValueError
        The file has more than one channel, or whole numbers of 8 bits, or whole numbers without a scale; or the scale is not
        above 0. And what read_image() raises.
    """
    if scale is not None:
        if not isinstance(scale, (int, float)) or isinstance(scale, bool):
            raise TypeError(f"scale: expected a number, got {type(scale).__name__} ({scale!r})")
        if not 0.0 < scale < math.inf:
            raise ValueError(f"scale: expected a number above 0, the length of one unit of the file, got {scale:g}")
    color, alpha, largest = read_stored(path, exact=True)
    if color.shape[-1] != 1 or alpha is not None:
        channels = color.shape[-1] + (alpha is not None)
        raise ValueError(
            f"{path}: expected depth in one channel, got {channels}; a picture in false colours has lost the distances, save "
            "them as numbers, by array.astype(numpy.uint16)"
        )
    values = color[..., 0].double()
    if largest is None:
        return ((1.0 if scale is None else scale) * values).float()
    if largest < 2 ** (LEAST_BITS - 1) - 1:
        raise ValueError(
            f"{path}: expected depth of {LEAST_BITS} bits or more, or of floating point, got whole numbers up to {largest}, "
            "which are too few steps; save it by array.astype(numpy.uint16)"
        )
    whole = (values * largest).round()
    if scale is None:
        raise ValueError(
            f"scale: expected the length of one unit of {path}, which has whole numbers up to {int(whole.max())}, got none; "
            "0.001 where they are millimetres and the mesh is in metres, 1 where both are in millimetres"
        )
    return (scale * whole).float()
