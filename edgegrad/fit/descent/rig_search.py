"""Poses of a rig that a descent from the start does not reach: limbs drawn anew, where that lowers the loss.

Silhouettes say little of which limb they show, so that a descent ends where one of them lies in the place of another. Some limb,
a joint and all below it, is turned at random, so often that one of the turns is not far off; the best of them is the start of a
few steps, and the result is kept if its loss is lower.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ...rig.rig import Rig
from .objective import Objective

DRAWS = 12  # turns of a limb that are looked at
SPREAD = 0.4  # radians, of each component
SHARE = 0.4  # of all rows: a joint with more below it is turned alone
Values = dict[str, Tensor]


def limbs(rig: Rig, rows: Sequence[int]) -> list[list[int]]:
    """Of the joints `rows`, each with those below it, as places in `rows`."""
    parents, found = rig.deformer.parents, []
    for row in rows:
        group = []
        for place, other in enumerate(rows):
            at = other
            while at >= 0 and at != row:
                at = parents[at]
            if at == row:
                group.append(place)
        found.append(group if len(group) <= max(1.0, SHARE * len(rows)) else [list(rows).index(row)])
    return found


def searched(
    objective: Objective, values: Values, name: str, groups: Sequence[Sequence[int]], tries: int, seed: int,
    within: Callable[[Tensor], Tensor], steps: Callable[[Values], Values], tell: Callable[[], Any],
) -> Values:  # fmt: skip
    """The best values of so many tries at groups of rows of one of them; `steps` goes down from a start."""
    generator = torch.Generator().manual_seed(seed)

    def loss(at: Values, seeds: Sequence[int]) -> float:
        with torch.no_grad():
            return sum(float(objective(at, k)) for k in seeds) / len(seeds)

    best, least = values, loss(values, (0, 1))
    for _ in range(tries):
        rows = list(groups[int(torch.randint(len(groups), (), generator=generator))])
        drawn = []
        for _draw in range(DRAWS):
            turned = best[name].clone()
            turned[rows] = SPREAD * torch.randn(turned[rows].shape, generator=generator, dtype=turned.dtype)
            drawn.append({**best, name: within(turned)})
        found = steps(min(drawn, key=lambda one: loss(one, (0,))))
        if (now := loss(found, (0, 1))) < least:
            best, least = found, now
        tell()
    return best
