"""Fits of cases in processes of their own, each with one thread, and a line of JSON for each that has ended."""

from __future__ import annotations

import json
import math
import multiprocessing
import signal
import time
import traceback
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

import edgegrad as eg

from .cases import Case, Placed
from .kinds import KINDS, Found, cases, fitted
from .objects import Sources

NEAR = 6.0  # pixels around a contour where edges of a real photograph are looked for
OUTLINE = 0.3  # A pixel lies on a contour if a neighbour's alpha is so much higher.

Record = dict[str, Any]  # a fit, as a line of JSON


@dataclass(frozen=True)
class Job:
    """A case to be fitted."""

    kind: str
    seed: int
    sources: Sources
    folder: Path | None = None
    pictures: Path | None = None  # where contours of wrong fits are drawn
    settings: object = None

    @property
    def key(self) -> tuple[str, int]:
        return self.kind, self.seed


def run(jobs: Sequence[Job], processes: int) -> Iterator[list[Record]]:
    """Yield the records of each job as it ends."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, initializer=_begin) as pool:
        waiting = [pool.submit(measured, job) for job in jobs]
        try:
            for future in as_completed(waiting):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _begin() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that keeps the results.
    torch.set_num_threads(1)


def measured(job: Job) -> list[Record]:
    """Return a record for each object of a case. A fit that raises an error is a wrong one, and its record says why."""
    given = cases(job.kind, job.seed, job.sources, job.folder)
    began = time.process_time()
    try:
        found = fitted(job.kind, job.seed, given, job.settings)
    except Exception as error:  # The other cases go on.
        place = traceback.extract_tb(error.__traceback__)[-1]
        reason = f"{type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
        return [
            {"kind": job.kind, "seed": job.seed, "object": 0, "mesh": given[0].name, "right": False, "error": reason}
        ]
    work = time.process_time() - began
    records = [_record(job, case, one, k, work) for k, (case, one) in enumerate(zip(given, found, strict=True))]
    for case, record in zip(given, records, strict=True):
        if job.pictures is not None and not record["right"]:
            draw(job.pictures, case, record)
    return records


def _record(job: Job, case: Case, found: Found, number: int, work: float) -> Record:
    kind, fit = KINDS[job.kind], found.fit
    degrees, shift = case.apart(found.pose, case.truth)
    search = getattr(fit, "search", fit)  # the poses behind a camera
    known = getattr(search, "uncertainty", None)
    record = {
        "kind": job.kind, "seed": job.seed, "object": number, "mesh": case.name,
        "start_degrees": math.nan, "start_shift": math.nan, "degrees": degrees, "shift": shift,
        "right": degrees <= kind.degrees and shift <= kind.shift, "converged": fit.converged, "explained": fit.explained,
        "sigma_degrees": getattr(known, "degrees", math.nan), "sigma_shift": getattr(known, "shift", math.nan) / case.size,
        "confidence": float(getattr(fit, "confidence", getattr(search, "confidence", math.nan))),
        "features": dict(getattr(search, "features", None) or {}),
        "modes": [_mode(case, mode) for mode in getattr(search, "modes", None) or ()],
        "steps": fit.steps, "work": work, "reason": fit.reason, "start": None, "matrix": found.pose.matrix.tolist(),
    }  # fmt: skip
    if case.start is not None:
        record["start_degrees"], record["start_shift"] = case.apart(case.start, case.truth)
        record["start"] = case.start.matrix.tolist()
    if found.camera is not case.camera:
        record["focal"] = float(found.camera.K[0, 0] / case.camera.K[0, 0])
    if case.real:
        from . import contour_edges  # It needs scikit-image.

        record["edges"] = contour_edges.across(case.picture, case.alpha(found.pose), NEAR).quantiles()
    return record


def _mode(case: Case, mode: Any) -> list[float]:
    """Return the probability of another pose, and how far it is off: degrees, and the shift as a share of the size."""
    return [float(getattr(mode, "probability", math.nan)), *case.apart(Placed.from_matrix(mode.matrix), case.truth)]


def append(file: Path | None, records: Iterable[Record]) -> None:
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("a", encoding="utf-8") as out:
            out.write("".join(json.dumps(one, ensure_ascii=False) + "\n" for one in records))


def read(files: Iterable[Path]) -> list[Record]:
    """Return the records of files. A last line that was not written whole is left out."""
    found = []
    for file in files:
        for line in file.read_text(encoding="utf-8").splitlines() if file.exists() else ():
            with suppress(json.JSONDecodeError):
                found.append(json.loads(line))
    return found


def draw(folder: Path, case: Case, record: Record) -> None:
    """Write the picture with contours of the start (blue), of the true pose (green) and of the fit (yellow)."""
    image = F.interpolate(case.picture.movedim(-1, 0)[None], scale_factor=2.0)[0].movedim(0, -1)
    H, W = case.picture.shape[:2]
    fitted_camera = case.camera.replace(K=_zoomed(case.camera.K, record.get("focal", 1.0)))
    truth = None if KINDS[record["kind"]].medoid else case.truth.matrix
    for pose, camera, color in (
        (record["start"], case.camera, (0.1, 0.3, 1.0)), (truth, case.camera, (0.0, 0.8, 0.1)),
        (record["matrix"], fitted_camera, (1.0, 0.9, 0.0)),
    ):  # fmt: skip
        if pose is not None:
            on = outline(case.alpha(Placed.from_matrix(pose), camera.resized((2 * H, 2 * W))))
            image = torch.where(on, torch.tensor(color), image)
    folder.mkdir(parents=True, exist_ok=True)
    eg.write_image(folder / f"{record['kind']}-{record['seed']}-{record['object']}-{record['mesh']}.png", image)


def _zoomed(K: Tensor, factor: float) -> Tensor:
    K = K.clone()
    K[[0, 1], [0, 1]] *= factor
    return K


def outline(alpha: Tensor) -> Tensor:
    """Return the pixels (H, W, 1) just outside a silhouette (H, W)."""
    highest = F.max_pool2d(alpha[None, None], 3, 1, 1)[0, 0]
    return (highest - alpha > OUTLINE)[..., None]
