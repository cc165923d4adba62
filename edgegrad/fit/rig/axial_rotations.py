"""Rotations of limbs about their own axes, which outlines hardly show: found by the loss along each.

Such a shared rotation changes a loss so little, and so far from quadratically, that Gauss-Newton steps stop 10° and more from
its minimum, and a flat hand has another minimum on the opposite side of the right one. Losses of two poses by the same
samples rank them far below the noise of either.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from ..descent.objective import Objective
from ..parameter import Parameter
from .alternatives import Alternatives, AxialRotation
from .limbs import Values, loss_of

TRIED_ANGLES = 0.15, 0.3, 0.5, 0.7  # radians, to both sides
QUARTER_TURN = 0.5 * math.pi  # also tried where nothing hangs on the limb
REFINED_ANGLES = 0.1, 0.05  # tried in turn after an improvement
# The best angle is chosen by the first seeds, and must be better by the others.
CHOICE_SEEDS, TEST_SEEDS = (0,), (1, 2, 3)
MIN_Z_SCORE = 2.0  # in units of the noise of their mean


def search_axial_rotations(
    objective: Objective, alternatives: Alternatives, parameter: Parameter, values: Values
) -> Values:
    """Return these values, or others of the alternatives' value whose loss is lower."""
    best = values
    for rotation in alternatives.axial_rotations(values):
        angles = (*TRIED_ANGLES, QUARTER_TURN) if rotation.child is None else TRIED_ANGLES
        if (found := _along(objective, alternatives, parameter, best, rotation, angles)) is not None:
            best = found
            for angle in REFINED_ANGLES:
                best = _along(objective, alternatives, parameter, best, rotation, (angle,)) or best
    return best


def _along(
    objective: Objective, alternatives: Alternatives, parameter: Parameter, values: Values, rotation: AxialRotation,
    angles: Sequence[float],
) -> Values | None:  # fmt: skip
    """Return the best of these angles to both sides; None where none is better."""
    name = alternatives.name
    starts = [
        {**values, name: parameter.within(alternatives.with_rotation(values, rotation, side * angle))}
        for angle in angles
        for side in (-1.0, 1.0)
    ]
    losses = [loss_of(objective, start, CHOICE_SEEDS) for start in starts]
    if min(losses) >= loss_of(objective, values, CHOICE_SEEDS):
        return None
    found = starts[losses.index(min(losses))]
    decreases = torch.tensor(
        [loss_of(objective, values, [k]) - loss_of(objective, found, [k]) for k in TEST_SEEDS], dtype=torch.float32
    )
    return (
        found if float(decreases.mean()) > MIN_Z_SCORE * float(decreases.std()) / math.sqrt(len(TEST_SEEDS)) else None
    )
