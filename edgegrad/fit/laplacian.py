"""Coordinates of a mesh in which a step of one vertex moves its neighbours along.

With the graph Laplacian L of the mesh, u = (I + λ L) v stands for the vertices v. A step in u moves v = (I + λ L)⁻¹ u smoothly,
however noisy the gradient is (Nicolet, Jacobson and Jakob, Large Steps in Inverse Rendering of Geometry, 2021).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..optional import require
from .regularizers import edges


class LaplacianSolver:
    """The map from u (V, n) to v = (I + λ L)⁻¹ u, differentiable, by cholespy's factorization. Raises ImportError without
    cholespy."""

    def __init__(self, faces: Tensor, count: int, smoothness: float) -> None:
        cholespy = require("cholespy", "edgegrad[fit]", "a smooth shape")
        pairs = edges(faces)
        both = torch.cat([pairs, pairs.flip(1)])
        degree = torch.bincount(both[:, 0], minlength=count).double()
        rows = torch.cat([both[:, 0], torch.arange(count)])
        columns = torch.cat([both[:, 1], torch.arange(count)])
        values = torch.cat([torch.full((len(both),), -smoothness, dtype=torch.float64), 1.0 + smoothness * degree])
        index = torch.stack([rows, columns])
        self._matrix = torch.sparse_coo_tensor(index, values, (count, count), check_invariants=True)
        self._solver = cholespy.CholeskySolverD(
            count, rows.int().numpy(), columns.int().numpy(), values.numpy(), cholespy.MatrixType.COO
        )

    def to_differential(self, v: Tensor) -> Tensor:
        """Return u = (I + λ L) v."""
        return (self._matrix @ v.double()).to(v.dtype)

    def __call__(self, u: Tensor) -> Tensor:
        """Return v = (I + λ L)⁻¹ u."""
        return _Solve.apply(u, self)  # type: ignore[return-value]

    def solve(self, u: Tensor) -> Tensor:
        found = np.zeros(u.shape)
        self._solver.solve(np.ascontiguousarray(u.detach().double().numpy()), found)
        return torch.from_numpy(found).to(u.dtype)


class _Solve(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, u: Tensor, smooth: LaplacianSolver) -> Tensor:
        ctx.smooth = smooth
        return smooth.solve(u)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        return ctx.smooth.solve(grad_outputs[0]), None  # the matrix is symmetric
