"""Measures the error of image and gradient in extreme cases against independent references: scale, cameras, geometry, what
coincides, stiff scenes; whether the gradient is unbiased, steps within faces, and ill-conditioned fits. Ctrl-C keeps what is
measured. The exit code is 1 if a case is wrong."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from ..command import run
from ..document import Document
from .run import failures, stability


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser("python -m benchmarks.stability", description=__doc__)
    add = parser.add_argument
    add(
        "--case", nargs="+", dest="cases", metavar="NAME",
        help="cases or groups of them, statistics, steps, fits (all); a wrong name lists all",
    )  # fmt: skip
    add("--quick", action="store_true", help="fewer seeds, to try it out")
    add(
        "--out", type=Path, default=Path("out/stability"), metavar="DIR",
        help="for stability.json, .md, .png, stability-steps.png and stability-fits.png (%(default)s)",
    )  # fmt: skip
    return run(parser, stability, _end, argv)


def _end(document: Document) -> int:
    if document["cases"] or document["sections"]:
        print("wrote stability.json, stability.md and pictures")
    if failed := failures(document):
        print(f"{len(failed)} not right: {', '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
