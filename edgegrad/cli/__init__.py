"""The command line. Each command imports what it uses when it runs, for torch takes seconds to import: help and errors of
arguments do without it."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from . import bop, demo, doctor, fit_camera, fit_pose, fit_poses, fit_rig, fit_shape, fit_texture, render, track
from .arguments import Parser

INTERRUPTED = 130  # exit code of shells after Ctrl-C


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; return 0, 2 after an error, or 130 after Ctrl-C."""
    try:
        args = parser().parse(argv)
        with _ended_by_ctrl_c():
            from .. import render  # noqa: F401  with torch and the kernel, which each command uses
        return args.run(args)
    except KeyboardInterrupt:
        print("edgegrad: interrupted", file=sys.stderr)
        return INTERRUPTED
    except (OSError, ValueError, TypeError, ImportError, MemoryError) as error:
        print(f"edgegrad: error: {_one_line(error)}", file=sys.stderr)
        return 2


@contextmanager
def _ended_by_ctrl_c() -> Iterator[None]:
    """End the process at once at Ctrl-C. Raised as an exception while modules are imported, it might be lost in code that lets
    none out."""
    usual = signal.getsignal(signal.SIGINT)
    if usual is not signal.default_int_handler or threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(*_: object) -> None:
        os.write(sys.stderr.fileno(), b"edgegrad: interrupted\n")
        os._exit(INTERRUPTED)

    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


def parser() -> Parser:
    """Return the parser of all commands."""
    found = Parser(prog="edgegrad", description="Differentiable rendering of triangle meshes on the CPU.")
    found.add_argument("--version", action=doctor.Version, nargs=0, help="show the version and exit")
    commands = found.add_subparsers(dest="command", required=True, metavar="COMMAND")
    fits = fit_pose, fit_poses, fit_shape, fit_rig, fit_texture, fit_camera
    for module in (*fits, track, render, bop, demo, doctor):
        module.add(commands)
    return found
