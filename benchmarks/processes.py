"""Rows that need fresh processes: peak memory, the first render, how threads wait."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import partial
from itertools import product
from pathlib import Path

from .table import Bench, Row, median_row, median_time, ratio_row

# It ends with the process that started it, also where that is killed.
BUSY = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"


def memory(bench: Bench) -> list[Row]:
    peaks = [fresh("memory")["bytes"] / 1e6 for _ in range(1 if bench.quick else 2)]
    what = "peak memory above scene and images, 1920 × 1080 × 64 spp"
    return [median_row(what, peaks, unit=" MB", must=150, aim=50)]


def start(bench: Bench) -> list[Row]:
    n = bench.repeats(5)
    imports, cubes, spheres = [], [], []
    for turn in range(n):
        bench.bar.set_postfix_str(f"{turn} of {n}")
        imports.append(fresh("import")["seconds"])
        cubes.append(fresh("first", "cube"))
        spheres.append(fresh("first", "sphere"))
    rows = [median_row("import edgegrad, after torch", imports, unit=" s", must=0.3, aim=0.1)]
    # The first call of the kernel starts the threads, 1 to 2 ms: as long as a cube takes.
    for name, found, must in (("cube at 64²", cubes, None), ("sphere at 512²", spheres, 1.5)):
        first, moved, same = ([run[key] for run in found] for key in ("first", "moved", "same"))
        note = f"{median_time(first)}; later {median_time(moved)}, where nothing moved {median_time(same)}"
        rows.append(
            ratio_row(f"first render of a process over a later one, {name}", first, moved, must=must, note=note)
        )
    return rows


def fresh(*arguments: str, wait_policy: str | None = None) -> dict[str, float]:
    """Return what fresh.py measures in its own process, whose OpenMP threads wait in the given way."""
    command = [sys.executable, "-m", "benchmarks.fresh", *arguments]
    root = Path(__file__).parents[1]
    environment = os.environ | ({"OMP_WAIT_POLICY": wait_policy} if wait_policy else {})
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=root, env=environment)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
    return json.loads(done.stdout)


def busy(bench: Bench) -> list[Row]:
    """Compare OpenMP threads that sleep while they wait with those that spin first, on a quiet and a busy machine."""
    rows = []
    for load, name in product((0, 2), ("cube", "sphere")):
        others = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(load)]
        passive, default = (partial(fresh, "steps", name, wait_policy=policy) for policy in ("passive", None))
        try:
            sides = bench.interleaved(4, passive, default)
        finally:
            for process in others:
                process.kill()
        sleep, spin = ([run["median"] for run in side] for side in sides)
        what = f"a step, {name}, OMP_WAIT_POLICY=passive over default" + (", machine busy" if load else "")
        rows.append(ratio_row(what, sleep, spin, note=f"{median_time(sleep)} over {median_time(spin)}"))
    return rows
