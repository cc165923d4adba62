"""Measures the relative error of the gradient against wall time, for a sweep of samples: edgegrad, finite differences, and
every other renderer that is installed. The error is that of the gradient per vertex, and of translation and rotation of the
whole object. Ctrl-C keeps what is measured; the same command goes on from there."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from ..command import run
from ..document import Document
from ..scenes import SCENES
from .methods import METHODS
from .run import error_time


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser("python -m benchmarks.error_time", description=__doc__)
    add = parser.add_argument
    add("--scene", nargs="+", dest="scenes", metavar="NAME", help=f"{', '.join(SCENES)} (all)")
    add("--methods", nargs="+", metavar="NAME", help=f"{', '.join(METHODS)} (all)")
    add("--mesh", type=Path, metavar="PATH", help="what the scene scan shows; else the demo's airliner")
    add("--size", type=int, default=256, help="pixels on a side of the image (%(default)s)")
    add("--seeds", type=int, default=5, help="gradients a point (%(default)s)")
    add("--limit", type=float, default=10.0, metavar="SECONDS", help="most that a gradient may take (%(default)g)")
    add("--quick", action="store_true", help="few points and a rough reference, to try it out")
    add(
        "--out", type=Path, default=Path("out/error-time"), metavar="DIR",
        help="for error-time.png, .md, .json and references; a later run goes on from what is there (%(default)s)",
    )  # fmt: skip
    return run(parser, error_time, _end, argv)


def _end(document: Document) -> int:
    if document["points"]:
        print("wrote error-time.json, error-time.md, error-time.png")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
