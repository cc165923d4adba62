"""Tables of trackers on films, and the training of their confidence."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.poses.logistic import left_out, trained
from benchmarks.poses.summary import SURE, Bin, bins, calibration_error

from .drafts import KINDS, REAL
from .measures import Record, followed, lost, recoveries, right, seen

HEAD = (
    "kind", "films", "frames", "angle", "90 %", "shift/%", "90 %", "lost/%", "unsaid/%", "seen/%", "right/%", "found/%", "after",
    "NEES/6", "ECE", "frames/s", "ms",
)  # fmt: skip
WIDTHS = (20, 5, 6, 6, 6, 7, 6, 6, 8, 6, 7, 10, 5, 6, 5, 8, 6)
STEADY = ("textured", "hand", "block", "bolt")
FACES = 2_000, 20_000  # of meshes for which the frames a second are asked


@dataclass(frozen=True)
class Figures:
    """Figures of records of one kind, or of several; NaN where there is nothing to tell.

    Attributes
    ----------
    angle, shift : median and 90 % quantile of degrees, and of shares of the size, where objects are seen and not said to be lost
    lost : share of frames with objects that are seen which are said to be lost
    unsaid : share of all frames that are off and not said to be lost
    unsaid_seen : the same of frames with objects that are seen
    lost_right : share of frames with objects that are seen which are right and said to be lost
    found : share of objects found within a second of their return; `returns`: how many returned; `after`: median in frames
    nees : mean normalised error squared over 6 where objects are seen and not said to be lost
    calibration : expected calibration error of the confidence
    rate : frames a second, median; `work`: milliseconds of processor time a frame, median
    """

    films: int
    frames: int
    angle: tuple[float, float]
    shift: tuple[float, float]
    lost: float
    unsaid: float
    unsaid_seen: float
    lost_right: float
    found: float
    returns: int
    after: float
    nees: float
    calibration: float
    rate: float
    work: float

    @staticmethod
    def of(records: Sequence[Record]) -> Figures:
        degrees, shift = (_where(records, name, followed) for name in ("degrees", "shift"))
        off = np.concatenate([~right(one) & ~lost(one) for one in records])
        there = np.concatenate([seen(one) for one in records])
        gone, good = (np.concatenate([part(one) for one in records]) for part in (lost, right))
        returned = [after for one in records for after in recoveries(one)]
        within = [after for after in returned if after is not None]
        errors, said = _where(records, "nees", followed), pairs(records)
        # The time of a film is that of all its objects.
        first = [one for one in records if one["object"] == 0] or records[:1]
        seconds, work = (np.concatenate([one[name] for one in first]) for name in ("seconds", "work"))
        return Figures(
            len(first), len(off), _quantiles(degrees), _quantiles(shift), _mean(gone[there]), _mean(off), _mean(off[there]),
            _mean((gone & good)[there]), len(within) / len(returned) if returned else math.nan, len(returned),
            float(np.median(within)) if within else math.nan, _mean(errors[np.isfinite(errors)]),
            calibration_error(bins(said)) if said else math.nan, 1.0 / max(float(np.median(seconds)), 1e-9),
            1e3 * float(np.median(work)),
        )  # fmt: skip


def _where(records: Iterable[Record], name: str, which: Callable[[Record], np.ndarray]) -> np.ndarray:
    return np.concatenate([np.array(one[name], dtype=float)[which(one)] for one in records])


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else math.nan


def _quantiles(values: np.ndarray) -> tuple[float, float]:
    return (float(np.median(values)), float(np.quantile(values, 0.9))) if len(values) else (math.nan, math.nan)


def pairs(records: Iterable[Record]) -> list[tuple[float, bool]]:
    """Return the confidence of each frame that has one, and whether it is right."""
    return [
        (p, bool(good))
        for one in records
        for p, good in zip(one["confidence"], right(one), strict=True)
        if not math.isnan(p)
    ]


def calibration(records: Sequence[Record]) -> list[Bin]:
    """Return ten bins of confidence. Raises ValueError if no frame has one."""
    if not (said := pairs([one for one in records if "error" not in one])):
        raise ValueError("--calibration: expected a tracker with a confidence, got none in these files")
    return bins(said)


def table(records: Sequence[Record]) -> str:
    """Return a row for each kind, one for all of them, and what must be met."""
    ended = [one for one in records if "error" not in one]
    rows: list[tuple[str, ...]] = [HEAD]
    for name in (*KINDS, *REAL):
        if mine := [one for one in ended if one["kind"] == name]:
            rows.append(_row(name, Figures.of(mine)))
    if len(rows) > 2:
        rows.append(_row("all", Figures.of(ended)))
    lines = [
        "  ".join(
            [f"{row[0]:{WIDTHS[0]}s}", *(f"{cell:>{width}s}" for cell, width in zip(row[1:], WIDTHS[1:], strict=True))]
        )
        for row in rows
    ]
    errors = [f"{one['kind']} {one['seed']}: {one['error']}" for one in records if "error" in one]
    return "\n".join([*lines, *errors, "", *musts(ended)])


def _row(name: str, f: Figures) -> tuple[str, ...]:
    return (
        name, f"{f.films}", f"{f.frames}", _cell(f.angle[0], 2), _cell(f.angle[1], 2), _cell(100 * f.shift[0], 2),
        _cell(100 * f.shift[1], 2), _cell(100 * f.lost, 1), _cell(100 * f.unsaid, 1), _cell(100 * f.unsaid_seen, 1),
        _cell(100 * f.lost_right, 1), f"{_cell(100 * f.found, 0)} of {f.returns}" if f.returns else "", _cell(f.after, 0),
        _cell(f.nees, 2), _cell(f.calibration, 3), _cell(f.rate, 1), _cell(f.work, 1),
    )  # fmt: skip


def _cell(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def musts(records: Sequence[Record]) -> list[str]:
    """Return a line for each figure that has a limit."""
    lines = []

    def line(words: str, value: float, low: float = -math.inf, high: float = math.inf, digits: int = 2) -> None:
        if not math.isnan(value):
            must = f"≥ {low:g}" if high == math.inf else f"≤ {high:g}" if low == -math.inf else f"{low:g} … {high:g}"
            lines.append(
                f"{words:62s} {value:8.{digits}f}  must {must:9s} {'met' if low <= value <= high else 'missed'}"
            )

    if not records:
        return lines
    every = Figures.of(records)
    if steady := [one for one in records if one["kind"] in STEADY]:
        f = Figures.of(steady)
        line(f"angle, median ({', '.join(STEADY)})", f.angle[0], high=0.2)
        line("angle, 90 %", f.angle[1], high=0.5)
    line("frames off by more than 5° or 5 % that are not said to be lost, %", 100 * every.unsaid, high=0.2)
    line("right frames said to be lost, %", 100 * every.lost_right, high=0.2)
    line("found again within a second of the return, %", 100 * every.found, low=95.0, digits=0)
    for name in (*KINDS, *REAL):
        if mine := [one for one in records if one["kind"] == name]:
            line(f"NEES/6, {name}", Figures.of(mine).nees, 0.5, 2.0)
    textured = [one for one in records if one["kind"] == "textured" and FACES[0] <= one["faces"] <= FACES[1]]
    if textured:
        f = Figures.of(textured)
        line("frames a second, textured, 2,000 … 20,000 faces", f.rate, low=60.0, digits=1)
        line("processor time a frame, ms", f.work, high=8.0)
    if dense := [one for one in records if one["kind"] == "dense"]:
        line("frames a second, some 200,000 faces", Figures.of(dense).rate, low=30.0, digits=1)
    if three := [one for one in records if one["kind"] == "three"]:
        line("frames a second, three objects", Figures.of(three).rate, low=25.0, digits=1)
    return lines


def training(records: Sequence[Record], names: Sequence[str] = ()) -> str:
    """Return the coefficients of the confidence by the features of frames, and how it does on meshes that were left out.

    Raises ValueError if there are no features.
    """
    rows = []
    for one in records:
        known = {name: one["features"][name] for name in names or one.get("features", {})}
        for k, good in enumerate(right(one) if known else ()):
            features = {name: values[k] for name, values in known.items()}
            if all(math.isfinite(value) for value in features.values()):
                rows.append((features, bool(good), one["mesh"]))
    if not rows:
        raise ValueError("--train: expected frames with features, got none in these files")
    features, good, meshes = zip(*rows, strict=True)
    said = list(zip(left_out(features, good, meshes), good, strict=True)) if len(set(meshes)) > 1 else []
    sure = sum(p >= SURE for p, _ in said)
    wrong = sum(p >= SURE and not right_one for p, right_one in said)
    left = (
        f"; trained on other meshes, {sure} are sure, {wrong} of them wrong; expected calibration error "
        if said
        else ""
    )
    error = f"{calibration_error(bins(said)):.3f}" if said else ""
    return f"{trained(features, good)}\n{sum(good)} of {len(good)} frames right{left}{error}"
