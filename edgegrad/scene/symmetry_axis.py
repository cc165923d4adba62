"""Axes of continuous symmetries, and rotations about them."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from ..check import as_double


@dataclass(frozen=True, eq=False)
class SymmetryAxis:
    """The axis of a continuous symmetry: the mesh may be turned about it by any angle.

    Both tensors become float64. Raises TypeError or ValueError.

    Parameters
    ----------
    direction : (3,)
        Of any length; kept with the length 1.
    offset : (3,), default zeros
        A point of the axis, in units of the mesh.
    """

    direction: Tensor
    offset: Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))

    def __post_init__(self) -> None:
        for name in ("direction", "offset"):
            object.__setattr__(self, name, as_double(name, getattr(self, name), (3,)).cpu())
        if not float(self.direction.norm()) > 0.0:
            raise ValueError("direction: expected a length above zero, got zeros; give the direction of the axis")
        object.__setattr__(self, "direction", self.direction / self.direction.norm())

    def rotations(self, angles: Tensor) -> Tensor:
        """Return rotations (N, 4, 4) about the axis by angles (N,) in radians, right-handed."""
        R = about(self.direction, angles)
        return rigid(R, self.offset - R @ self.offset)


def about(axis: Tensor, angles: Tensor) -> Tensor:
    """Return rotations (N, 3, 3) float64 about a unit axis (3,) by angles (N,) in radians, by Rodrigues' formula."""
    X = skew(axis)
    s, c = angles.sin()[:, None, None], angles.cos()[:, None, None]
    return torch.eye(3, dtype=torch.float64) + s * X + (1.0 - c) * (X @ X)


def skew(a: Tensor) -> Tensor:
    """Return the matrix (3, 3) with `skew(a) @ v = a × v`."""
    x, y, z = a.tolist()
    return a.new_tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rigid(R: Tensor, t: Tensor) -> Tensor:
    last = R.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(R), 1, 4)
    return torch.cat([torch.cat([R, t[:, :, None]], 2), last], 1)
