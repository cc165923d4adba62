"""The live view as a figure that is updated in place in a notebook."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ..optional import require
from .snapshot import CONTRAST, Snapshot

INK = "#303030"


class NotebookFigure:
    """A matplotlib figure in a notebook."""

    url = None

    def __init__(self) -> None:
        self._display: Any = require("IPython.display", "ipython", "a figure in a notebook")
        self._handle: Any = None
        self.figure = Figure(figsize=(9.0, 2.6), dpi=90, layout="constrained")

    def draw(self, snapshot: Snapshot, index: int, losses: Sequence[float], state: str) -> None:
        self.figure.clear()
        panel = snapshot.panel(index) if snapshot.cameras else []
        curve = [np.isfinite(loss) for loss in losses].count(True) > 1
        axes = list(self.figure.subplots(1, max(1, len(panel) + curve), squeeze=False)[0])
        titles = ("target", "render", f"difference × {CONTRAST}") if len(panel) == 3 else ("render",)
        for ax, picture, title in zip(axes, panel, titles, strict=False):
            ax.imshow(picture, interpolation="nearest")
            ax.set_title(title, fontsize=9, color=INK)
        for ax in axes[: len(axes) - curve]:
            ax.set_axis_off()
        if curve:
            axes[-1].plot(range(1, len(losses) + 1), losses, color=INK, linewidth=1)
            axes[-1].set_yscale("log" if np.nanmin(losses) > 0.0 else "linear")
            axes[-1].set_title("loss", fontsize=9, color=INK)
            axes[-1].spines[["top", "right"]].set_visible(False)
        self.set_status(state)

    def set_status(self, state: str) -> None:
        self.figure.suptitle(state.replace("**", ""), fontsize=9, color=INK)
        file = io.BytesIO()
        self.figure.savefig(file, format="png")
        image = self._display.Image(data=file.getvalue())
        if self._handle is None:
            self._handle = self._display.display(image, display_id=True)
        else:
            self._handle.update(image)

    def set_labels(self, pause: str, stop: str) -> None:
        """Do nothing: the figure has no buttons, and the notebook's own one ends a fit."""

    def close(self) -> None:
        """Leave the figure as it is."""
