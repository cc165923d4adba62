"""What the kernel counts in a backward pass, and how counts are shown."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

# What the kernel counts.
CURVES = ("silhouettes", "creases", "intersections", "lens_boundary")
COUNTS = (
    "surface_samples", "edge_samples", "surface_wanted", "edge_wanted", "step_lines", *CURVES,
)  # fmt: skip


class Watch:
    """Is told what an image and its gradient take, where points are shaded. This one does not listen."""

    def part(self, name: str) -> AbstractContextManager[None]:
        """Around a part of the work; parts of one name add up."""
        return nullcontext()

    def count(self, name: str, number: int) -> None:
        """Of samples; those of one name add up."""


def table(rows: Sequence[Sequence[str]], align: str) -> str:
    """Rows of text in columns, each aligned to the left (<) or to the right (>)."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    cells = [[f"{cell:{side}{w}s}" for cell, side, w in zip(row, align, widths, strict=True)] for row in rows]
    return "\n".join("  ".join(row).rstrip() for row in cells)
