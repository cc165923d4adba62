"""Whether the steps of a descent still lead down, from gradients rather than from losses.

Losses are noisy, and their differences more so. At the end of a step Δxₖ the gradient gₖ has samples of its own, which the step
does not know: −gₖ·Δxₖ is then an unbiased estimate of how steeply the loss falls there, with far less noise. It is positive on
the way down, and negative where steps overshoot, to and fro about a minimum.

Over the whole step the loss falls by −gₖ·Δxₖ + ½ Δxₖ·H Δxₖ. Steps of Adam shake by the noise of their gradients, which costs the
second term at the end of each and can hide a slow way down. They change little from one to the next, so that
½ (gₖ − gₖ₋₁)·Δxₖ₋₁ estimates it: neither gradient's samples are known to the step before both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ..options import Options

LEAST = 8  # falls that tell
PARTS = 4096


class Falls:
    """Falls of the loss in the steps since the last `forget()`, for each number that is sought, or each of PARTS parts of a large
    tensor.

    Sums over LEAST to 2 LEAST blocks of steps of one length are kept, which grows by twice: the last LEAST of them are at least
    the latter half of the steps.

    apart  as steps of Adam are: each number counts by itself, and over the whole step; else the sum over all, at the step's end
    """

    def __init__(self, values: Mapping[str, Tensor], apart: bool = True) -> None:
        self._values, self._apart = values, apart
        self._before: dict[str, Tensor] | None = None  # values before the last step
        self._blocks: list[Tensor] = []
        self._length, self._filled = 1, 0  # steps of a block, and of the last one so far
        self._last: tuple[dict[str, Tensor], dict[str, Tensor]] | None = None  # step, and gradient at its end
        self._losses: list[float] = []
        self.first = math.nan  # loss of all

    def observe(self, loss: float, gradients: Mapping[str, Tensor | None]) -> None:
        """At the end of a step, if one was noted."""
        self._losses = [*self._losses[-2 * LEAST :], loss]
        self.first = loss if math.isnan(self.first) else self.first
        if self._before is None:
            return
        steps = {name: self._values[name].detach() - before for name, before in self._before.items()}
        slopes = {name: torch.zeros_like(step) if (g := gradients[name]) is None else g for name, step in steps.items()}
        last, self._last = self._last, (steps, slopes)
        if not self._apart:
            self._add(torch.stack([-(slopes[name] * step).double().sum() for name, step in steps.items()]).sum()[None])
        elif last is not None:
            falls = (
                -slopes[name] * step + 0.5 * (slopes[name] - last[1][name]) * last[0][name]
                for name, step in steps.items()
            )
            self._add(torch.cat([_in_parts(fall.flatten()) for fall in falls]))

    def _add(self, falls: Tensor) -> None:
        if self._blocks and self._filled < self._length:
            self._blocks[-1] += falls
        else:
            self._blocks.append(falls)
            self._filled = 0
        self._filled += 1
        if len(self._blocks) == 2 * LEAST and self._filled == self._length:
            self._blocks = [a + b for a, b in zip(self._blocks[::2], self._blocks[1::2], strict=True)]
            self._length, self._filled = 2 * self._length, 2 * self._length

    def part(self) -> None:
        """The losses after this are no longer comparable with those before, but gradients are."""
        self._losses = [*self._losses, math.nan]

    def note(self) -> None:
        """Before a step: where it begins."""
        self._before = {name: value.detach().clone() for name, value in self._values.items()}

    def forget(self) -> None:
        self._before, self._last, self._blocks, self._length, self._filled, self._losses = None, None, [], 1, 0, []

    @property
    def tell(self) -> bool:
        """Whether there are enough of them."""
        return len(self._whole) >= LEAST

    @property
    def _whole(self) -> list[Tensor]:
        return self._blocks if self._filled == self._length else self._blocks[:-1]

    def promise(self, steps: int) -> float:
        """By how much so many more steps lead down; ∞ where there are too few to tell.

        The sum over what has led down: every other block says which numbers, and those between by how much, so that noise, which
        the two do not share, adds nothing on average."""
        if not self.tell:
            return math.inf
        last = self._whole[-LEAST:]
        even, odd = (2.0 / LEAST / self._length * sum(last[k::2], torch.zeros_like(last[0])) for k in (0, 1))
        return steps * 0.5 * float(odd[even > 0].double().sum() + even[odd > 0].double().sum())

    def least(self, options: Options) -> float:
        """What is no fall of the loss: the tolerated share of it, or of what it has fallen by so far where that is less, for
        much of a loss may be what no step can mend; but not less than the noise of its mean over as many steps as the
        patience."""
        last = torch.tensor(self._losses, dtype=torch.float64)
        differences = last.diff()
        differences = differences[differences.isfinite()]
        if len(differences) == 0:
            return 0.0
        now = float(last.nanmean())
        noise = float(differences.square().mean()) / 2.0  # in which a steady fall hardly counts
        share = options.tolerance * min(abs(now), abs(self.first - now))
        return max(share, math.sqrt(noise / options.patience))

    def state(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("_values", "_apart")}

    def load(self, state: Mapping[str, Any]) -> None:
        for name, value in state.items():
            setattr(self, name, value)


def _in_parts(numbers: Tensor) -> Tensor:
    """Sums over neighbours, of more than PARTS numbers."""
    each = -(-len(numbers) // PARTS)
    return torch.nn.functional.pad(numbers, (0, -len(numbers) % each)).reshape(-1, each).sum(1)
