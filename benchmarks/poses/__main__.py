"""Pose fits in photographs, made or real: how often they find the pose, how exactly, and whether they know.

    python -m benchmarks.poses [--kinds lit covered …] [--first 1000] [--count 50] [--jobs 2] [--out FILE.jsonl]
        [--meshes FILE …] [--backgrounds FILE …] [--photos FOLDER] [--pictures DIR]
    python -m benchmarks.poses --kinds lit --seed 1003
    python -m benchmarks.poses --summary FILE.jsonl … [--pictures DIR]
    python -m benchmarks.poses --train FILE.jsonl …
    python -m benchmarks.poses --calibration FILE.jsonl … [--figure reliability.png]
    python -m benchmarks.poses --sensitivity [--kinds lit] [--count 10]

A kind and a seed make a case (cases.py): object, light, photograph behind it, what covers it, blur, noise, compression, camera
and start. Seeds below 1000 are for tuning and training, results are reported on those from 1000, which have other objects and
photographs. Objects are made here, or are --meshes: FILE, FILE,TEXTURE or names of those made here; the first one is that of the
kinds easy15 and easy30. Kinds that need --photos are fits of real photographs (photographs.py).

Errors are the angle and the distance of the object's centre as a share of its size, the diagonal of its bounding box. A fit is
right within the limits of its kind (kinds.py), sure where its confidence is at least 0.95, or where it has converged if it
gives none, and then wrong beyond 2° or 2 %. Columns have medians, 90 % quantiles of both errors, and seconds of processor time.
Brackets hold 95 % intervals by Wilson. A run that is started again goes on behind what FILE.jsonl holds.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # Each process fits with one thread.

from . import runs, sensitivity, summary
from .kinds import KINDS, MADE, REAL, cases
from .objects import OBJECTS, Sources
from .runs import Job, Record


def line(record: Record) -> str:
    """Return a record in short."""
    head = f"{record['kind']:13s} {record['seed']:5d} {record['mesh']:18s}"
    if "error" in record:
        return f"{head} {record['error']}"
    verdict = (
        "" if record["right"] else "WRONG, sure" if summary.sure(record) and not summary.known(record) else "wrong"
    )
    return (
        f"{head} {record['start_degrees']:5.1f}° {record['start_shift']:5.1%} → {record['degrees']:6.2f}° "
        f"{record['shift']:6.2%}  explained {record['explained']:.2f} ±{record['sigma_degrees']:.2f}°  "
        f"{record['steps']:3d} steps {record['work']:5.1f} s  {verdict:11s} {record['reason'][:70]}"
    )


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        "python -m benchmarks.poses", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kinds", "--kind", nargs="+", choices=list(KINDS), metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--first", type=int, default=1000, metavar="N", help="first seed (1000)")
    parser.add_argument("--count", type=int, default=20, metavar="N", help="number of seeds of each kind (20)")
    parser.add_argument("--seed", type=int, metavar="N", help="this one alone")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes, of one thread each (1)")
    parser.add_argument(
        "--out", type=Path, metavar="FILE.jsonl", help="a line for each fit; what it holds is not run again"
    )
    parser.add_argument(
        "--meshes", nargs="+", default=(), metavar="FILE", help=f"FILE,TEXTURE, or {', '.join(OBJECTS)}"
    )
    parser.add_argument(
        "--backgrounds", nargs="+", default=(), metavar="FILE", help="photographs; by default of packages"
    )
    parser.add_argument("--photos", type=Path, metavar="FOLDER", help=f"real photographs, for {', '.join(REAL)}")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="contours of start, truth and end of wrong fits")
    parser.add_argument(
        "--train", nargs="+", type=Path, metavar="FILE.jsonl", help="print the coefficients of confidence"
    )
    parser.add_argument("--summary", nargs="+", type=Path, metavar="FILE.jsonl", help="the table of these files alone")
    parser.add_argument("--calibration", nargs="+", type=Path, metavar="FILE.jsonl", help="whether confidence is right")
    parser.add_argument(
        "--figure", type=Path, default=Path("out/reliability.png"), metavar="FILE", help="of --calibration"
    )
    parser.add_argument(
        "--sensitivity", action="store_true", help="results at half and twice each number of the settings"
    )
    given = parser.parse_args(argv)
    sources = Sources(tuple(given.meshes), tuple(given.backgrounds))
    if given.train:
        print(summary.training([one for one in runs.read(given.train) if one.get("features")]))
        return 0
    if given.calibration:
        found = summary.bins(summary.said(runs.read(given.calibration)))
        summary.draw_reliability(found, given.figure)
        for one in found:
            print(f"{one.confidence:.3f}: {one.right:.3f} of {one.fits}")
        print(f"expected calibration error {summary.calibration_error(found):.3f}")
        return 0
    if given.summary:
        records = summary.compared(runs.read(given.summary), sources, given.photos)
        print(summary.table(records))
        for one in records if given.pictures else ():
            if not one["right"] and "matrix" in one:
                case = cases(one["kind"], one["seed"], sources, given.photos)[one["object"]]
                runs.draw(given.pictures, case, one)
        return 0
    kinds = given.kinds or (MADE if given.photos is None else REAL)
    if given.photos is None and (real := [name for name in kinds if name in REAL]):
        parser.error(f"--kinds {real[0]}: expected the folder of its photograph, got none; give --photos FOLDER")
    seeds = range(given.first, given.first + given.count) if given.seed is None else [given.seed]
    jobs = [Job(kind, seed, sources, given.photos, given.pictures) for kind in kinds for seed in seeds]
    if given.sensitivity:
        sensitivity.print_table(jobs, given.jobs)
        return 0
    records = [] if given.out is None else runs.read([given.out])
    wanted, done = {job.key for job in jobs}, {(one["kind"], one["seed"]) for one in records}
    records = [one for one in records if (one["kind"], one["seed"]) in wanted]
    try:
        for found in runs.run([job for job in jobs if job.key not in done], given.jobs):
            runs.append(given.out, found)
            records += found
            print("\n".join(map(line, found)), flush=True)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
    if records:
        print(summary.table(summary.compared(records, sources, given.photos)))
    return 0


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except (OSError, ValueError, ImportError) as wrong:
        raise SystemExit(f"python -m benchmarks.poses: error: {wrong}") from None
