"""Real spherical harmonics up to the second degree (Ramamoorthi and Hanrahan 2001), as csrc/shading/lit/spherical_harmonics.h."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

# Factors of Y_00, of Y_1m, of products in Y_2m, of Y_20 and of Y_22.
ORTHONORMAL = tuple(math.sqrt(k / math.pi) for k in (1 / 4, 3 / 4, 15 / 4, 5 / 16, 15 / 16))
UNSCALED = (1.0,) * 5


def harmonics(n: Tensor, factors: Sequence[float] = ORTHONORMAL) -> list[Tensor]:
    """Return Y_00, Y_1−1, Y_10, Y_11, Y_2−2 … Y_22, (…) each, of unit vectors (…, 3)."""
    x, y, z = n.unbind(-1)
    one, c1, c2, c3, c4 = factors
    return [
        one * torch.ones_like(x), c1 * y, c1 * z, c1 * x, c2 * x * y, c2 * y * z, c3 * (3 * z * z - 1), c2 * x * z,
        c4 * (x * x - y * y),
    ]  # fmt: skip
