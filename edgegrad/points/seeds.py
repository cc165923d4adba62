"""Numbers that look random, from integers."""

from __future__ import annotations

import torch
from torch import Tensor

_MASK = 2**64 - 1


def mixed_bits(value: int) -> int:
    """64 bits, each of which depends on all bits of `value` (splitmix64; Steele, Lea and Flood 2014)."""
    value = (value + 0x9E3779B97F4A7C15) & _MASK
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) & _MASK
    return value ^ (value >> 31)


def signed(bits: int) -> int:
    """64 bits as an int64."""
    return bits - (1 << 64) if bits >> 63 else bits


def _golden(dimensions: int) -> float:
    """Return the root above 1 of x ** (dimensions + 1) = x + 1 (Roberts 2018)."""
    x = 1.5
    for _ in range(64):
        x = (1 + x) ** (1 / (dimensions + 1))
    return x


# Its powers as shares of 2^64, odd.
STEPS = tuple(signed(int(_golden(3) ** -k * 2**64) | 1) for k in (1, 2, 3))


def sample_seeds(seed: int, stream: int, first: int, count: int) -> Tensor:
    """Return the seeds (count,) int64 of a stream's samples from `first` on. The upper half is the stream's, the lower counts."""
    start = mixed_bits(mixed_bits(seed) ^ mixed_bits(-1 - stream)) & ~0xFFFFFFFF
    return torch.arange(first, first + count) + signed(start)


def uniform(seed: Tensor, n: int, stream: int = 0) -> Tensor:
    """Return numbers (N, n) float64 in [0, 1) of seeds (N,). Successive seeds fill the unit cube evenly: a Kronecker sequence
    with the powers of the generalised golden ratio of three dimensions. Each `stream` gives other numbers."""
    if n == 0:
        return torch.zeros((len(seed), 0), dtype=torch.float64, device=seed.device)
    columns = []
    for k in range(n):
        mixed = seed * STEPS[k % 3] + signed(mixed_bits(stream * 0x10001 + k))
        columns.append(((mixed >> 11) & ((1 << 53) - 1)).double() * 2.0**-53)
    return torch.stack(columns, 1)
