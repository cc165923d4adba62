"""Write what commands find."""

from __future__ import annotations

import argparse
import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..fit.descent.result import Fit
    from ..fit.pose.camera_result import CameraFit
    from ..fit.pose.result import PoseFit
    from ..fit.rig.result import RigFit
    from ..live.view import Viewer


def make_folder(folder: Path) -> None:
    """Make the folder, so that an error does not come after the work. Raises OSError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        raise OSError(
            f"--out: expected a folder to write to, got {folder} ({error.strerror}); choose another"
        ) from error


def print_note(text: str) -> None:
    """Print a note on standard error, if there is one."""
    if text:
        print(text, file=sys.stderr)


@contextmanager
def live_view(args: argparse.Namespace) -> Iterator[Viewer | None]:
    """Open the live view that --view asks for. The block has to save the result. Raises ImportError without viser."""
    if not args.view:
        yield None
        return
    from .. import viewer

    with viewer(args.port, server=True) as view:
        print(f"live view: {view.url}", flush=True)
        yield view


def wait_for_close(view: Viewer | None, fit: Fit | PoseFit | CameraFit | RigFit) -> None:
    """Show the result until the user closes the page, unless they ended the fit."""
    if view is not None and not fit.interrupted:
        view.show(fit)
        print(f"live view: {view.url} until Ctrl-C or Close", flush=True)
        view.wait()


def write_pose(folder: Path, fit: PoseFit) -> None:
    from ..files.paths import write_text

    write_text(folder / "pose.json", fit.to_json() + "\n")


def pose_lines(fit: PoseFit) -> list[str]:
    """Return the matrix, and how exactly it is known, as lines of text."""
    rows = ["  " + "  ".join(f"{value:12.6f}" for value in row) for row in fit.matrix.tolist()]
    known = [] if fit.uncertainty is None else [f"standard deviation: {fit.uncertainty.words}"]
    return ["mesh to world:", *rows, *known]


def finish(fit: Fit | CameraFit | RigFit, folder: Path, view: Viewer | None) -> int:
    """Print how a fit ended, save it, show it in the live view, and return the exit code. Raises OSError."""
    from . import INTERRUPTED
    from .arguments import CHECKPOINT

    print(f"loss {fit.loss:.3e} after {fit.steps} steps in {fit.seconds:.1f} s, {fit.reason}", flush=True)
    written = [*fit.save(folder, figures=can_draw()), CHECKPOINT]
    print(f"wrote {', '.join(written)} in {folder}", flush=True)
    wait_for_close(view, fit)
    return INTERRUPTED if fit.interrupted else 0


def can_draw() -> bool:
    """Return whether the libraries of figures are there; else say so."""
    from ..optional import require

    try:
        for module in ("matplotlib", "PIL"):
            require(module, "edgegrad[figures]", "drawing a fit")
    except ImportError as error:
        print(f"edgegrad: no pictures: {error}", file=sys.stderr)
        return False
    return True
