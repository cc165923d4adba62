"""edgegrad demo."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .arguments import count, number
from .outputs import can_draw, make_folder

if TYPE_CHECKING:
    from ..demo import Run


def add(commands: Any) -> None:
    parser = commands.add_parser("demo", help="find an airliner above the Earth", description=run.__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR", help="(%(default)s)")
    parser.add_argument("--runs", type=count, default=10, help="targets and starts to try (%(default)s)")
    parser.add_argument("--seed", type=number, default=0)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Find an airliner in pictures that are rendered at known poses, from starts up to 20° and 15 % of its size away."""
    from .. import demo  # imports pyvista when it runs
    from . import INTERRUPTED

    mesh, background = demo.airliner(), demo.earth()
    make_folder(args.out)
    print("Finding an airliner in a picture, from wrong poses. Errors in degrees and in percent of its size:\n")
    print("  run     start             fit               seconds")
    runs: list[Run] = []
    for k in range(args.runs):
        runs.append(run := demo.run(mesh, background, args.seed + k))
        start, end = (f"{e.degrees:6.2f}°  {e.percent:6.2f} %" for e in (run.start, run.end))
        print(f"  {k + 1:3d}  {start}  {end}  {run.fit.seconds:7.1f}", flush=True)
        if run.fit.interrupted:
            break
        if k == 0:
            run.fit.save(args.out, figures=can_draw())
    good = sum(run.end.degrees <= demo.FOUND_WITHIN and run.end.percent <= demo.FOUND_WITHIN for run in runs)
    print(
        f"\n{good} of {len(runs)} within {demo.FOUND_WITHIN}° and {demo.FOUND_WITHIN} %; pictures of the first in {args.out}"
    )
    return INTERRUPTED if runs[-1].fit.interrupted else 0
