"""Target images of a pose search: what stands behind the object, and smaller and blurred copies."""

from __future__ import annotations

import torch
from torch import Tensor

from ...check import as_tensor, check_finite, check_float, check_shape

# A border is clutter when more than 0.3 of it is further from its median than 0.1 of the range.
UNIFORM_BORDER = (0.1, 0.3)


def is_clutter(picture: Tensor) -> bool:
    """Return whether the border of a picture (H, W, C) has many colours, so that none of them is the background."""
    border = _border(picture)
    extent = (picture.amax((0, 1)) - picture.amin((0, 1))).clamp(min=1e-30)
    off = ((border - border.median(dim=0).values).abs() / extent).amax(1)
    return float((off > UNIFORM_BORDER[0]).float().mean()) > UNIFORM_BORDER[1]


def _border(picture: Tensor) -> Tensor:
    return torch.cat([picture[0], picture[-1], picture[1:-1, 0], picture[1:-1, -1]])


def background_of(value: Tensor | float | None, picture: Tensor) -> Tensor:
    """Return the background (C,) or (H, W, C). Raises TypeError or ValueError."""
    H, W, C = picture.shape
    if value is None:
        return _border(picture).median(dim=0).values
    behind = as_tensor("background", value, like=picture).detach().cpu()
    if behind.dim() == 0:
        behind = behind.expand(C)
    check_float("background", behind)
    check_shape("background", behind, (C,), (H, W, C), fix="it needs the picture's size and channels")
    check_finite("background", behind)
    return behind.float()


def scaled(size: tuple[int, int], factor: float) -> tuple[int, int]:
    """Return the size of a picture whose sides are multiplied by a factor, at least one pixel."""
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))
