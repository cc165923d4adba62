"""Sobol's points in the plane, scrambled, for the points of lights: csrc/core/sobol.h, which names the sources."""

from __future__ import annotations

import torch
from torch import Tensor

from .seeds import mixed_bits, signed

_32 = 0xFFFFFFFF
_GOLDEN = signed(0x9E3779B97F4A7C15)


def sobol(seed: Tensor, key: int, part: int = 0, parts: int = 1) -> Tensor:
    """Return points (N, 2) float64 in (0, 1) of seeds (N,), without derivatives: of each seed the `part` of so many. The upper
    half of a seed says which sequence, the lower which of its points; each takes `parts` in a row. These fill the unit square
    evenly, and so do those of successive seeds and of blocks of pixels. Each `key` gives other numbers."""
    random = _mixed(_mixed(_mixed((seed >> 32 & _32) + _GOLDEN) + signed(key + _GOLDEN & 2**64 - 1)) + _GOLDEN)
    i = (seed * parts + part) & _32
    i = _reversed(_scrambled(_reversed(i), _mixed(random + 1)))
    return torch.stack([_unit(_scrambled(i, random)), _unit(_scrambled(_pascal(i), _mixed(random)))], 1)


def key_of(light: int, kind: int) -> int:
    """Return the key of the numbers of a light: for what the light draws (0), what BSDF lobes draw (1), and the choice (2)."""
    return signed(mixed_bits(light * 0x10001 + kind))


def z_order(x: Tensor, y: Tensor) -> Tensor:
    """Return the places (N,) of pixels on the Z-order curve (Morton 1966)."""
    return _spread(x) | _spread(y) << 1


def _spread(x: Tensor) -> Tensor:
    for shift, mask in (
        (16, 0x0000FFFF0000FFFF), (8, 0x00FF00FF00FF00FF), (4, 0x0F0F0F0F0F0F0F0F), (2, 0x3333333333333333),
        (1, 0x5555555555555555),
    ):  # fmt: skip
        x = (x | x << shift) & mask
    return x


def _mixed(x: Tensor) -> Tensor:
    """Return the bits of x mixed by the finaliser of splitmix64 (Steele, Lea and Flood 2014)."""
    x = (x ^ _shifted(x, 30)) * signed(0xBF58476D1CE4E5B9)
    x = (x ^ _shifted(x, 27)) * signed(0x94D049BB133111EB)
    return x ^ _shifted(x, 31)


def _shifted(x: Tensor, by: int) -> Tensor:
    """Return x shifted to the right, without the sign."""
    return x >> by & ((1 << (64 - by)) - 1)


def _scrambled(x: Tensor, random: Tensor) -> Tensor:
    x = (x ^ x * 0x3D20ADEA) & _32
    x = (x + (random & _32)) & _32
    x = x * (_shifted(random, 32) | 1) & _32
    x = (x ^ x * 0x05526C56) & _32
    return (x ^ x * 0x53A22864) & _32


def _pascal(i: Tensor) -> Tensor:
    for shift, mask in ((1, 0xAAAAAAAA), (2, 0xCCCCCCCC), (4, 0xF0F0F0F0), (8, 0xFF00FF00), (16, 0xFFFF0000)):
        i = i ^ (i & mask) >> shift
    return i


def _reversed(x: Tensor) -> Tensor:
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        x = (x >> shift & mask) | (x & mask) << shift
    return (x >> 16 | x << 16) & _32


def _unit(x: Tensor) -> Tensor:
    """Return the middle of the cell of the 2³² that the digits say, the first of them in the lowest bit."""
    return (_reversed(x).double() + 0.5) * 2.0**-32
