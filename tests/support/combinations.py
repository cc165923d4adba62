"""Parameters of tests in all combinations, of which the quick tests have few and the slow ones all."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import pytest


def diagonal(*lists: Sequence[object]) -> list[object]:
    """All combinations of an entry of each list, for pytest.mark.parametrize. Quick are as many as the longest list has entries,
    such that each entry of each list is in one; the others are slow."""
    lists = tuple(list(entries) for entries in lists)
    quick = {tuple(k % len(entries) for entries in lists) for k in range(max(map(len, lists)))}
    out = []
    for at in itertools.product(*(range(len(entries)) for entries in lists)):
        values = [entries[i] for entries, i in zip(lists, at, strict=True)]
        out.append(pytest.param(*values, marks=[] if at in quick else [pytest.mark.slow]))
    return out
