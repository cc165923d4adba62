"""Rows that need fresh processes: peak memory, the first render, the order of imports."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from .table import Bench, Row, median_row, median_time, ratio_row


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
    for name, found in (("cube at 64²", cubes), ("sphere at 512²", spheres)):
        first, moved, same = ([run[key] for run in found] for key in ("first", "moved", "same"))
        note = f"{median_time(first)}; later {median_time(moved)}, where nothing moved {median_time(same)}"
        rows.append(ratio_row(f"first render of a process over a later one, {name}", first, moved, must=1.5, note=note))
    return rows


def fresh(*arguments: str) -> dict[str, float]:
    """Return what fresh.py measures in its own process."""
    command = [sys.executable, "-m", "benchmarks.fresh", *arguments]
    root = Path(__file__).parents[1]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=root)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
    return json.loads(done.stdout)


def order(bench: Bench) -> list[Row]:
    """Compare a step after importing torch first with one after importing edgegrad first, on a quiet and a busy machine."""
    rows = []
    for load in (0, 2):
        busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(load)]
        try:
            ours, theirs = bench.interleaved(4, lambda: fresh("steps", "edgegrad"), lambda: fresh("steps", "torch"))
        finally:
            for process in busy:
                process.kill()
        for key, name in (("median", "median"), ("slow", "90 % quantile")):
            first, second = ([run[key] for run in side] for side in (ours, theirs))
            what = f"a step, torch imported first over edgegrad first, {name}" + (", machine busy" if load else "")
            rows.append(ratio_row(what, second, first, note=f"{median_time(second)} over {median_time(first)}"))
    return rows
