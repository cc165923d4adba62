"""Trackers on films with known poses: how exact they are, how fast, and whether they know when they are lost.

    python -m benchmarks.track [--tracker edgegrad.fit:track] [--kinds textured hand …] [--first 1000] [--count 5] [--frames 100]
        [--jobs 1] [--threads 1] [--out FILE.jsonl] [--films DIR] [--pictures DIR] [--meshes FILE …] [--backgrounds FILE …]
        [--photos FOLDER]
    python -m benchmarks.track --make --kinds away --first 1000 --count 20 --jobs 2
    python -m benchmarks.track --summary FILE.jsonl … [--pictures DIR]
    python -m benchmarks.track --train FILE.jsonl … [--features NAME …]
    python -m benchmarks.track --calibration FILE.jsonl … [--figure reliability.png]

A kind and a seed make a film (drafts.py, films.py) of an object in motion, or of three. Seeds below 1000 are for tuning and
training, results are reported on those from 1000, which have other objects and photographs. Films are kept in DIR. Kinds that
need --photos are objects before real photographs, and two frames of a real film (photographs.py).

Trackers start up to 2° and 1 % of the object's size off. Errors are the angle and the distance of the object's centre as a share
of its size, the diagonal of its bounding box: medians and 90 % quantiles over frames in which at least a fifth of the object is
seen and that are not said to be lost. lost/%: how many are said to be. unsaid/%: frames more than 5° or 5 % off that are not
said to be lost, of all and (seen/%) of those in which the object is seen. right/%: frames that are right and said to be lost.
found/%: objects found within a second after half of them is back in the picture, and the median of frames until then. NEES/6:
mean of the normalised error squared over 6, 1 for a calibrated covariance. ECE: expected calibration error of the confidence that
a frame is right. frames/s, ms: medians of frames a second and of processor time a frame; compare them on a quiet machine with
--jobs 1. A run that is started again goes on behind what FILE.jsonl holds.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # Films are rendered by one thread each; --threads is for trackers.

from benchmarks.poses.objects import OBJECTS, Sources
from benchmarks.poses.runs import append, read
from benchmarks.poses.summary import calibration_error, draw_reliability

from . import pictures, runs, summary
from .drafts import KINDS, REAL
from .films import Length, cache_folder
from .measures import Record
from .trackers import GENERATOR


def line(record: Record) -> str:
    """Return a record in short."""
    head = f"{record['kind']:14s} {record['seed']:5d} {record['mesh']:12s}"
    if "error" in record:
        return f"{head} {record['error']}"
    f = summary.Figures.of([record])
    return (
        f"{head} {f.angle[0]:6.2f}° {f.angle[1]:6.2f}°  {f.shift[0]:6.2%} {f.shift[1]:6.2%}  lost {f.lost:4.0%}  "
        f"unsaid {f.unsaid:4.0%}  NEES/6 {f.nees:.2f}  {f.work:6.1f} ms"
    )


def main(argv: list[str] | None = None) -> int:
    given = _parser().parse_args(argv)
    if given.train:
        print(summary.training([one for one in read(given.train) if "error" not in one], given.features))
        return 0
    if given.calibration:
        found = summary.calibration(read(given.calibration))
        draw_reliability(found, given.figure)
        for one in found:
            print(f"{one.confidence:.3f}: {one.right:.3f} of {one.fits}")
        print(f"expected calibration error {calibration_error(found):.3f}")
        return 0
    sources = Sources(tuple(given.meshes), tuple(given.backgrounds))
    place = runs.Place(sources, Length(given.frames), given.films, given.photos)
    if given.summary:
        records = read(given.summary)
        print(summary.table(records))
        _draw(records, place, given.pictures)
        return 0
    kinds = given.kinds or (KINDS if given.photos is None else REAL)
    if given.photos is None and (real := [name for name in kinds if name in REAL]):
        raise ValueError(f"--kinds {real[0]}: expected the folder of its photograph, got none; give --photos FOLDER")
    seeds = range(given.first, given.first + given.count) if given.seed is None else [given.seed]
    tracker = "" if given.make else given.tracker
    jobs = [runs.Job(kind, seed, place, tracker) for kind in kinds for seed in seeds]
    records = [] if given.out is None else read([given.out])
    wanted, done = {job.key for job in jobs}, {(one["kind"], one["seed"]) for one in records}
    records = [one for one in records if (one["kind"], one["seed"]) in wanted]
    try:
        for found in runs.run([job for job in jobs if job.key not in done], given.jobs, given.threads):
            append(given.out, found)
            records += found
            print("\n".join(map(line, found)), flush=True)
            _draw(found, place, given.pictures)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
    if records:
        print(summary.table(records))
    return 0


def _draw(records: list[Record], place: runs.Place, folder: Path | None) -> None:
    for record in records:
        if folder is not None and "error" not in record:
            pictures.draw(folder, place.film(record["kind"], record["seed"]), record)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "python -m benchmarks.track", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--tracker", default=GENERATOR, metavar="MODULE:NAME", help=f"a class or a generator ({GENERATOR})")
    add("--kinds", "--kind", nargs="+", choices=[*KINDS, *REAL], metavar="KIND", help=", ".join([*KINDS, *REAL]))
    add("--first", type=int, default=1000, metavar="N", help="first seed (1000)")
    add("--count", type=int, default=5, metavar="N", help="number of seeds of each kind (5)")
    add("--seed", type=int, metavar="N", help="this one alone")
    add("--frames", type=int, default=100, metavar="N", help="frames of a film (100)")
    add("--jobs", type=int, default=1, metavar="N", help="processes (1)")
    add("--threads", type=int, default=1, metavar="N", help="of each process (1)")
    add("--out", type=Path, metavar="FILE.jsonl", help="a line for each object; films that it holds are not run again")
    add("--films", type=Path, default=cache_folder(), metavar="DIR", help=f"where films are kept ({cache_folder()})")
    add("--make", action="store_true", help="make the films alone")
    add("--meshes", nargs="+", default=(), metavar="FILE", help=f"FILE,TEXTURE, or {', '.join(OBJECTS)}")
    add("--backgrounds", nargs="+", default=(), metavar="FILE", help="photographs; by default of packages")
    add("--photos", type=Path, metavar="FOLDER", help=f"real photographs, for {', '.join(REAL)}")
    add("--pictures", type=Path, metavar="DIR", help="contours of truth and answer in the worst frame of each film")
    add("--summary", nargs="+", type=Path, metavar="FILE.jsonl", help="the table of these files alone")
    add("--train", nargs="+", type=Path, metavar="FILE.jsonl", help="print the coefficients of the confidence")
    add("--features", nargs="+", default=(), metavar="NAME", help="of --train (all)")
    add("--calibration", nargs="+", type=Path, metavar="FILE.jsonl", help="whether the confidence is right")
    add("--figure", type=Path, default=Path("out/track-reliability.png"), metavar="FILE", help="of --calibration")
    return parser


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except (OSError, ValueError, ImportError) as wrong:
        raise SystemExit(f"python -m benchmarks.track: error: {wrong}") from None
