"""Counts of the kernel in a backward pass, and tables that show them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

# What the kernel counts.
CURVES = ("silhouettes", "creases", "intersections", "lens_boundary")
COUNTS = (
    "surface_samples", "edge_samples", "surface_wanted", "edge_wanted", "discontinuity_lines", *CURVES,
)  # fmt: skip


class Watch:
    """Receives what an image and its gradient take, where points are shaded. This one keeps nothing."""

    def part(self, name: str) -> AbstractContextManager[None]:
        """Return a context around a part of the work. Parts of one name add up."""
        return nullcontext()

    def count(self, name: str, number: int) -> None:
        """Receive a number of samples. Those of one name add up."""


def table(rows: Sequence[Sequence[str]], align: str) -> str:
    """Return rows of text in columns, each aligned to the left (<) or to the right (>)."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    cells = [[f"{cell:{side}{w}s}" for cell, side, w in zip(row, align, widths, strict=True)] for row in rows]
    return "\n".join("  ".join(row).rstrip() for row in cells)
