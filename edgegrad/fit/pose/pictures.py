"""Pictures of a fit: what was compared."""

from __future__ import annotations

from matplotlib.figure import Figure

from ..plots import comparison
from ..result import chosen
from .photo.overlay import overlay
from .result import PoseFit

PANEL_SIDE = 512  # largest side of a panel in pixels
FIGURE_SPP = 64


def sheet(*fits: PoseFit, most: int | None = None) -> Figure:
    """Draw target | start | fit | difference, a row for each picture of one fit or several, or for at most so many; with a mask
    all over black, as they were compared. Raises ValueError for a fit that did not take a step or came from JSON."""
    rows = []
    for fit in fits:
        if fit.task is None or not fit.history:
            raise ValueError(
                "fit: expected one that took a step, got one without; draw what fit_pose returns, not from_json"
            )
        last = next(step for step in reversed(fit.history) if step.best)  # what the fit returned
        start, end = (overlay(fit.task, PANEL_SIDE, FIGURE_SPP, step.pose) for step in (fit.history[0], last))
        rows += [(target, a, b) for (target, a), (_, b) in zip(start, end, strict=True)]
    return comparison([rows[k] for k in chosen(len(rows), len(rows) if most is None else most)])
