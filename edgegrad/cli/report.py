"""edgegrad report."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from .arguments import count, seconds
from .outputs import make_folder


def add(commands: Any) -> None:
    report = commands.add_parser("report", help="measure the gradient", description="Measures the gradient.")
    kinds = report.add_subparsers(dest="report", required=True, metavar="REPORT")

    curve = kinds.add_parser("error-time", help="its error against the time it takes", description=_error_time.__doc__)
    curve.add_argument(
        "--scene",
        nargs="+",
        metavar="NAME",
        help="triangle, sphere, tangled, flat-colors, noise, slivers, globe, quad, scan, million, lit-point, lit-area, lit-sky, "
        "bounce-lamp, bounce-up (all)",
    )
    curve.add_argument(
        "--methods", nargs="+", metavar="NAME",
        help="edgegrad, interior, boundary, finite-differences, direct_projective, prb_projective (all)",
    )  # fmt: skip
    curve.add_argument("--mesh", type=Path, metavar="PATH", help="what the scene scan shows; else the demo's airliner")
    curve.add_argument("--size", type=count, default=256, help="pixels on a side of the image (%(default)s)")
    curve.add_argument("--seeds", type=count, default=5, help="gradients a point (%(default)s)")
    curve.add_argument(
        "--limit", type=seconds, default=10.0, metavar="SECONDS", help="most that a gradient may take (%(default)g)"
    )
    curve.add_argument("--quick", action="store_true", help="few points and a rough reference, to try it out")
    curve.add_argument(
        "--out", type=Path, default=Path("out/error-time"), metavar="DIR",
        help="for error-time.png, .md, .json and references; a later run goes on from what is there (%(default)s)",
    )  # fmt: skip
    curve.set_defaults(run=_error_time)

    extreme = kinds.add_parser("stability", help="its error in extreme cases", description=_stability.__doc__)
    extreme.add_argument(
        "--case",
        nargs="+",
        metavar="NAME",
        help="cases or groups of them, statistics, steps, fits (all); a wrong name lists all",
    )
    extreme.add_argument("--quick", action="store_true", help="fewer seeds, to try it out")
    extreme.add_argument(
        "--out", type=Path, default=Path("out/stability"), metavar="DIR",
        help="for stability.json, .md, .png, stability-steps.png and stability-fits.png (%(default)s)",
    )  # fmt: skip
    extreme.set_defaults(run=_stability)


def _error_time(args: argparse.Namespace) -> int:
    """Relative error of the gradient (per vertex, and of whole-object translation and rotation) against wall time, for a sweep
    of samples: edgegrad, finite differences, and every other renderer that is installed. Ctrl-C keeps what is measured; the
    same command goes on from there."""
    from ..optional import require
    from ..report.error_time.run import error_time
    from . import INTERRUPTED

    require("matplotlib", "edgegrad[report]", "edgegrad report")  # before the measurements rather than after them
    make_folder(args.out)
    document, interrupted = error_time(
        args.out, args.scene, args.methods,
        size=args.size, seeds=args.seeds, limit=args.limit, quick=args.quick, mesh=args.mesh,
    )  # fmt: skip
    if document["points"]:
        print(f"wrote error-time.json, error-time.md, error-time.png in {args.out}")
    if interrupted:
        print(f"edgegrad: interrupted; the same command goes on from what is kept in {args.out}", file=sys.stderr)
    return INTERRUPTED if interrupted else 0


def _stability(args: argparse.Namespace) -> int:
    """Error of image and gradient in extreme cases against independent references: scale, cameras, geometry, what coincides,
    stiff scenes; whether the gradient is unbiased, steps within faces, and ill-conditioned fits. Ctrl-C keeps what is measured.
    The exit code is 1 if a case is wrong."""
    from ..optional import require
    from ..report.stability.run import failures, stability
    from . import INTERRUPTED

    require("matplotlib", "edgegrad[report]", "edgegrad report")  # before the measurements rather than after them
    make_folder(args.out)
    document, interrupted = stability(args.out, args.case, quick=args.quick)
    if document["cases"] or document["sections"]:
        print(f"wrote stability.json, stability.md and pictures in {args.out}")
    if failed := failures(document):
        print(f"{len(failed)} not right: {', '.join(failed)}")
    return INTERRUPTED if interrupted else 1 if failed else 0
