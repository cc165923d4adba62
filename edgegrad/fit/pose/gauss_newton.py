"""Gauss-Newton steps from noisy renders.

A loss Σr² with the residual r(p) = render − picture falls along the step δp that solves, with J = ∂r/∂p,

    (JᵀJ + damping) δp = −Jᵀr        (Levenberg 1944, Marquardt 1963)

Reverse mode gives Jᵀv for one image v at a time. Jᵀr is one backward pass, and JᵀJ the mean of (Jᵀv)(Jᵀv)ᵀ over random
images v of independent signs, since E[vvᵀ] = 1 (Hutchinson 1990). Few will do when p has few entries.
Where every render has a seed of its own, Jᵀr is unbiased, and steps that shrink as 1/k average its noise away.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

FIRST_PROBES, PROBES = 24, 4  # images v at the first point, and at every later one
MEMORY = 0.9  # weight of all earlier probes when new ones come
FIRST_DAMPING, LEAST_DAMPING = 0.1, 0.005  # relative to the diagonal of JᵀJ
LONGEST = 0.07  # of any entry of a step: JᵀJ says little about poses further away
FULL_STEPS, DECAY = 4, 0.5  # so many steps at full length once the loss hardly falls, then 1 / (1 + DECAY k)
NOISE = 1.03  # a loss that rises by a smaller factor may have risen by the noise of its samples
_STATE = ("loss", "seen", "accepted", "_settled", "damping", "_gradient", "_curvature")


class GaussNewton:
    """Steps for a parameter p that is zero at the point where one stands: its entries should be of order one."""

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator
        self.loss = math.inf  # at the last accepted point
        self.seen = self.accepted = 0  # points
        self._settled = 0  # of them, those whose loss was hardly lower
        self.damping = FIRST_DAMPING
        self._gradient = self._curvature = torch.empty(0)

    def observe(
        self, p: Tensor, residual: Tensor | Sequence[Tensor], loss: float | None = None, slack: float | None = None
    ) -> bool:
        """Takes in r, a function of p (n,), at a new point. False when the loss rose: then go back to the last accepted.

        residual  one image, or several, each probed by itself
        loss      what is compared; the mean r² when None
        slack     by how much it may have risen by the noise of its samples
        """
        self.seen += 1
        images = [residual] if isinstance(residual, Tensor) else list(residual)
        if loss is None:
            loss = float(sum(r.detach().square().sum() for r in images)) / sum(r.numel() for r in images)
        slack = (NOISE - 1.0) * self.loss if slack is None and self.accepted else slack or 0.0
        # not <=, so that a loss that is NaN is turned down
        if not loss <= self.loss + slack:
            self.damping *= 5.0
            return False
        probes = PROBES if self.accepted else FIRST_PROBES
        fresh, gradient = torch.zeros(len(p), len(p)).to(p), torch.zeros_like(p)
        for r in images:
            rows = []
            for _ in range(probes):
                signs = torch.randint(0, 2, r.shape, generator=self.generator).to(r) * 2.0 - 1.0
                rows.append(_pulled_back(r, p, signs))
            fresh = fresh + torch.stack(rows).T @ torch.stack(rows) / probes
            gradient = gradient + _pulled_back(r, p, r.detach())
        self._curvature = MEMORY * self._curvature + (1.0 - MEMORY) * fresh if self.accepted else fresh
        self._gradient = gradient
        if self.accepted:
            self.damping = max(self.damping / 3.0, LEAST_DAMPING)
            self._settled += not loss < self.loss - slack
        self.loss = loss
        self.accepted += 1
        return True

    @property
    def gradient(self) -> Tensor:
        """Jᵀr (n,) at the last accepted point."""
        return self._gradient

    @property
    def blind(self) -> bool:
        """Whether nothing in the image depends on p."""
        return not bool(self._curvature.diagonal().sum() > 0)

    @property
    def settled(self) -> bool:
        """Whether the loss has hardly fallen for a while."""
        return self._settled > 2 * FULL_STEPS

    def step(self) -> Tensor:
        """δp (n,) from the last accepted point."""
        diagonal = self._curvature.diagonal()
        # Directions that the image does not show have only noise there: 1e-4 of the largest keeps them at rest.
        damped = self._curvature + torch.diag(self.damping * diagonal + 1e-4 * diagonal.max())
        step = -torch.linalg.solve(damped, self._gradient)
        shrink = min(1.0, LONGEST / float(step.abs().max().clamp(min=1e-30)))
        return step * shrink / (1.0 + DECAY * max(0, self._settled - FULL_STEPS))

    def state(self) -> dict[str, Any]:
        """What it keeps between steps, beside the generator."""
        return {name: getattr(self, name) for name in _STATE}

    def load(self, state: Mapping[str, Any]) -> None:
        for name in _STATE:
            setattr(self, name, state[name])


def _pulled_back(residual: Tensor, p: Tensor, image: Tensor) -> Tensor:
    """Jᵀ image (n,)."""
    # Of a sum, because torch imports SymPy, for more than a second, when it is handed an image as grad_outputs.
    return torch.autograd.grad((residual * image).sum(), p, retain_graph=True)[0]
