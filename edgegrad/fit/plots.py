"""Figures of fits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from torch import Tensor

from .views import displayed

INK, GREY = "#303030", "#c4c4c4"


def comparison(rows: Sequence[tuple[Tensor, Tensor, Tensor]], differences: bool = True) -> Figure:
    """Draw target, start, fit and difference, with a row of linear images (H, W, C) for each view."""
    columns = 3 + differences
    shown = [tuple(displayed(image).numpy() for image in row) for row in rows]
    apart = [np.abs(end - target) for target, _, end in shown]
    # Errors of a good fit are too faint to see. A power of two keeps the caption easy to read.
    largest = max(float(np.quantile(a, 0.999)) for a in apart)
    factor = 2 ** int(np.clip(np.floor(-np.log2(largest + 1e-9)), 0, 4))
    h, w = np.array(shown[0][0].shape[:2]) / max(shown[0][0].shape[:2])
    figure = Figure(figsize=(columns * 2.4 * w + 0.3, 2.4 * h * len(rows) + 0.34), dpi=200, layout="constrained")
    figure.get_layout_engine().set(w_pad=0.03, h_pad=0.04, wspace=0.0, hspace=0.0)  # type: ignore[union-attr]
    grid = figure.subplots(len(rows), columns, squeeze=False)
    titles = ("target", "start", "fit", "difference" + (f" × {factor}" if factor > 1 else ""))[:columns]
    for axes, row, difference in zip(grid, shown, apart, strict=True):
        for ax, image in zip(axes, (*row, np.clip(factor * difference, 0, 1))[:columns], strict=True):
            ax.imshow(image, interpolation="nearest")
            ax.set_axis_off()
    for ax, title in zip(grid[0], titles, strict=True):
        ax.set_title(title, fontsize=9, color=INK, pad=4)
    return figure


def curves(history: Sequence[Any]) -> Figure:
    """Draw the loss, one colour a level of resolution, and the norm of the gradient by each parameter. Steps that did not lead to
    the best so far are grey. Raises ValueError without a step."""
    if not history:
        raise ValueError("fit: expected one that took a step, got one without; draw what a fit returns, not from_json")
    figure = Figure(figsize=(6.4, 4.6), dpi=200, layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    losses, steps = [record.loss for record in history], range(1, len(history) + 1)
    levels: dict[Any, list[int]] = {}
    for k, record in enumerate(history):
        if getattr(record, "best", True):
            levels.setdefault(getattr(record, "size", None), []).append(k)
    above.plot(steps, losses, ".", color=GREY, markersize=3)
    for at, (size, rows) in enumerate(levels.items()):
        color = INK if size is None else colormaps["viridis"](0.85 * at / max(1, len(levels) - 1))
        label = None if size is None else f"{size[1]} × {size[0]} px"
        above.plot([steps[k] for k in rows], [losses[k] for k in rows], ".-", ms=3, lw=1, color=color, label=label)
    if set(levels) != {None}:
        above.legend(frameon=False, fontsize=8, title="best so far", title_fontsize=8)
    for name in dict.fromkeys(name for record in history for name in record.gradient):
        norms = [record.gradient.get(name, math.nan) for record in history]  # There are gaps where a step has none.
        # A step between gaps has no line, so it is drawn as a point.
        below.plot(steps, norms, ".-", markersize=3, linewidth=1, label=name)
    if min(losses) > 0.0:  # Log likelihood ratios are not.
        above.set_yscale("log")
    below.set(yscale="log", ylabel="|gradient|", xlabel="step")
    below.legend(frameon=False, fontsize=8)
    above.set_ylabel("loss")
    for axes in (above, below):
        axes.spines[["top", "right"]].set_visible(False)
    return figure
