"""How fast edgegrad is, and what it is compared with, against targets: one table.

Run:  python -m benchmarks.speed [--only NAME …] [--quick] [--out FILE.json]

A ratio is taken in one run: its two sides alternate, so that a noisy machine slows both, and what is printed is the median
over the pairs and their quartiles. "At equal error" is the error of the per-vertex gradient relative to the whole gradient,
root mean square over seeds, against a converged run; each side's samples are swept and its time is interpolated. There the
quartiles are those of a bootstrap over the pairs, so that they hold the chance in the errors as well.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tqdm import tqdm

from . import mitsuba
from .bounces import bounced_gradients, bounces
from .costs import aovs, backward, bits, forward, large, lenses, small, sparse, textures, threads, update
from .defaults import deep, flat_colors, noise, tangled
from .document import machine
from .equal_error import boundary, interior, step
from .glossy import glossy
from .glossy_gradients import glossy_gradients
from .light import light
from .material_grid import material_grid
from .processes import busy, memory, start
from .table import HEAD, Bench, Row, Skipped, line

ROWS: dict[str, Callable[[Bench], list[Row]]] = {
    "forward": forward,
    "backward": backward,
    "update": update,
    "step": step,
    "interior": interior,
    "boundary": boundary,
    "cube": small,
    "large": large,
    "threads": threads,
    "memory": memory,
    "start": start,
    "busy": busy,
    "bits": bits,
    "textures": textures,
    "aovs": aovs,
    "sparse": sparse,
    "lenses": lenses,
    "deep": deep,
    "tangled": tangled,
    "flat-colors": flat_colors,
    "noise": noise,
    "light": light,
    "bounces": bounces,
    "bounced gradients": bounced_gradients,
    "glossy": glossy,
    "glossy gradients": glossy_gradients,
    "materials": material_grid,
}
# What is slow or wrong in the scenes of others first: rows that a change of the default samples is measured by.
GROUPS = {"safe": ("deep", "tangled", "flat-colors", "noise")}


def settings(quick: bool) -> dict[str, Any]:
    """Return when, where and of which versions this was measured."""
    return {
        "date": time.strftime("%Y-%m-%d %H:%M:%S"), "quick": quick, "load": os.getloadavg()[0],
        "mitsuba": mitsuba.available(), **machine(),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = [*ROWS, *GROUPS]
    parser.add_argument("--only", nargs="+", choices=known, metavar="NAME", help=f"some of {', '.join(known)}")
    parser.add_argument("--quick", action="store_true", help="few repeats")
    parser.add_argument(
        "--limit", type=float, default=10.0, metavar="SECONDS", help="most that a gradient may take (10)"
    )
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="the table, with notes and where it was measured")
    args = parser.parse_args()
    rows: list[Row] = []
    skipped: dict[str, str] = {}
    only = [name for given in args.only or ROWS for name in GROUPS.get(given, (given,))]
    names = [name for name in ROWS if name in only]
    tqdm.write(line(HEAD))
    with tqdm(total=len(names), unit="row", dynamic_ncols=True, disable=None) as bar:
        bench = Bench(args.quick, args.limit, bar)
        for name in names:
            bar.set_description(name)
            try:
                found = ROWS[name](bench)
            except Skipped as reason:
                skipped[name] = str(reason)
                tqdm.write(f"{name}: skipped; {reason}")
                found = []
            for row in found:
                rows.append(row)
                tqdm.write(line(row.cells()) + (f"\n    {row.note}" if row.note else ""))
            bar.update()
            if args.out is not None:  # after each row, so that Ctrl-C loses none
                document = {"settings": settings(args.quick), "rows": [asdict(r) for r in rows], "skipped": skipped}
                args.out.parent.mkdir(parents=True, exist_ok=True)
                args.out.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
