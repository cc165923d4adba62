"""Rows of a table of measurements, and how two sides of a ratio are measured in turns."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from tqdm import tqdm

from .document import duration

Value = TypeVar("Value")


@dataclass
class Row:
    """A line of the table. Rows without a target have no `must`."""

    what: str
    measured: float
    spread: tuple[float, float] | None = None  # quartiles
    unit: str = ""
    must: float | None = None
    aim: float | None = None
    more_is_better: bool = False
    bound: bool = False  # at least `measured`: the other side could not be brought there in time
    note: str = ""
    verdict: str = field(init=False)

    def __post_init__(self) -> None:
        self.verdict = ""
        if self.must is not None:
            sign = 1 if self.more_is_better else -1
            below = "not shown" if self.bound else "below"
            self.verdict = "meets must" if sign * self.measured >= sign * self.must else below
            if self.aim is not None and sign * self.measured >= sign * self.aim:
                self.verdict = "meets aim"

    def cells(self) -> tuple[str, ...]:
        def number(x: float | None) -> str:
            return "" if x is None else (f"{x:.0f}" if abs(x) >= 100 else f"{x:.3g}") + self.unit

        sign = "≥ " if self.more_is_better else "≤ "
        spread = f"{number(self.spread[0])} … {number(self.spread[1])}" if self.spread else ""
        must, aim = (sign + number(x) if x is not None else "" for x in (self.must, self.aim))
        return self.what, ("> " if self.bound else "") + number(self.measured), spread, must, aim, self.verdict


HEAD = ("what", "measured", "quartiles", "must", "aim", "verdict")
WIDTHS = (66, 10, 21, 9, 9, 10)


def line(cells: Sequence[str]) -> str:
    return "  ".join(f"{cell:{width}s}" for cell, width in zip(cells, WIDTHS, strict=True)).rstrip()


class Skipped(Exception):
    """Raised where a row cannot be measured; the message says what it needs."""


class Bench:
    """Effort and progress."""

    def __init__(self, quick: bool, limit: float, bar: tqdm) -> None:
        self.quick, self.limit, self.bar = quick, limit, bar

    def repeats(self, n: int) -> int:
        return max(3, n // 4) if self.quick else n

    def interleaved(self, repeats: int, *sides: Callable[[], Value]) -> list[list[Value]]:
        """Return what each side returned, in turns A B A B …; the first turn does not count."""
        n = self.repeats(repeats)
        found: list[list[Value]] = [[] for _ in sides]
        for turn in range(n + 1):
            self.bar.set_postfix_str(f"{turn} of {n}")
            for side, values in zip(sides, found, strict=True):
                values.append(side())
        return [values[1:] for values in found]


def median_row(what: str, values: Sequence[float], **rest: Any) -> Row:
    return Row(what, statistics.median(values), quartiles(values), **rest)


def ratio_row(what: str, over: Sequence[float], under: Sequence[float], **rest: Any) -> Row:
    return median_row(what, [a / b for a, b in zip(over, under, strict=True)], **rest)


def quartiles(values: Sequence[float]) -> tuple[float, float]:
    low, high = np.quantile(np.array(values), [0.25, 0.75])
    return float(low), float(high)


def median_time(seconds: Sequence[float]) -> str:
    return duration(statistics.median(seconds))


def seconds_of(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin
