"""The steps of a fit by descent, as they are kept and as JSON has them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from torch import Tensor


class Record(NamedTuple):
    """One step."""

    step: int
    loss: float  # of this step's views and samples, regularizer included
    gradient: dict[str, float]  # norm, by parameter
    values: dict[str, Tensor]  # of parameters of up to 64 numbers, before the step
    rate: float = 1.0  # factor of the learning rates; 1 where there are none


def plain_history(history: Sequence[Record]) -> list[dict[str, Any]]:
    """As history.json has it."""
    return [_plain(record) for record in history]


def _plain(record: Record) -> dict[str, Any]:
    values = {name: value.tolist() for name, value in record.values.items()}
    gradient = {name: number_or_none(norm) for name, norm in record.gradient.items()}
    return {
        "step": record.step,
        "loss": number_or_none(record.loss),
        "gradient": gradient,
        "values": values,
        "rate": record.rate,
    }


def number_or_none(value: float) -> float | None:
    """For JSON, which knows no NaN and no infinity."""
    return value if math.isfinite(value) else None
