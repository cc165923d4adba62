"""Gauss-Newton steps from noisy renders.

A loss Σr² with the residual r(p) = render − picture falls along the step δp that solves, with J = ∂r/∂p,

    (JᵀJ + damping) δp = −Jᵀr        (Levenberg 1944, Marquardt 1963)

Forward mode gives all columns of J in one pass, for p has few entries, together with r, whose samples are others. Where every
render has a seed of its own, Jᵀr is unbiased, and steps that shrink as 1/k average its noise away. JᵀJ is not: noise adds to its
diagonal, which damps the step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

MEMORY = 0.9  # weight of JᵀJ at all earlier points
FIRST_DAMPING, LEAST_DAMPING = 0.1, 0.005  # relative to the diagonal of JᵀJ
LONGEST = 0.07  # of any entry of a step: JᵀJ says little about poses further away
FULL_STEPS, DECAY = 10, 0.5  # so many steps at full length, then 1 / (1 + DECAY k)
NOISE = 1.03  # a loss that rises by a smaller factor may have risen by the noise of its samples


class GaussNewton:
    """Steps for a parameter p that is zero at the point where one stands: its entries should be of order one."""

    def __init__(self) -> None:
        self.loss = math.inf  # mean r² at the last accepted point
        self.tried = math.inf  # … at the last one
        self.seen = self.accepted = 0  # points
        self.damping = FIRST_DAMPING
        self._gradient = self._curvature = torch.empty(0)

    def observe(self, residual: Callable[[Tensor], Tensor], n: int) -> bool:
        """Takes in r, a function of p (n,), at a new point, p = 0. False if the loss rose: go back to the last accepted."""
        self.seen += 1
        r, J = _with_jacobian(residual, n)
        self.tried = float(r.square().mean())
        # not <=, so that a loss that is NaN is turned down
        if not self.tried <= NOISE * self.loss:
            self.damping *= 5.0
            return False
        rows = J.reshape(n, -1).double()
        fresh = rows @ rows.T
        self._curvature = MEMORY * self._curvature + (1.0 - MEMORY) * fresh if self.accepted else fresh
        self._gradient = rows @ r.reshape(-1).double()
        if self.accepted:
            self.damping = max(self.damping / 3.0, LEAST_DAMPING)
        self.loss = self.tried
        self.accepted += 1
        return True

    @property
    def blind(self) -> bool:
        """Whether nothing in the image depends on p."""
        return not bool(self._curvature.diagonal().sum() > 0)

    def step(self) -> Tensor:
        """δp (n,) from the last accepted point."""
        diagonal = self._curvature.diagonal()
        # Directions that the image does not show have only noise there: 1e-4 of the largest keeps them at rest.
        damped = self._curvature + torch.diag(self.damping * diagonal + 1e-4 * diagonal.max())
        step = -torch.linalg.solve(damped, self._gradient)
        shrink = min(1.0, LONGEST / float(step.abs().max().clamp(min=1e-30)))
        return step * shrink / (1.0 + DECAY * max(0, self.accepted - FULL_STEPS))


@torch.no_grad()
def _with_jacobian(residual: Callable[[Tensor], Tensor], n: int) -> tuple[Tensor, Tensor]:
    """r, and its derivatives (n, …) by p at p = 0."""
    zero = torch.zeros(n, dtype=torch.float64)

    def along(direction: Tensor) -> tuple[Tensor, ...]:
        return torch.func.jvp(residual, (zero,), (direction,))

    out_dims: Any = (None, 0)  # r does not depend on the direction
    r, J = torch.func.vmap(along, out_dims=out_dims)(torch.eye(n, dtype=torch.float64))
    return r, J
