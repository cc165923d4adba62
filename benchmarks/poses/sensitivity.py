"""How results of fits change at half and twice each number of their settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from importlib import import_module
from typing import Any

from .runs import Job, Record, run
from .summary import known, sure

SETTINGS = "edgegrad.fit.pose.settings", "PoseSettings"  # a frozen dataclass with defaults


def variants(settings: Any, prefix: str = "") -> list[tuple[str, float, list[Any]]]:
    """Return the name and value of each number of a dataclass, also of those in it, and settings with half and twice of it."""
    found: list[tuple[str, float, list[Any]]] = []
    for one in fields(settings):
        value = getattr(settings, one.name)
        if is_dataclass(value):
            for name, inner, changed in variants(value, f"{prefix}{one.name}."):
                found.append((name, inner, [replace(settings, **{one.name: part}) for part in changed]))
        elif isinstance(value, int | float) and not isinstance(value, bool):
            others = [type(value)(factor * value) for factor in (0.5, 2.0)]
            found.append((prefix + one.name, value, [replace(settings, **{one.name: other}) for other in others]))
    return found


def print_table(jobs: Sequence[Job], processes: int) -> None:
    """Print a Markdown table: right, sure and wrong, and the time of a fit, by default and at half and twice each number.

    Raises ImportError if there are no settings.
    """
    default = getattr(import_module(SETTINGS[0]), SETTINGS[1])()
    print(
        f"By default: {_cell(jobs, default, processes)}.\n\n| setting | value | at half | at twice |\n|---|---|---|---|"
    )
    for name, value, changed in variants(default):
        cells = [_cell(jobs, one, processes) for one in changed]
        print(f"| `{name}` | {value:g} | {cells[0]} | {cells[1]} |", flush=True)


def _cell(jobs: Sequence[Job], settings: object, processes: int) -> str:
    records: list[Record] = []
    for found in run([replace(job, settings=settings) for job in jobs], processes):
        records += found
    right, falsely = sum(one["right"] for one in records), sum(sure(one) and not known(one) for one in records)
    seconds = sum(one.get("work", 0.0) for one in records) / len(records)
    return f"{right} of {len(records)} right, {falsely} falsely sure, {seconds:.1f} s"
