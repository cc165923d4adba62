"""Gauss-Newton steps from noisy renders.

A loss Σr² with the residual r(p) = render − picture falls along the step δp that solves, with J = ∂r/∂p,

    (JᵀJ + damping) δp = −Jᵀr        (Levenberg 1944, Marquardt 1963)

Forward mode gives J, in as many directions as p has entries. Where a render has reverse mode alone, which gives Jᵀv for one image
v at a time, Jᵀr is one backward pass, and JᵀJ the mean of (Jᵀv)(Jᵀv)ᵀ over random images v of independent signs, since
E[vvᵀ] = 1 (Hutchinson 1990): few will do when p has few entries, and earlier ones are remembered.
Where every render has a seed of its own, and r and J have samples of their own, Jᵀr is unbiased, and steps that shrink as 1/k
average its noise away.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

FIRST_PROBES, PROBES = 24, 4  # images v at the first point, and at every later one
MEMORY, PROBES_MEMORY = (
    0.0,
    0.9,
)  # weight of all earlier JᵀJ when a new one comes: of one by J, and of one by few probes
FIRST_DAMPING, LEAST_DAMPING = 0.1, 0.005  # relative to the diagonal of JᵀJ
LONGEST = 0.07  # of any entry of a step: JᵀJ says little about poses further away
FULL_STEPS, DECAY = 4, 0.5  # so many steps at full length once the loss hardly falls, then 1 / (1 + DECAY k)
NOISE = 1.03  # a loss that rises by a smaller factor may have risen by the noise of its samples
_STATE = ("loss", "seen", "accepted", "_settled", "damping", "_gradient", "_curvature")


class Normal(NamedTuple):
    """The normal equations of a step."""

    curvature: Tensor  # JᵀJ (n, n)
    gradient: Tensor  # Jᵀr (n,)

    def damped(self, damping: float, floor: float, longest: float) -> Tensor | None:
        """The step (n,), no entry longer than `longest`, by a damping relative to the diagonal of JᵀJ, and a `floor` relative to
        its largest entry; None where nothing depends on the parameters."""
        diagonal = self.curvature.diagonal()
        if not float(diagonal.sum()) > 0.0:
            return None
        step = -torch.linalg.solve(
            self.curvature + torch.diag(damping * diagonal + floor * diagonal.max()), self.gradient
        )
        return step * min(1.0, longest / float(step.abs().max().clamp(min=1e-30)))

    @staticmethod
    def of(residuals: Sequence[Tensor], tangents: Sequence[Tensor]) -> Normal:
        """From images r, and the derivatives (n, …) of each. Sums are taken in float64."""
        rows = [J.flatten(1).double() for J in tangents]
        curvature = sum((J @ J.T for J in rows[1:]), rows[0] @ rows[0].T)
        pulled = [J @ r.detach().flatten().double() for J, r in zip(rows, residuals, strict=True)]
        return Normal(curvature, sum(pulled[1:], pulled[0]))

    @staticmethod
    def probed(p: Tensor, residuals: Sequence[Tensor], probes: int, generator: torch.Generator) -> Normal:
        """From images r in whose graph p (n,) is, each probed by itself."""
        curvature, gradient = torch.zeros(len(p), len(p)).to(p), torch.zeros_like(p)
        for r in residuals:
            rows = []
            for _ in range(probes):
                signs = torch.randint(0, 2, r.shape, generator=generator).to(r) * 2.0 - 1.0
                rows.append(_pulled_back(r, p, signs))
            curvature = curvature + torch.stack(rows).T @ torch.stack(rows) / probes
            gradient = gradient + _pulled_back(r, p, r.detach())
        return Normal(curvature, gradient)


class GaussNewton:
    """Steps for a parameter p that is zero at the point where one stands: its entries should be of order one."""

    def __init__(self, memory: float = MEMORY) -> None:
        self.memory = memory
        self.loss = math.inf  # at the last accepted point
        self.seen = self.accepted = 0  # points
        self._settled = 0  # of them, those whose loss was hardly lower
        self.damping = FIRST_DAMPING
        self._gradient = self._curvature = torch.empty(0)

    def observe(self, loss: float, equations: Callable[[], Normal], slack: float | None = None) -> bool:
        """Takes in a new point. False when the loss rose: then go back to the last accepted.

        equations  the normal equations there, of which a point that is turned down is not asked
        slack      by how much the loss may have risen by the noise of its samples
        """
        self.seen += 1
        slack = (NOISE - 1.0) * self.loss if slack is None and self.accepted else slack or 0.0
        # not <=, so that a loss that is NaN is turned down
        if not loss <= self.loss + slack:
            self.damping *= 5.0
            return False
        fresh, self._gradient = equations()
        self._curvature = self.memory * self._curvature + (1.0 - self.memory) * fresh if self.accepted else fresh
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
    def flat(self) -> bool:
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
        """What it keeps between steps."""
        return {name: getattr(self, name) for name in _STATE}

    def load(self, state: Mapping[str, Any]) -> None:
        for name in _STATE:
            setattr(self, name, state[name])


def _pulled_back(residual: Tensor, p: Tensor, image: Tensor) -> Tensor:
    """Jᵀ image (n,)."""
    # Of a sum, because torch imports SymPy, for more than a second, when it is handed an image as grad_outputs.
    return torch.autograd.grad((residual * image).sum(), p, retain_graph=True)[0]
