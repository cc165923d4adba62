"""The steps of a fit by descent, as JSON holds them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from ..optim.history import Record


def history_rows(history: Sequence[Record]) -> list[dict[str, Any]]:
    """Return the records for history.json."""
    return [
        {
            "step": record.step, "loss": number_or_none(record.loss),
            "gradient": {name: number_or_none(norm) for name, norm in record.gradient.items()},
            "values": {name: value.tolist() for name, value in record.values.items()}, "rate": record.rate,
        }
        for record in history
    ]  # fmt: skip


def number_or_none(value: float) -> float | None:
    """Replace NaN and infinity, which JSON does not have, by None."""
    return value if math.isfinite(value) else None
