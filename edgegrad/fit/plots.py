"""Figures of fits by descent."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from ..optim.history import Record
from .views import displayed

INK = "#303030"


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


def curves(history: Sequence[Record]) -> Figure:
    """Draw the loss, and the norm of the gradient by each parameter."""
    figure, axes = loss_figure([record.gradient for record in history])
    axes.plot([record.step + 1 for record in history], [record.loss for record in history], color=INK, linewidth=1)
    if min(record.loss for record in history) > 0.0:  # Log likelihood ratios are not.
        axes.set_yscale("log")
    return figure


def loss_figure(gradients: Sequence[Mapping[str, float]]) -> tuple[Figure, Axes]:
    """Return a figure with each norm of the gradient from step 1 on, and the axes above for the loss."""
    figure = Figure(figsize=(6.4, 4.6), dpi=200, layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    for name in dict.fromkeys(name for gradient in gradients for name in gradient):
        norms = [gradient.get(name, math.nan) for gradient in gradients]  # There are gaps where a step has none.
        # A step between gaps has no line, so it is drawn as a point.
        below.plot(range(1, len(norms) + 1), norms, ".-", markersize=3, linewidth=1, label=name)
    below.set(yscale="log", ylabel="|gradient|", xlabel="step")
    below.legend(frameon=False, fontsize=8)
    above.set_ylabel("loss")
    for axes in (above, below):
        axes.spines[["top", "right"]].set_visible(False)
    return figure, above
