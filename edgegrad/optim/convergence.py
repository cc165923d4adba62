"""A test of whether the steps of a noisy descent still lead down, from gradients rather than from losses.

Losses are noisy, and their differences more so. The gradient gₖ at the end of a step Δxₖ has samples of its own, which the step
does not know. So −gₖ·Δxₖ is an unbiased estimate of the slope of the loss there, with far less noise. It is positive on the way
down, and negative where steps overshoot about a minimum.

Over the whole step the loss falls by −gₖ·Δxₖ + ½ Δxₖ·H Δxₖ. Steps of Adam shake by the noise of their gradients. This costs the
second term at the end of each step and can hide a slow descent. Steps change little from one to the next, so ½ (gₖ −
gₖ₋₁)·Δxₖ₋₁ estimates the term: the step before knows the samples of neither gradient.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

BLOCKS = 8  # of steps, before which nothing is predicted; every other one says which numbers lead down
MAX_STEPS = 512  # the last ones that are kept
MAX_PARTS = 4096  # sums that are kept of one tensor


class ConvergenceMonitor:
    """The decrease of the loss in the steps since the last `reset()`, by number or by one of MAX_PARTS parts of a tensor."""

    def __init__(self, values: Mapping[str, Tensor]) -> None:
        self._values = values
        self._before: dict[str, Tensor] | None = None  # values before the last step
        self._last: tuple[dict[str, Tensor], dict[str, Tensor]] | None = None  # step, and gradient at its end
        self._decreases: list[Tensor] = []
        self._losses: list[float] = []
        self.first = math.nan  # the first loss of all

    def begin_step(self) -> None:
        """Store the values from which a step begins."""
        self._before = {name: value.detach().clone() for name, value in self._values.items()}

    def end_step(self, loss: float, gradients: Mapping[str, Tensor | None]) -> None:
        """Add loss and gradients at the end of a step, or the loss alone if no step was begun."""
        self._losses = [*self._losses[-2 * BLOCKS :], loss]
        self.first = loss if math.isnan(self.first) else self.first
        if self._before is None:
            return
        steps = {name: self._values[name].detach() - before for name, before in self._before.items()}
        slopes = {name: torch.zeros_like(step) if (g := gradients[name]) is None else g for name, step in steps.items()}
        last, self._last = self._last, (steps, slopes)
        if last is not None:
            decreases = (
                -slopes[name] * step + 0.5 * (slopes[name] - last[1][name]) * last[0][name]
                for name, step in steps.items()
            )
            parts = torch.cat([_in_parts(decrease.flatten()) for decrease in decreases])
            self._decreases = [*self._decreases[1 - MAX_STEPS :], parts]

    def split_losses(self) -> None:
        """Compare no later loss with an earlier one; gradients stay comparable."""
        self._losses = [*self._losses, math.nan]

    def reset(self) -> None:
        self._before, self._last, self._decreases, self._losses = None, None, [], []

    @property
    def is_ready(self) -> bool:
        """Whether there are enough steps for a prediction."""
        return len(self._decreases) >= BLOCKS

    def predicted_decrease(self, steps: int) -> float:
        """Return by how much so many more steps lower the loss, from the latter half of the steps so far; ∞ before the monitor
        is ready. Only numbers that have led down count. Every other block of steps says which numbers these are, and the blocks
        between say by how much. The two share no noise, so noise adds nothing on average."""
        if not self.is_ready:
            return math.inf
        length = max(1, len(self._decreases) // (2 * BLOCKS))
        blocks = torch.stack(self._decreases[-BLOCKS * length :]).reshape(BLOCKS, length, -1).mean(1)
        even, odd = blocks[::2].mean(0).double(), blocks[1::2].mean(0).double()
        return steps * 0.5 * float(odd[even > 0].sum() + even[odd > 0].sum())

    def least_decrease(self, tolerance: float, steps: int) -> float:
        """Return the smallest decrease of the loss in so many steps that counts. It is the tolerated share of the loss, or of
        its decrease so far where that is less, for no step may mend much of a loss. It is at least the noise of the mean loss
        over as many steps."""
        last = torch.tensor(self._losses, dtype=torch.float64)
        differences = last.diff()
        differences = differences[differences.isfinite()]
        if len(differences) == 0:
            return 0.0
        now = float(last.nanmean())
        noise = float(differences.square().mean()) / 2.0  # a steady decrease hardly adds to it
        return max(tolerance * min(abs(now), abs(self.first - now)), math.sqrt(noise / steps))

    def state(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_values"}

    def load(self, state: Mapping[str, Any]) -> None:
        vars(self).update(state)


def _in_parts(numbers: Tensor) -> Tensor:
    """Return sums over neighbours if there are more than MAX_PARTS numbers."""
    each = -(-len(numbers) // MAX_PARTS)
    return torch.nn.functional.pad(numbers, (0, -len(numbers) % each)).reshape(-1, each).sum(1)
