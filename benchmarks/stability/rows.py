"""What a row of the stability report says."""

from __future__ import annotations

from typing import Any

NAME = "stability"


def gradient(row: dict[str, Any]) -> tuple[str, dict[str, float]]:
    """The part of the gradient that is farthest off, and its errors."""
    return max(row["parts"].items(), key=lambda item: item[1]["error"])
