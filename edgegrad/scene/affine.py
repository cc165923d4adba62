"""Rotations, scalings and shifts that move meshes and lights together."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..check import as_real, as_tensor, check_finite, check_float, values_visible

ROUNDING = 1e-3  # by which the rows of a rotation may miss being orthonormal


class Affine(NamedTuple):
    """The map x ↦ scale · R x + t."""

    R: Tensor | None  # (3, 3)
    t: Tensor | None  # (3,)
    scale: Tensor  # ()

    @classmethod
    def from_arguments(cls, R: Tensor | None, t: Tensor | None, scale: Tensor | float, like: Tensor) -> Affine:
        """Return the map of checked arguments. Raises TypeError or ValueError."""
        scale = as_tensor("scale", scale, like=like)
        check_float("scale", scale)
        if scale.numel() != 1:
            raise ValueError(f"scale: expected one number, got shape {tuple(scale.shape)}; scale the verts yourself")
        check_finite("scale", scale)
        R = None if R is None else as_real("R", R, (3, 3), like=like)
        t = None if t is None else as_real("t", t, (3,), like=like)
        return cls(R, t, scale.reshape(()))

    def vectors(self, v: Tensor) -> Tensor:
        """Return R v of vectors (..., 3)."""
        # Column by column rather than by a matrix product: each row is then rounded equally, so that copies of
        # one vertex stay equal and its edges stay welded.
        R = self.R
        return v if R is None else v[..., 0:1] * R[:, 0] + v[..., 1:2] * R[:, 1] + v[..., 2:3] * R[:, 2]

    def points(self, v: Tensor) -> Tensor:
        v = self.vectors(v) * self.scale
        return v if self.t is None else v + self.t

    @property
    def area(self) -> Tensor:
        """Return () by how much areas grow; where R is no similarity, those of spheres on the mean of their axes."""
        squared = self.scale**2
        return squared if self.R is None else squared * torch.linalg.det(self.R).abs() ** (2 / 3)

    def normals(self, n: Tensor) -> Tensor:
        """Return vectors that stay at right angles to surfaces: by the cofactors of R, so that R may be any matrix."""
        if self.R is None:
            return n
        a, b, c = self.R.unbind(0)
        cofactors = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)])
        return self._replace(R=cofactors).vectors(n)

    def rotated(self, name: str, rotation: Tensor | None) -> Tensor | None:
        """Return R · rotation, for what lies infinitely far away. Raises ValueError where R is no rotation."""
        if self.R is None:
            return rotation
        check_rotation("R", self.R, f"{name} can only be turned")
        return self.R if rotation is None else self.R.to(rotation) @ rotation


def check_rotation(name: str, R: Tensor, why: str) -> None:
    if not values_visible(R):
        return
    with torch.no_grad():
        off = float((R @ R.mT - torch.eye(3).to(R)).abs().max())
        if not off <= ROUNDING or float(torch.linalg.det(R)) < 0:
            raise ValueError(
                f"{name}: expected a rotation, for {why}; got a matrix whose R Rᵀ misses 1 by {off:.2g} and whose determinant is "
                f"{float(torch.linalg.det(R)):.3g}; make its rows orthonormal"
            )
