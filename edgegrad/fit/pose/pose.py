"""Poses, and the angle between two rotations."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..placement import Pose as Pose
from ..placement import pose_from_matrix as pose_from_matrix


def rotation_vector(R: Tensor) -> Tensor:
    """Return the axis of a rotation (3, 3) times its angle, which is below π. The cosine alone has no digits near 0, so the sine
    is used, too."""
    axis = 0.5 * torch.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = float(axis.norm())
    return axis * (math.atan2(sine, 0.5 * (float(R.trace()) - 1.0)) / sine if sine > 0.0 else 1.0)


def angle(A: Tensor, B: Tensor) -> float:
    """Return the radians of the rotation from A (3, 3) to B."""
    R = A.T @ B
    sine = 0.5 * torch.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]).norm()
    return math.atan2(float(sine), float(0.5 * (R.trace() - 1.0)))
