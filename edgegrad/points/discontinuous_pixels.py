"""Pixels that a shader's discontinuities, or shadow boundaries, run through: one point of a face is a poor estimate there.

A pixel counts as such if the eight pixels around it lie on different sides of a discontinuity. Its own points do not count: if
they decided whether they are replaced by others, the mean over seeds would be biased.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..check import values_visible
from .discontinuities import FLOOR
from .hits import Hits

MOST_TIMES_A_FACE = 8  # at most so many times the first pass's points of a face in a pixel
MOST_TIMES_IN_ALL = 4  # and so many times all of its points
LEVELS = 1 << 14  # levels of a floor() are compared modulo this, so that int16 holds them


class DiscontinuousPixels:
    """Finds such pixels of an image of `size` (height, width), from a first pass with `points` of each face in a pixel."""

    def __init__(self, size: tuple[int, int], points: int) -> None:
        self._size, self._each = size, points
        self._points = torch.zeros(size[0] * size[1], dtype=torch.int32)
        self._least: list[Tensor] = []  # (H · W,) for each discontinuity
        self._greatest: list[Tensor] = []
        self._known = True

    def add(self, pixel: Tensor, hits: Hits) -> None:
        """Add points of the pixels (N,), after they were shaded."""
        declared = list(zip(hits._discontinuities.kinds, hits._discontinuities.values, strict=True))
        self._known = self._known and values_visible(*(values for _, values in declared if values is not None))
        # Each point sees another part of a light with an extent, so its neighbours say nothing about the shadow's border.
        lights = [k for k, light in enumerate(hits.lights) if light.punctual]
        if not self._known or not (declared or lights):
            return
        sides = [None if values is None else _sides(kind, values) for kind, values in declared]
        sides += [hits._lit.get(k) for k in lights]
        self._points += torch.bincount(pixel, minlength=len(self._points)).int()
        for k, side in enumerate(sides):
            if k == len(self._least):
                self._least.append(torch.full_like(self._points, LEVELS, dtype=torch.int16))
                self._greatest.append(torch.full_like(self._points, -1, dtype=torch.int16))
            if side is None:
                continue
            side = side.cpu().to(torch.int16)
            self._least[k].scatter_reduce_(0, pixel, torch.where(side < 0, LEVELS, side), "amin")
            self._greatest[k].scatter_reduce_(0, pixel, side, "amax")

    def found(self) -> tuple[Tensor, int]:
        """Return the pixels (H, W) bool, and how many points of each face to shade in them."""
        differ = torch.zeros(self._size, dtype=torch.bool)
        if not self._known:
            return differ, 1
        for least, greatest in zip(self._least, self._greatest, strict=True):
            low, high = -_around(-least.reshape(self._size), -LEVELS), _around(greatest.reshape(self._size), -1)
            differ |= (low < high) & (high >= 0)
        first, there = int(self._points.sum()), int(self._points[differ.reshape(-1)].sum())
        return differ, self._each * min(MOST_TIMES_A_FACE, max(2, MOST_TIMES_IN_ALL * first // max(there, 1)))


def _sides(kind: str, values: Tensor) -> Tensor:
    """Return on which side of a discontinuity points lie (N,) int16; −1 where the shader did not ask."""
    values = values.detach()
    side = values.double().nan_to_num().floor() % LEVELS if kind == FLOOR else values > 0
    return side.to(torch.int16).masked_fill(~torch.isfinite(values), -1)


def _around(values: Tensor, outside: int) -> Tensor:
    """Return the greatest of the eight neighbours of each pixel (H, W), with this value beyond the border."""
    padded = torch.nn.functional.pad(values, (1, 1, 1, 1), value=outside)
    horizontal = torch.maximum(padded[:, :-2], padded[:, 2:])
    three = torch.maximum(horizontal, padded[:, 1:-1])
    return torch.maximum(horizontal[1:-1], torch.maximum(three[:-2], three[2:]))
