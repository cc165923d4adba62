"""Poses from matrices, and the angle between two rotations."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ...check import check_finite, check_shape
from ..placement import Pose


def pose_from_matrix(name: str, matrix: object) -> Pose:
    """Return the pose of a 4 × 4 similarity for column vectors. Raises TypeError or ValueError."""
    if not isinstance(matrix, Tensor):
        try:
            matrix = torch.tensor(matrix, dtype=torch.float64)  # Lists would become float32.
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name}: expected 4 × 4 numbers, got something else ({error})") from error
    M = matrix.detach().cpu().double()
    check_shape(name, M, (4, 4))
    check_finite(name, M)
    if M[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise ValueError(f"{name}: expected the last row 0, 0, 0, 1, got {M[3].tolist()}; is it transposed?")
    det = float(torch.linalg.det(M[:3, :3]))
    if det <= 0:
        raise ValueError(f"{name}: expected a rotation times a scale above 0, got determinant {det:.3g}; flip one axis")
    scale = det ** (1 / 3)
    R = M[:3, :3] / scale
    # 1e-3 is far above what rounding to six digits leaves, and far below any intended shear.
    if (error := float((R @ R.T - torch.eye(3)).abs().max())) > 1e-3:
        raise ValueError(
            f"{name}: expected a rotation times a scale, got |R Rᵀ − 1| up to {error:.2g}; remove the shear"
        )
    U, _, Vh = torch.linalg.svd(R)
    one = torch.ones((), dtype=torch.float64)
    return Pose(U @ Vh, M[:3, 3].clone(), scale * one, one)


def angle(A: Tensor, B: Tensor) -> float:
    """Return the radians of the rotation from A (3, 3) to B. The cosine alone has no digits near 0, so the sine is
    used, too."""
    R = A.T @ B
    sine = 0.5 * torch.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]).norm()
    return math.atan2(float(sine), float(0.5 * (R.trace() - 1.0)))
