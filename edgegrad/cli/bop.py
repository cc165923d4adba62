"""edgegrad bop."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .arguments import add_steps, count, millimetres, number
from .outputs import make_folder

if TYPE_CHECKING:
    from ..bop.files import Estimate
    from ..bop.refine import Refined


def add(commands: Any) -> None:
    bop = commands.add_parser(
        "bop", help="errors of poses, and better poses, on a data set of the BOP benchmark",
        description="Errors of poses, and better poses, on a data set of the BOP benchmark. Lengths are in mm.",
    )  # fmt: skip
    kinds = bop.add_subparsers(dest="bop", required=True, metavar="WHAT")

    errors = kinds.add_parser("errors", help="recalls and errors of a result file", description=_errors.__doc__)
    _add_files(errors)
    errors.add_argument(
        "--targets", metavar="NAME", help="file in DATASET that lists what is to be found (test_targets_bop19.json)"
    )
    errors.add_argument(
        "--no-vsd", action="store_true", help="leave out VSD, which takes most of the time and needs depth"
    )
    errors.add_argument(
        "--delta", type=millimetres, default=15.0, metavar="MM", help="of VSD (%(default)g); BOP takes 5 for ITODD"
    )
    errors.add_argument("-o", "--out", type=Path, metavar="FILE.json", help="recalls, and the errors of each estimate")
    errors.set_defaults(run=_errors)

    better = kinds.add_parser("refine", help="fit each pose of a result file to its image", description=_refine.__doc__)
    _add_files(better)
    better.add_argument(
        "-o", "--out", type=Path, required=True, metavar="OUT.csv", help="the result file that is written"
    )
    better.add_argument("--limit", type=count, metavar="N", help="only the first N rows")
    better.add_argument("--resume", action="store_true", help="go on after the rows that OUT.csv has")
    better.add_argument(
        "--unconverged", action="store_true", help="take poses also of fits that did not converge, not only of those that did"
    )  # fmt: skip
    better.add_argument(
        "--pictures", type=Path, metavar="DIR", help="for a picture a row: target, start, fit and difference"
    )
    better.add_argument("--size", type=count, default=256, help="most pixels of the part of the image (%(default)s)")
    add_steps(better)
    better.add_argument("--seed", type=number, default=0)
    better.set_defaults(run=_refine)


def _add_files(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "dataset", type=Path, metavar="DATASET", help="its folder, with models/ and a folder for each split"
    )
    parser.add_argument("results", type=Path, metavar="RESULTS.csv", help="scene_id,im_id,obj_id,score,R,t,time")
    parser.add_argument("--split", help="test, val, train_pbr … (test, or the only one there is)")
    parser.add_argument(
        "--models", metavar="NAME", help="folder of meshes: models_cad, models_reconst … (models, or the only one)"
    )


def _errors(args: argparse.Namespace) -> int:
    """Print recalls as BOP19 defines them (AR of VSD, MSSD and MSPD), recalls of ADD(-S) below 10 % of the diameter, and median
    errors, by object and of all."""
    from ..bop import Dataset, evaluate
    from ..bop.files import read_results
    from ..files.paths import check_suffix, write_text

    if args.out is not None:
        check_suffix(args.out, (".json",))  # an error must not come after the work
    estimates, dataset = read_results(args.results), Dataset(args.dataset, args.split, args.models)
    targets = None if args.targets is None else dataset.targets(args.targets)
    found = evaluate(dataset, estimates, targets, with_vsd=not args.no_vsd, delta=args.delta)
    print(found.table(), flush=True)
    if found.ignored:
        print(f"{found.ignored} estimates belong to no target, or exceed the number of its instances")
    if args.out is not None:
        write_text(args.out, found.to_json() + "\n")
        print(f"wrote {args.out}")
    return 0


def _refine(args: argparse.Namespace) -> int:
    """Fit the mesh of each row to the colour image around its pose, and write the rows with the poses found. A row whose fit
    does not converge keeps its pose. The file is written after each row, and --resume goes on from there. The time of an image
    grows by that of all its rows."""
    from tqdm import tqdm

    from ..bop import Dataset, refine
    from ..bop.files import read_results, write_results
    from ..files.paths import check_suffix
    from ..fit import FitOptions
    from . import INTERRUPTED

    check_suffix(args.out, (".csv",))
    given = read_results(args.results)[: args.limit]
    dataset = Dataset(args.dataset, args.split, args.models)
    done = _done(args, given)
    if args.pictures is not None:
        from ..optional import DRAWING, require

        require("matplotlib", *DRAWING)
        make_folder(args.pictures)
    spent = {(row.scene_id, row.im_id): row.seconds - max(0.0, before.seconds) for row, before in zip(done, given)}  # noqa: B905
    options = FitOptions(max_size=args.size, steps=args.steps, seed=args.seed, progress=False)
    kept = 0
    interrupted = False
    with tqdm(total=len(given), initial=len(done), desc="refine", unit="row", leave=False) as bar:
        for row in given[len(done) :]:
            try:
                found = refine(dataset, row, unconverged=args.unconverged, options=options)
            except KeyboardInterrupt:
                interrupted = True
                break
            if found.fit is not None and found.fit.interrupted:
                interrupted = True
                break
            kept += found.kept
            image = row.scene_id, row.im_id
            spent[image] = max(0.0, spent.get(image, 0.0)) + found.seconds
            done.append(found.estimate)
            write_results(args.out, _timed(done, given, spent))
            if args.pictures is not None:
                _draw(args.pictures, len(done), found)
            tqdm.write(_line(found), file=sys.stdout)
            bar.update()
    print(
        f"{len(done)} of {len(given)} rows in {args.out}"
        + (f"; {kept} of those refined now kept their pose" if kept else "")
    )
    if interrupted:
        print("edgegrad: interrupted; the same command with --resume goes on from there", file=sys.stderr)
    return INTERRUPTED if interrupted else 0


def _done(args: argparse.Namespace, given: Sequence[Estimate]) -> list[Estimate]:
    """Return the rows of an earlier run. Raises ValueError."""
    from ..bop.files import read_results

    if args.out.exists() and args.results.exists() and args.out.samefile(args.results):
        raise ValueError(f"--out: expected another file than {args.results}, got the same; its poses would be lost")
    if not args.out.exists():
        return []
    if not args.resume:
        raise ValueError(
            f"--out: expected a new file, got {args.out}, which is there; go on from it by --resume, or choose another name"
        )
    done = read_results(args.out)
    for i, (ours, theirs) in enumerate(zip(done, given)):  # noqa: B905  either may be shorter
        if _key(ours) != _key(theirs):
            raise ValueError(
                f"--resume: expected {args.out} to begin with the rows of {args.results}, got another scene, image, object or "
                f"score in row {i + 1}; choose another name"
            )
    if len(done) > len(given):
        raise ValueError(
            f"--resume: expected at most {len(given)} rows in {args.out}, got {len(done)}; give a higher --limit, or none"
        )
    return done


def _key(row: Estimate) -> tuple[int, int, int, float]:
    return row.scene_id, row.im_id, row.obj_id, row.score


def _timed(done: Sequence[Estimate], given: Sequence[Estimate], spent: dict[tuple[int, int], float]) -> list[Estimate]:
    """Give all rows of an image one time, as BOP wants; an unknown time stays unknown."""
    return [
        replace(row, seconds=before.seconds + (spent[row.scene_id, row.im_id] if before.seconds >= 0.0 else 0.0))
        for row, before in zip(done, given)  # noqa: B905  the rest is to come
    ]


def _draw(folder: Path, number: int, found: Refined) -> None:
    """Draw a fit that took a step."""
    from ..files.paths import write_figures

    if found.fit is not None and found.fit.history:
        row = found.estimate
        name = f"{number:06d}_scene{row.scene_id:06d}_image{row.im_id:06d}_object{row.obj_id:06d}.png"
        write_figures(folder, {name: found.fit.plot})


def _line(found: Refined) -> str:
    row = found.estimate
    what = f"pose kept, {found.why}" if found.kept else f"turned {found.degrees:.2f}°, moved {found.distance:.2f} mm"
    return f"scene {row.scene_id}, image {row.im_id}, object {row.obj_id}: {what} ({found.seconds:.1f} s)"
