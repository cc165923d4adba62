"""Twists of limbs about their own axes, which outlines hardly tell: found by the loss along each.

A shared twist changes a loss so little, and so far from quadratically, that steps of Gauss and Newton come to rest 10° and more
from its minimum, and a flat hand has another minimum across the right one. Losses of two poses by the same samples tell which of
them is better far below the noise of either.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from ..descent.objective import Objective
from ..options import Parameter
from .alternatives import Alternatives, Twist
from .limbs import Values, loss_of

ANGLES = 0.15, 0.3, 0.5, 0.7  # radians, to both sides
ACROSS = 0.5 * math.pi  # and of what nothing hangs on
FINER = 0.1, 0.05  # one after the other, where one of them was better
LOOKED, TOLD = (0,), (1, 2, 3)  # seeds by which the best angle is chosen, and those by which it must be better
DEVIATIONS = 2.0  # of the noise of their mean


def untwisted(objective: Objective, alternatives: Alternatives, parameter: Parameter, values: Values) -> Values:
    """These values, or others of the alternatives' value whose loss is lower."""
    best = values
    for twist in alternatives.twists(values):
        angles = (*ANGLES, ACROSS) if twist.child is None else ANGLES
        if (found := _along(objective, alternatives, parameter, best, twist, angles)) is not None:
            best = found
            for angle in FINER:
                best = _along(objective, alternatives, parameter, best, twist, (angle,)) or best
    return best


def _along(
    objective: Objective, alternatives: Alternatives, parameter: Parameter, values: Values, twist: Twist,
    angles: Sequence[float],
) -> Values | None:  # fmt: skip
    """The best of these angles to both sides; None where none is better."""
    name = alternatives.name
    starts = [
        {**values, name: parameter.within(alternatives.twisted(values, twist, side * angle))}
        for angle in angles
        for side in (-1.0, 1.0)
    ]
    losses = [loss_of(objective, start, LOOKED) for start in starts]
    if min(losses) >= loss_of(objective, values, LOOKED):
        return None
    found = starts[losses.index(min(losses))]
    falls = torch.tensor([loss_of(objective, values, [k]) - loss_of(objective, found, [k]) for k in TOLD])
    return found if float(falls.mean()) > DEVIATIONS * float(falls.std()) / math.sqrt(len(TOLD)) else None
