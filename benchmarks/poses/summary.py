"""Tables of fits: rates with intervals by Wilson (1927), errors, times, and how well confidence is calibrated."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from edgegrad.fit.pose.confidence import POSE_CONFIDENCE, confidence_of

from .cases import Case, Placed
from .kinds import KINDS, cases
from .logistic import left_out, trained
from .objects import Sources
from .runs import Record

SURE = 0.95  # A fit with this confidence says that its pose is right; one without a confidence, that it has converged.
KNOWN = 2.0, 0.02  # degrees and share of the size within which confidence is the probability of the pose
BINS = 10
HEAD = ("kind", "fits", "right/%", "sure/%", "sure and wrong/%", "angle", "shift", "90 %", "steps", "s", "must/%", "")
WIDTHS = (13, 4, 13, 6, 16, 6, 7, 14, 5, 5, 6, 6)


def wilson(count: int, total: int, z: float = 1.96) -> tuple[float, float]:
    """Return the interval that holds the rate of what happened `count` times in 95 % of all samples."""
    share, square = count / total, z * z / total
    middle = (share + square / 2) / (1 + square)
    half = z * math.sqrt(share * (1 - share) / total + square / (4 * total)) / (1 + square)
    return max(0.0, middle - half), min(1.0, middle + half)


def known(record: Record) -> bool:
    """Return whether the pose is as near as confidence says. Where the focal length is sought, the distance goes with it."""
    shift = max(KNOWN[1], KINDS[record["kind"]].shift) if record["kind"] == "focal" else KNOWN[1]
    return record.get("degrees", math.inf) <= KNOWN[0] and record["shift"] <= shift


def confidence(record: Record) -> float:
    """Return the confidence by a fit's features, so that fits need not run again after a training; NaN without any."""
    features = record.get("features") or {}
    return confidence_of(features) if features else record.get("confidence", math.nan)


def sure(record: Record) -> bool:
    """Return whether a fit says that its pose is right."""
    said = confidence(record)
    return record.get("converged", False) if math.isnan(said) else said >= SURE


def compared(records: Sequence[Record], sources: Sources, folder: Path | None) -> list[Record]:
    """Return records of which those without a true pose are compared with the end that is nearest to all others."""
    done = list(records)
    for name in {one["kind"] for one in records if KINDS[one["kind"]].medoid}:
        kind, mine = KINDS[name], [k for k, one in enumerate(done) if one["kind"] == name and "matrix" in one]
        ends = [Placed.from_matrix(done[k]["matrix"]) for k in mine]
        if folder is None or len(ends) < 2:
            continue
        case: Case = cases(name, 0, sources, folder)[0]
        apart = [[case.apart(a, b) for b in ends] for a in ends]
        middle = int(np.argmin([statistics.median(degrees for degrees, _ in row) for row in apart]))
        for k, (degrees, shift) in zip(mine, apart[middle], strict=True):
            right = degrees <= kind.degrees and shift <= kind.shift
            done[k] = {**done[k], "degrees": degrees, "shift": shift, "right": right}
    return done


def table(records: Sequence[Record]) -> str:
    """Return a row for each kind, and one for all of them together."""
    rows: list[tuple[str, ...]] = [HEAD]
    for name in KINDS:
        if mine := [one for one in records if one["kind"] == name]:
            rows.append(_row(name, mine, KINDS[name].must))
    if len(rows) > 2:
        rows.append(_row("all", records, 0.0))
    lines = ["  ".join(f"{cell:{width}s}" for cell, width in zip(row, WIDTHS, strict=True)).rstrip() for row in rows]
    errors = [f"{one['kind']} {one['seed']}: {one['error']}" for one in records if "error" in one]
    edges = [f"{name}: contours {_edges(records, name)} px from edges" for name in KINDS if _edges(records, name)]
    return "\n".join([*lines, *edges, *errors])


def _row(name: str, records: Sequence[Record], must: float) -> tuple[str, ...]:
    ends = [one for one in records if "error" not in one] or [{}]
    right = sum(one["right"] for one in records)
    falsely = sum(sure(one) and not known(one) for one in records)

    def quantile(key: str, share: float) -> float:
        return float(np.quantile([one.get(key, math.nan) for one in ends], share))

    return (
        name, f"{len(records)}", _rate(right, len(records)), f"{sum(map(sure, records)) / len(records):.0%}"[:-1],
        _rate(falsely, len(records)), f"{quantile('degrees', 0.5):.2f}°", f"{quantile('shift', 0.5):.2%}",
        f"{quantile('degrees', 0.9):.1f}°, {quantile('shift', 0.9):.1%}", f"{quantile('steps', 0.5):.0f}",
        f"{quantile('work', 0.5):.1f}", f"{100 * must:.0f}" if must else "",
        "" if not must else "met" if right >= must * len(records) else "missed",
    )  # fmt: skip


def _rate(count: int, total: int) -> str:
    low, high = wilson(count, total)
    return f"{100 * count / total:.0f} ({100 * low:.0f}…{100 * high:.0f})"


def _edges(records: Iterable[Record], name: str) -> str:
    found = [one["edges"][0] for one in records if one["kind"] == name and "edges" in one]
    return f"{statistics.median(found):.2f}" if found else ""


class Bin(NamedTuple):
    """Fits of about the same confidence."""

    fits: int
    confidence: float
    right: float


def said(records: Sequence[Record]) -> list[tuple[float, bool]]:
    """Return the confidence of fits and whether they are right. Raises ValueError if no record has a confidence."""
    pairs = [(confidence(one), known(one)) for one in records]
    pairs = [pair for pair in pairs if not math.isnan(pair[0])]
    if not pairs:
        raise ValueError("--calibration: expected fits with a confidence, got none; run the cases again")
    return pairs


def bins(pairs: Sequence[tuple[float, bool]]) -> list[Bin]:
    """Return ten bins of confidence, without empty ones, of pairs of a confidence and whether the fit is right."""
    number = [min(int(BINS * p), BINS - 1) for p, _ in pairs]
    groups = [[pair for pair, its in zip(pairs, number, strict=True) if its == k] for k in range(BINS)]
    return [Bin(len(one), *np.mean(one, axis=0).tolist()) for one in groups if one]


def calibration_error(found: Sequence[Bin]) -> float:
    """Return the mean difference of confidence and share of right poses over bins, weighted by their fits."""
    return sum(one.fits * abs(one.confidence - one.right) for one in found) / sum(one.fits for one in found)


def training(records: Sequence[Record]) -> str:
    """Return the coefficients of confidence by the features of fits, and how it does on cases that were left out."""
    features = [{name: one["features"][name] for name in POSE_CONFIDENCE.names} for one in records]
    right, meshes = [known(one) for one in records], [one["mesh"] for one in records]
    said = [one["features"]["mass"] * p for one, p in zip(records, left_out(features, right, meshes), strict=True)]
    found, pairs = trained(features, right), list(zip(said, right, strict=True))
    wrong = sum(p >= SURE and not good for p, good in pairs)
    return (
        f"{found}\n{sum(right)} of {len(right)} right; trained on other meshes, {sum(p >= SURE for p, _ in pairs)} are sure, "
        f"{wrong} of them wrong; expected calibration error {calibration_error(bins(pairs)):.3f}"
    )


def draw_reliability(found: Sequence[Bin], file: Path) -> None:
    """Draw the share of right poses against confidence, with intervals by Wilson."""
    from matplotlib.figure import Figure

    figure = Figure((4.5, 4.5), layout="constrained")
    axes = figure.add_subplot(xlabel="confidence", ylabel="share of right poses", xlim=(0, 1), ylim=(0, 1), aspect=1)
    spans = [wilson(round(one.right * one.fits), one.fits) for one in found]
    axes.plot([0, 1], [0, 1], color="0.7", zorder=0)
    for one, (low, high) in zip(found, spans, strict=True):
        axes.plot([one.confidence] * 2, [low, high], color="C0", lw=1)
        axes.annotate(str(one.fits), (one.confidence, one.right), (4, -9), textcoords="offset points", fontsize=7)
    axes.plot([one.confidence for one in found], [one.right for one in found], "o", color="C0")
    axes.set_title(f"expected calibration error {calibration_error(found):.3f}", fontsize=9)
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=120)
