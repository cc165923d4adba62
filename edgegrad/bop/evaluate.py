"""Evaluation of estimates against known poses: the errors of each estimate, and the recalls of BOP19.

For each target, n instances of an object in an image, the n estimates with the highest scores count, and the n most visible
instances. In the order of their scores, each estimate takes the remaining instance with the lowest error, if that is below a
threshold. The recall is the share of instances that are taken. AR_VSD is the mean over ten misalignments tau, 5 … 50 % of the
diameter, and ten thresholds 0.05 … 0.5; AR_MSSD over thresholds 5 … 50 % of the diameter; AR_MSPD over 5 … 50 pixels of an
image 640 pixels wide; AR the mean of the three. ADD(-S) is the recall below 10 % of the diameter, by ADI if the object has
symmetries.

Hodaň et al., "BOP Challenge 2020 on 6D Object Localization", ECCVW 2020
"""

from __future__ import annotations

import dataclasses
import json
import math
import operator
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor
from tqdm import tqdm

from ..check import check_flag, check_positive
from .dataset import Dataset, Target
from .depth import depth_image
from .errors import add, adi, mspd, mssd, vsd
from .files import Estimate
from .frame import Frame, Truth
from .model import Model

SYMMETRY_STEP = 0.01  # of continuous symmetries: bop_toolkit's max_sym_disc_step
TENTHS = [0.05 * k for k in range(1, 11)]  # of VSD's tau and threshold, and of MSSD's in diameters
PIXELS = [5.0 * k for k in range(1, 11)]  # of MSPD's threshold
WIDTH = 640.0  # of the image for these pixels
ADD_SHARE = 0.1


@dataclass(frozen=True)
class PairErrors:
    """The errors of an estimate for an instance, in mm; mspd in pixels, vsd 0 … 1."""

    mssd: float
    mspd: float
    add: float
    adi: float
    degrees: float  # of the rotation, up to symmetry
    distance: float  # of the translation, with the symmetry that minimizes the rotation's error
    vsd: tuple[float, ...] = ()  # one for each tau, 5 … 50 % of the diameter; empty without VSD


@dataclass(frozen=True, eq=False)
class Row:
    """An estimate that counts, and the instance nearest to it by MSSD."""

    estimate: Estimate
    truth: Truth | None  # None if the image has no such object
    errors: PairErrors | None


@dataclass(frozen=True)
class Recalls:
    """The recalls, 0 … 1, of one object or of all."""

    instances: int  # to be found
    estimates: int  # that count
    ar_vsd: float | None  # None without VSD
    ar_mssd: float
    ar_mspd: float
    add_s: float
    degrees: float  # median errors of the estimates; nan if there are none
    distance: float

    @property
    def ar(self) -> float | None:
        """Return the mean of the three average recalls."""
        return None if self.ar_vsd is None else (self.ar_vsd + self.ar_mssd + self.ar_mspd) / 3.0


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The result of evaluate()."""

    overall: Recalls
    objects: dict[int, Recalls]  # by id
    rows: list[Row] = field(repr=False)
    ignored: int = 0  # estimates that belong to no target, or exceed its count

    def table(self) -> str:
        """Return a table as text, with a line for each object and one for all."""
        lines = ["object  instances  found  AR_VSD  AR_MSSD  AR_MSPD      AR  ADD(-S)  median °  median mm"]
        for name, row in [*((str(key), value) for key, value in self.objects.items()), ("all", self.overall)]:
            numbers = (row.ar_vsd, row.ar_mssd, row.ar_mspd, row.ar, row.add_s)
            shares = ["-" if number is None else f"{number:.3f}" for number in numbers]
            medians = ["-" if math.isnan(number) else f"{number:.2f}" for number in (row.degrees, row.distance)]
            widths = (6, 7, 7, 6, 7, 8, 9)
            cells = "  ".join(f"{text:>{width}}" for text, width in zip([*shares, *medians], widths, strict=True))
            lines.append(f"{name:>6}  {row.instances:>9}  {row.estimates:>5}  {cells}")
        return "\n".join(lines)

    def to_json(self) -> str:
        """Return JSON with recalls, by BOP's names, of all and each object, and estimates' errors in mm, pixels and degrees."""
        rows = [
            {
                "scene_id": row.estimate.scene_id, "im_id": row.estimate.im_id, "obj_id": row.estimate.obj_id,
                "score": row.estimate.score, "gt_id": None if row.truth is None else row.truth.index,
                **({} if row.errors is None else _finite(dataclasses.asdict(row.errors))),
            }
            for row in self.rows
        ]  # fmt: skip
        found: dict[str, Any] = _named(self.overall)
        found["objects"] = {str(key): _named(value) for key, value in self.objects.items()}
        return json.dumps(found | {"ignored_estimates": self.ignored, "estimates": rows}, indent=1)


def evaluate(
    dataset: Dataset,
    estimates: Iterable[Estimate],
    targets: Sequence[Target] | None = None,
    *,
    with_vsd: bool = True,
    delta: float = 15.0,
    progress: bool = True,
) -> Evaluation:
    """Compute errors and recalls of estimates.

    Errors are measured on models_eval/, if there is one. Raises FileNotFoundError or ValueError that names what the data set
    lacks, ImportError without SciPy.

    Parameters
    ----------
    dataset : Dataset
    estimates : iterable of Estimate
    targets : sequence of Target, default dataset.targets()
        What is to be found.
    with_vsd : bool, default True
        False leaves out VSD, which needs depth images and takes most of the time.
    delta : float, default 15
        Of VSD, in mm: BOP19 takes 15, and 5 for ITODD.
    progress : bool, default True
        Whether a bar is shown on standard error.
    """
    check_flag("with_vsd", with_vsd)
    check_positive("delta", delta, least=0.0, most=1e9)
    chosen = dataset.targets() if targets is None else list(targets)
    if not chosen:
        raise ValueError("targets: expected at least one, got none; choose another split, or another list of targets")
    given: dict[tuple[int, int, int], list[Estimate]] = {}
    total = 0
    for estimate in estimates:
        given.setdefault((estimate.scene_id, estimate.im_id, estimate.obj_id), []).append(estimate)
        total += 1
    of_object: dict[int, list[_Found]] = {}
    for target in tqdm(chosen, desc="errors", unit="target", disable=not progress, leave=False):
        frame, model = dataset.frame(target.scene_id, target.im_id), dataset.model(target.obj_id, evaluation=True)
        best = sorted(given.get(target[:3], []), key=lambda one: -one.score)[: target.instances]
        truths = sorted(frame.truths_of(target.obj_id), key=lambda one: -(1.0 if one.visible is None else one.visible))
        truths = truths[: target.instances]
        errors = _errors(frame, model, best, truths, delta if with_vsd else None)
        rows = [_row(one, truths, of_one) for one, of_one in zip(best, errors, strict=True)]
        matches = {} if not rows or not truths else _matches(errors, model, frame.camera.size[1])
        of_object.setdefault(target.obj_id, []).append(_Found(len(truths), rows, matches))
    every = [found for several in of_object.values() for found in several]
    objects = {obj_id: _recalls(of_object[obj_id], with_vsd) for obj_id in sorted(of_object)}
    kept = [row for found in every for row in found.rows]
    return Evaluation(_recalls(every, with_vsd), objects, kept, total - len(kept))


class _Found(NamedTuple):
    """The estimates and matches of a target."""

    instances: int
    rows: list[Row]
    matches: dict[str, np.ndarray]  # counts of taken instances by threshold; empty if none can be taken


def _errors(
    frame: Frame, model: Model, estimates: list[Estimate], truths: list[Truth], delta: float | None
) -> list[list[PairErrors]]:
    """Return a row of errors for each estimate."""
    if not estimates or not truths:
        return [[] for _ in estimates]
    camera, points, symmetries = frame.camera, model.points, model.symmetries.transforms(SYMMETRY_STEP)
    measured = None if delta is None else frame.depth()
    views: dict[Tensor, Tensor] = {}
    if measured is not None:
        poses = [one.pose for one in (*estimates, *truths)]
        views = {pose: depth_image(model.mesh, pose, camera) for pose in poses}

    def pair(E: Tensor, T: Tensor) -> PairErrors:
        off = model.symmetries.error(E, T)
        seen: list[float] = []
        if measured is not None and delta is not None:
            seen = vsd(views[E], views[T], measured, camera, model.diameter, TENTHS, delta)
        return PairErrors(
            mssd(E, T, points, symmetries), mspd(E, T, points, symmetries, camera), add(E, T, points), adi(E, T, points),
            off.degrees, off.distance, tuple(seen),
        )  # fmt: skip

    return [[pair(estimate.pose, truth.pose) for truth in truths] for estimate in estimates]


def _row(estimate: Estimate, truths: list[Truth], errors: list[PairErrors]) -> Row:
    nearest = min(range(len(truths)), key=lambda i: errors[i].mssd, default=None)
    return Row(estimate, None, None) if nearest is None else Row(estimate, truths[nearest], errors[nearest])


def _matches(errors: list[list[PairErrors]], model: Model, width: int) -> dict[str, np.ndarray]:
    """Count the instances taken: by VSD (10, 10) by tau and threshold, MSSD (10,), MSPD (10,), ADD(-S) (1,)."""

    def taken(error: Callable[[PairErrors], float], thresholds: Sequence[float]) -> np.ndarray:
        table = np.array([[error(pair) for pair in row] for row in errors])
        return np.array([matched(table, threshold) for threshold in thresholds])

    add_s = operator.attrgetter("add" if model.symmetries.trivial else "adi")
    found = {
        "mssd": taken(lambda pair: pair.mssd / model.diameter, TENTHS),
        "mspd": taken(lambda pair: pair.mspd * WIDTH / width, PIXELS),
        "add_s": taken(lambda pair: add_s(pair) / model.diameter, [ADD_SHARE]),
    }
    if errors[0][0].vsd:
        found["vsd"] = np.stack([taken(lambda pair, k=k: pair.vsd[k], TENTHS) for k in range(len(TENTHS))])
    return found


def matched(errors: np.ndarray, threshold: float) -> int:
    """Count the instances (columns) that estimates take, as rows in the order of their scores: each takes the one with the
    lowest error of those left, if below the threshold."""
    left = errors.astype(np.float64).copy()
    count = 0
    for row in left:
        best = int(row.argmin())
        if row[best] < threshold:
            left[:, best] = np.inf
            count += 1
    return count


def _recalls(found: list[_Found], with_vsd: bool) -> Recalls:
    instances = sum(one.instances for one in found)
    rows = [row for one in found for row in one.rows]

    def recall(name: str) -> float:
        taken = [one.matches[name].mean() for one in found if one.matches]
        return float(sum(taken)) / instances if instances else 0.0

    off = [row.errors for row in rows if row.errors is not None]
    return Recalls(
        instances, len(rows), recall("vsd") if with_vsd else None, recall("mssd"), recall("mspd"), recall("add_s"),
        statistics.median(one.degrees for one in off) if off else math.nan,
        statistics.median(one.distance for one in off) if off else math.nan,
    )  # fmt: skip


def _finite(errors: dict[str, Any]) -> dict[str, Any]:
    """Replace infinity, which JSON does not have, by None. The projection of a point close to the eye may reach it."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value for name, value in errors.items()
    }


def _named(recalls: Recalls) -> dict[str, Any]:
    """Return recalls by the names of bop_toolkit's scores_bop19.json, and further numbers."""
    return {
        "bop19_average_recall_vsd": recalls.ar_vsd, "bop19_average_recall_mssd": recalls.ar_mssd,
        "bop19_average_recall_mspd": recalls.ar_mspd, "bop19_average_recall": recalls.ar, "add_s_recall": recalls.add_s,
        "instances": recalls.instances, "estimates": recalls.estimates,
        "median_degrees": None if math.isnan(recalls.degrees) else recalls.degrees,
        "median_mm": None if math.isnan(recalls.distance) else recalls.distance,
    }  # fmt: skip
