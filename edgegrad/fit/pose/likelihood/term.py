"""A term of the objective: the negative log likelihood of a picture at N poses, and its quadratic model in a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

Summands = Callable[[], Tensor]


class Term(NamedTuple):
    """−log likelihood ratios to a picture without the object, nats of independent pixels, with D entries of a step."""

    cost: Tensor  # (N,)
    gradient: Tensor  # (N, D)
    curvature: Tensor  # (N, D, D), Fisher's information
    summands: Summands | None = None  # of the gradient, (N, D, h, w), by pixels
    gains: Tensor | None = None  # (N, h, w), what pixels near the object take off the cost

    @staticmethod
    def zero(count: int, dofs: int) -> Term:
        f64 = torch.float64
        return Term(
            torch.zeros(count, dtype=f64), torch.zeros(count, dofs, dtype=f64), torch.zeros(count, dofs, dofs, dtype=f64)
        )  # fmt: skip

    def plus(self, other: Term) -> Term:
        """Return the sum with a term of the same pixels, or of another picture."""
        parts = [one.summands for one in (self, other) if one.summands is not None]

        def summands() -> Tensor:
            return sum((part() for part in parts[1:]), parts[0]())

        cost, gradient, curvature = (a + b for a, b in zip(self[:3], other[:3], strict=True))
        return Term(cost, gradient, curvature, summands if parts else None)

    def counted(self, pixels: float) -> Term:
        """Return the term if so many pixels count as one, because their errors have common causes."""
        summands, gains = self.summands, self.gains
        return self._replace(
            cost=self.cost / pixels, gradient=self.gradient / pixels, curvature=self.curvature / pixels,
            summands=None if summands is None else lambda: summands() / pixels, gains=None if gains is None else gains / pixels,
        )  # fmt: skip

    @staticmethod
    def from_rows(gains: Tensor, rows: Tensor, weight: Tensor, residual: Tensor) -> Term:
        """Return the term of weighted least squares: derivatives `rows` (N, D, h · w) of residuals (N, h · w), each of which
        counts `weight` (N, h · w), in images in which pixels take `gains` (N, h, w) off the cost."""
        weighted = rows * weight[:, None]
        gradient = (weighted @ residual[..., None])[..., 0]

        def summands() -> Tensor:
            return (weighted * residual[:, None]).reshape(*rows.shape[:2], *gains.shape[1:])

        return Term(-gains.sum((1, 2)).double(), gradient.double(), (weighted @ rows.mT).double(), summands, gains)

    @property
    def predicted_gain(self) -> Tensor:
        """The decrease (N,) of the cost by an undamped step, by the quadratic model."""
        unseen = 1e-6 * self.curvature.diagonal(dim1=1, dim2=2).amax(1)[:, None, None] + 1e-30
        H = self.curvature + unseen * torch.eye(self.gradient.shape[1], dtype=torch.float64)
        return 0.5 * (self.gradient * torch.linalg.solve(H, self.gradient)).sum(1)

    def score_covariance(self, length: float) -> Tensor:
        """Return the covariance (N, D, D) of the gradient, Σ E[s_p s_qᵀ] over pairs of pixels less than `length` apart, with
        Bartlett's weights, which keep it positive (Newey and West, A Simple, Positive Semi-Definite, Heteroskedasticity and
        Autocorrelation Consistent Covariance Matrix, 1987)."""
        assert self.summands is not None
        side = round(length)
        # Products of sums over windows count a pair of pixels once for each window that holds both: Bartlett's weights.
        padded = F.pad(self.summands(), (side - 1,) * 4)
        sums = (side * F.avg_pool2d(padded, side, stride=1)).flatten(2).double()
        return sums @ sums.mT
