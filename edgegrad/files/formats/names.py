"""Unique names for what files hold."""

from __future__ import annotations

from collections.abc import Container
from itertools import chain, count


def unique_name(taken: Container[str], *names: str) -> str:
    """Return the first name that is not taken; where all are, the last one with the first free number from 2 behind it."""
    numbered = (f"{names[-1]} ({k})" for k in count(2))
    return next(name for name in chain(names, numbered) if name not in taken)
