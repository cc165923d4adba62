"""Rotations as vectors, quaternions or matrices, by roma."""

from __future__ import annotations

from types import ModuleType

import torch
from torch import Tensor

from ..check import check_finite, check_shape, values_visible
from ..optional import require

STRAY = 1e-3  # of a matrix from a rotation, of a quaternion from length 1


def roma() -> ModuleType:
    return require("roma", "edgegrad[rigs]", "rotations of joints")


def one_as_matrix(name: str, value: Tensor) -> Tensor:
    """Return (…, 3, 3) of one rotation vector (3,), quaternion (4,) or matrix (3, 3), with or without a batch in front; (3, 3)
    is a matrix. Raises ValueError."""
    check_shape(name, value, *(s for one in ((3,), (4,), (3, 3)) for s in (one, ("B", *one))))
    check_finite(name, value)
    matrices = value.dim() > 1 and value.shape[-2:] == (3, 3)
    return as_matrices(name, value.unsqueeze(-3 if matrices else -2), 1).squeeze(-3)


def as_matrices(name: str, value: Tensor, count: int) -> Tensor:
    """Return (…, J, 3, 3) of rotation vectors (…, J, 3) in radians, quaternions (…, J, 4) as x, y, z, w, or matrices, with or
    without a batch in front. Three dimensions that end in 3 × 3 are J matrices where the first is J. Raises ValueError."""
    vectors, quaternions, matrices = (count, 3), (count, 4), (count, 3, 3)
    check_shape(name, value, *(s for one in (vectors, quaternions, matrices) for s in (one, ("B", *one))))
    if value.shape[-2:] == (3, 3) and (value.dim() == 4 or (value.dim() == 3 and len(value) == count)):
        if values_visible(value):
            stray = float((value.detach() @ value.detach().mT - torch.eye(3).to(value)).abs().max())
            if stray > STRAY or bool((torch.linalg.det(value.detach()) < 0.0).any()):
                raise ValueError(
                    f"{name}: expected rotations, got matrices with |R Rᵀ − 1| up to {stray:.3g}, or a reflection; give rotation "
                    "vectors, or roma.special_procrustes(M)"
                )
        return value
    if value.shape[-1] == 4:
        length = value.norm(dim=-1, keepdim=True)
        if values_visible(length) and bool(((length.detach() - 1.0).abs() > STRAY).any()):
            raise ValueError(
                f"{name}: expected unit quaternions x, y, z, w, got lengths from {float(length.min()):.3g} to "
                f"{float(length.max()):.3g}; divide by them"
            )
        return roma().unitquat_to_rotmat(value / length)
    return roma().rotvec_to_rotmat(value)
