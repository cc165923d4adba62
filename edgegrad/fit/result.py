"""The base of the results of all fits, how they ended in words, and their steps as JSON holds them."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..files.paths import PathLike
from ..optim.tensors import Ending, Record
from ..optional import DRAWING, require
from .edge_support import MIN_EDGE_SUPPORT

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class FitResult:
    """The base of all results. Each has these attributes, and under its own names what was found.

    Attributes
    ----------
    converged, reason : bool, str
        Whether further steps lead no further and, but for poses, the pictures show what was found; and "converged", or in words
        what is missing.
    loss, explained : float
        The loss at the end, and the share, 0 … 1, of the render's edges that the pictures show too.
    history : list
        A record of each step, with its `loss` and the norms of its `gradient`.
    steps, seconds, interrupted : int, float, bool
        Number of steps, time, and whether KeyboardInterrupt ended the fit; the result is the best until then.
    """

    def plot(self, most: int = 4) -> Figure:
        """Draw target, start, fit and difference of at most `most` pictures."""
        raise NotImplementedError

    def plot_history(self: Any) -> Figure:
        """Draw the loss and the norm of each gradient over the steps."""
        return require("edgegrad.fit.plots", *DRAWING).curves(self.history)

    def save(self, folder: PathLike, figures: bool = True) -> list[str]:
        """Write the result to a folder, which is made if missing, and return the names of the files.

        Each file is written whole or not at all. Raises OSError, or at last ImportError if figures are asked for and
        matplotlib is missing.
        """
        raise NotImplementedError


def delegated(part: str, names: str) -> list[Any]:
    """Return properties that are those of the attribute `part`, by names apart by spaces."""
    return [property(attrgetter(f"{part}.{name}")) for name in names.split()]


def chosen(count: int, most: int) -> list[int]:
    """Return at most so many numbers below `count`, evenly apart."""
    return sorted({round(k * (count - 1) / max(1, min(most, count) - 1)) for k in range(min(most, count))})


def made_folder(folder: object) -> Path:
    """Return the path of a folder, which is made if missing. Raises TypeError or OSError."""
    if not isinstance(folder, (str, os.PathLike)):
        raise TypeError(f"folder: expected a path, got {type(folder).__name__}; give the folder to write to")
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise FileExistsError(
            f"folder: expected a folder, got a file of that name, {path}; give another name, or remove the file"
        ) from None
    except OSError as error:
        raise OSError(f"folder: expected a folder to write to, got {path} ({error.strerror})") from error
    return path


def reason_of(
    ending: Ending, explained: float, suspects: str = "scene, cameras or pictures", enough: float = MIN_EDGE_SUPPORT
) -> str:
    """Return "converged", or what kept the fit from it and, after a colon, how to mend it."""
    if ending is Ending.INTERRUPTED:
        return "interrupted"
    if ending is Ending.FALLING:
        return "loss still falling: give it more steps, or larger learning rates"
    if explained < enough:
        return (
            f"edges not explained: the pictures show {explained:.0%} of the render's edges; start nearer, or look for what is "
            f"wrong in {suspects}"
        )
    if ending is Ending.STEPS:
        return "steps ran out: what is sought has not come to rest; give it more steps"
    return "converged"


def history_rows(history: Sequence[Any]) -> list[dict[str, Any]]:
    """Return for history.json records with values, or steps with a pose."""
    return [
        {
            "step": k, "loss": number_or_none(one.loss),
            "gradient": {name: number_or_none(norm) for name, norm in one.gradient.items()},
            "values": {name: value.tolist() for name, value in values.items()},
        }
        for k, one in enumerate(history)
        for values in [one.values if isinstance(one, Record) else one.pose._asdict()]
    ]  # fmt: skip


def number_or_none(value: float) -> float | None:
    """Replace NaN and infinity, which JSON does not have, by None."""
    return value if math.isfinite(value) else None
