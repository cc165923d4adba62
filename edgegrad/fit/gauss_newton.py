"""Gauss-Newton steps from noisy renders.

A loss Σr² with the residual r(p) = render − picture falls along the step δp that solves, with J = ∂r/∂p,

    (JᵀJ + damping) δp = −Jᵀr        (Levenberg 1944, Marquardt 1963)

Reverse mode gives Jᵀv for one image v at a time. Jᵀr is one backward pass, and JᵀJ the mean of (Jᵀv)(Jᵀv)ᵀ over random
images v of independent signs, since E[vvᵀ] = 1 (Hutchinson 1990). Few will do when p has few entries.
Where every render has a seed of its own, Jᵀr is unbiased, and steps that shrink as 1/k average its noise away.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

FIRST_PROBES, PROBES = 24, 4  # images v at the first point, and at every later one
MEMORY = 0.9  # weight of all earlier probes when new ones come
FIRST_DAMPING, LEAST_DAMPING = 0.1, 0.005  # relative to the diagonal of JᵀJ
LONGEST = 0.07  # of any entry of a step: JᵀJ says little about poses further away
FULL_STEPS, DECAY = 10, 0.5  # so many steps at full length, then 1 / (1 + DECAY k)
NOISE = 1.03  # a loss that rises by a smaller factor may have risen by the noise of its samples


class GaussNewton:
    """Steps for a parameter p that is zero at the point where one stands: its entries should be of order one."""

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator
        self.loss = math.inf  # mean r² at the last accepted point
        self.seen = self.accepted = 0  # points
        self.damping = FIRST_DAMPING
        self._gradient = self._curvature = torch.empty(0)

    def observe(self, p: Tensor, residual: Tensor) -> bool:
        """Takes in r, a function of p (n,), at a new point. False when the loss rose: then go back to the last accepted."""
        self.seen += 1
        loss = float(residual.detach().square().mean())
        # not <=, so that a loss that is NaN is turned down
        if not loss <= NOISE * self.loss:
            self.damping *= 5.0
            return False
        probes = PROBES if self.accepted else FIRST_PROBES
        rows = []
        for _ in range(probes):
            signs = torch.randint(0, 2, residual.shape, generator=self.generator).to(residual) * 2.0 - 1.0
            rows.append(_pulled_back(residual, p, signs))
        fresh = torch.stack(rows).T @ torch.stack(rows) / probes
        self._curvature = MEMORY * self._curvature + (1.0 - MEMORY) * fresh if self.accepted else fresh
        self._gradient = _pulled_back(residual, p, residual.detach())
        if self.accepted:
            self.damping = max(self.damping / 3.0, LEAST_DAMPING)
        self.loss = loss
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


def _pulled_back(residual: Tensor, p: Tensor, image: Tensor) -> Tensor:
    """Jᵀ image (n,)."""
    # Of a sum, because torch imports SymPy, for more than a second, when it is handed an image as grad_outputs.
    return torch.autograd.grad((residual * image).sum(), p, retain_graph=True)[0]
