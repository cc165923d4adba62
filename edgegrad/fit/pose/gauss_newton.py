"""Gauss-Newton steps from noisy renders.

The loss Σr² of the residual r(p) = render − picture falls along the step δp that solves, with J = ∂r/∂p,

    (JᵀJ + damping) δp = −Jᵀr        (Levenberg 1944, Marquardt 1963)

Forward mode gives J, one direction for each entry of p. A render without forward mode gives Jᵀv for one image v at a time:
Jᵀr is one backward pass, and JᵀJ the mean of (Jᵀv)(Jᵀv)ᵀ over random images v of independent signs, since E[vvᵀ] = 1
(Hutchinson 1990). Few such images suffice when p has few entries, and earlier ones are averaged in. Where every render has
its own seed, and r and J their own samples, Jᵀr is unbiased, and steps that shrink as 1/k average its noise out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

FIRST_PROBES, PROBES = 24, 4  # images v at the first point, and at every later one
PROBES_MEMORY = 0.9  # weight of earlier JᵀJ when a new one comes from probes
INITIAL_DAMPING, LOWEST_DAMPING = 0.1, 0.005  # relative to the diagonal of JᵀJ
# Directions that the image does not show have noise alone: so much of the largest entry keeps them at rest.
MIN_DAMPING = 1e-4
MAX_STEP_ENTRY = 0.07  # The largest entry of a step: JᵀJ says little about poses further away.
# Once the loss hardly falls, steps keep their length so often and then shrink by 1 / (1 + DECAY k).
UNDAMPED_STEPS, DECAY = 4, 0.5
NOISE_FACTOR = 1.03  # A loss that rises by a smaller factor may have risen by sample noise alone.
_STATE = ("loss", "seen", "accepted", "_settled", "damping", "_gradient", "_curvature")


class NormalEquations(NamedTuple):
    """The normal equations of a step."""

    curvature: Tensor  # JᵀJ (n, n)
    gradient: Tensor  # Jᵀr (n,)

    def damped(self, damping: float, min_damping: float, longest: float) -> Tensor | None:
        """Return the step (n,), no entry longer than `longest`, or None where nothing depends on the parameters. `damping` is
        relative to the diagonal of JᵀJ, `min_damping` to its largest entry."""
        diagonal = self.curvature.diagonal()
        if not float(diagonal.sum()) > 0.0:
            return None
        step = -torch.linalg.solve(
            self.curvature + torch.diag(damping * diagonal + min_damping * diagonal.max()), self.gradient
        )
        return step * min(1.0, longest / float(step.abs().max().clamp(min=1e-30)))

    @staticmethod
    def from_tangents(residuals: Sequence[Tensor], tangents: Sequence[Tensor]) -> NormalEquations:
        """Sum the equations of images r and their derivatives (n, …) in float64."""
        rows = [J.flatten(1).double() for J in tangents]
        curvature = sum((J @ J.T for J in rows[1:]), rows[0] @ rows[0].T)
        pulled = [J @ r.detach().flatten().double() for J, r in zip(rows, residuals, strict=True)]
        return NormalEquations(curvature, sum(pulled[1:], pulled[0]))

    @staticmethod
    def from_probes(p: Tensor, residuals: Sequence[Tensor], probes: int, generator: torch.Generator) -> NormalEquations:
        """Estimate the equations of images r in whose graph p (n,) is, each probed by itself."""
        curvature, gradient = torch.zeros(len(p), len(p)).to(p), torch.zeros_like(p)
        for r in residuals:
            rows = []
            for _ in range(probes):
                signs = torch.randint(0, 2, r.shape, generator=generator).to(r) * 2.0 - 1.0
                rows.append(_pulled_back(r, p, signs))
            curvature = curvature + torch.stack(rows).T @ torch.stack(rows) / probes
            gradient = gradient + _pulled_back(r, p, r.detach())
        return NormalEquations(curvature, gradient)


class GaussNewton:
    """Steps for a parameter p that is zero at the current point; its entries should be of order one."""

    def __init__(self, memory: float = 0.0) -> None:
        """`memory`: the weight of earlier JᵀJ when a new one comes."""
        self.memory = memory
        self.loss = math.inf
        self.seen = self.accepted = 0  # points
        self._settled = 0  # of them, those whose loss was hardly lower
        self.damping = INITIAL_DAMPING
        self._gradient = self._curvature = torch.empty(0)

    def observe(self, loss: float, equations: Callable[[], NormalEquations], slack: float | None = None) -> bool:
        """Take in a new point; return False where the loss rose, so that the search goes back to the last accepted point.

        equations  returns the normal equations there; not called for a rejected point
        slack      rise of the loss that the noise of its samples may explain
        """
        self.seen += 1
        slack = (NOISE_FACTOR - 1.0) * self.loss if slack is None and self.accepted else slack or 0.0
        # This form also rejects a loss that is NaN.
        if not loss <= self.loss + slack:
            self.damping *= 5.0
            return False
        fresh, self._gradient = equations()
        self._curvature = self.memory * self._curvature + (1.0 - self.memory) * fresh if self.accepted else fresh
        if self.accepted:
            self.damping = max(self.damping / 3.0, LOWEST_DAMPING)
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
        return self._settled > 2 * UNDAMPED_STEPS

    def step(self) -> Tensor:
        """Return δp (n,) from the last accepted point."""
        normal = NormalEquations(self._curvature, self._gradient)
        step = normal.damped(self.damping, MIN_DAMPING, MAX_STEP_ENTRY)
        assert step is not None, "step() is not called where the search is flat"
        return step / (1.0 + DECAY * max(0, self._settled - UNDAMPED_STEPS))

    def state(self) -> dict[str, Any]:
        """Return what the steps depend on."""
        return {name: getattr(self, name) for name in _STATE}

    def load(self, state: Mapping[str, Any]) -> None:
        for name in _STATE:
            setattr(self, name, state[name])


def _pulled_back(residual: Tensor, p: Tensor, image: Tensor) -> Tensor:
    """Return Jᵀ image (n,)."""
    # Given an image as grad_outputs, torch would import SymPy, which takes more than a second.
    return torch.autograd.grad((residual * image).sum(), p, retain_graph=True)[0]
