"""What the results of all fits have in common."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

from ..files.paths import PathLike
from ..optional import DRAWING, require

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class FitResult:
    """What a fit found, under its own names, and how it went.

    Attributes
    ----------
    converged : bool
        Whether further steps lead no further, and the pictures show what the fit found.
    reason : str
        "converged", or what kept the fit from it and how to mend that.
    loss : float
        The loss at the end.
    explained : float
        Share of the render's edges that the pictures show too, 0 … 1.
    history : list
        A record of each step, with its `loss` and the norms of its `gradient`.
    steps, seconds : int, float
        Number of steps, and time.
    interrupted : bool
        Whether KeyboardInterrupt ended the fit; the result is the best until then.
    """

    def plot(self, most: int = 4) -> Figure:
        """Draw target, start, fit and difference of at most `most` pictures."""
        raise NotImplementedError

    def plot_history(self: Any) -> Figure:
        """Draw the loss and the norm of each gradient over the steps."""
        return require("edgegrad.fit.plots", *DRAWING).curves(self.history)

    def save(self, folder: PathLike, figures: bool = True) -> list[str]:
        """Write the result to a folder, which is made if missing, and return the names of the files. Each file is written whole
        or not at all. Raises OSError, or at last ImportError if figures are asked for and matplotlib is missing."""
        raise NotImplementedError

    @property
    def _can_draw(self) -> bool:
        return True

    def _repr_png_(self) -> bytes | None:
        """Return plot() for a notebook, where there is something to draw."""
        if not self._can_draw:
            return None
        file = io.BytesIO()
        self.plot().savefig(file, format="png", dpi=100)
        return file.getvalue()


def chosen(count: int, most: int) -> list[int]:
    """Return at most so many numbers below `count`, evenly apart."""
    return sorted({round(k * (count - 1) / max(1, min(most, count) - 1)) for k in range(min(most, count))})
