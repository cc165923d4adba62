"""A term of the objective: the negative log likelihood of a picture at N poses, and its quadratic model in a step."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Term(NamedTuple):
    """−log likelihood ratios to a picture without the object, nats of independent pixels, with D entries of a step."""

    cost: Tensor  # (N,)
    gradient: Tensor  # (N, D)
    curvature: Tensor  # (N, D, D), Fisher's information

    @staticmethod
    def zero(count: int, dofs: int) -> Term:
        f64 = torch.float64
        return Term(
            torch.zeros(count, dtype=f64), torch.zeros(count, dofs, dtype=f64), torch.zeros(count, dofs, dofs, dtype=f64)
        )  # fmt: skip

    def plus(self, other: Term) -> Term:
        return Term(*(a + b for a, b in zip(self, other, strict=True)))

    @staticmethod
    def from_rows(cost: Tensor, rows: Tensor, weight: Tensor, residual: Tensor) -> Term:
        """Return the term of weighted least squares: derivatives `rows` (N, D, M) of residuals (N, M), each of which counts
        `weight` (N, M)."""
        weighted = rows * weight[:, None]
        gradient = (weighted @ residual[..., None])[..., 0]
        return Term(cost.double(), gradient.double(), (weighted @ rows.mT).double())
