"""Figures of trackers from what they said of each frame. A pose is right within 5° and 5 % of the object's size."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from .films import Film
from .trackers import Estimate, Maker

RIGHT = 5.0, 0.05  # degrees, and share of the object's size by which its centre is off
SEEN = (
    0.2  # Share of an object from which on it counts as seen: errors, and `lost` of right frames, are of these frames.
)
GONE, BACK = 0.02, 0.5  # Shares of an object that is gone, and that is back after that.
SECOND = 30  # frames

Record = dict[str, Any]  # an object in a film, as a line of JSON: a list with an entry a frame for most names


def deviation(truth: np.ndarray, found: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return the step (6,) from a pose to the true one: a rotation vector in radians and a shift of the centre, world units."""
    R, R_true = found[:3, :3], truth[:3, :3]
    shift = R_true @ centre + truth[:3, 3] - R @ centre - found[:3, 3]
    return np.r_[Rotation.from_matrix(R_true @ R.T).as_rotvec(), shift]


def nees(step: np.ndarray, covariance: np.ndarray | None) -> float:
    """Return the normalised error squared over 6, which is 1 in the mean of a calibrated covariance; NaN where none is given."""
    if covariance is None or not np.isfinite(covariance).all():
        return math.nan
    try:
        return float(step @ np.linalg.solve(covariance, step)) / 6
    except np.linalg.LinAlgError:
        return math.nan


def measured(film: Film, make: Maker) -> list[Record]:
    """Return what a tracker says of each object in a film, and how far it is off. Pictures are decoded before time is taken."""
    tracker, said, seconds, work = make(film), [], [], []
    for k in range(len(film)):
        image, depth = film.frame(k), film.depth(k)
        began = time.perf_counter(), time.process_time()
        said.append(tracker.update(image, depth))
        seconds.append(time.perf_counter() - began[0])
        work.append(time.process_time() - began[1])
    return [_record(film, n, [one[n] for one in said], seconds, work) for n in range(len(film.meshes))]


def _record(film: Film, n: int, said: Sequence[Estimate], seconds: list[float], work: list[float]) -> Record:
    centre, size = film.measures[n]
    steps = [deviation(film.poses[k, n], one.matrix, centre) for k, one in enumerate(said)]
    names = sorted({name for one in said for name in one.features})
    return {
        "kind": film.kind, "seed": film.seed, "object": n, "mesh": film.names[n], "faces": len(film.meshes[n].faces),
        "degrees": [_rounded(math.degrees(np.linalg.norm(step[:3]))) for step in steps],
        "shift": [_rounded(float(np.linalg.norm(step[3:])) / size) for step in steps],
        "nees": [_rounded(nees(step, one.covariance)) for step, one in zip(steps, said, strict=True)],
        "lost": [one.lost for one in said],
        "confidence": [_rounded(one.confidence) for one in said],
        "visible": [_rounded(float(share)) for share in film.visible[:, n]],
        "said_visible": [_rounded(one.visible) for one in said],
        "features": {name: [_rounded(one.features.get(name, math.nan)) for one in said] for name in names},
        "seconds": [_rounded(value) for value in seconds], "work": [_rounded(value) for value in work],
        "poses": [[_rounded(x, 9) for x in one.matrix[:3].ravel().tolist()] for one in said],
    }  # fmt: skip


def _rounded(value: float, digits: int = 6) -> float:
    """Return a number with this many significant digits, so that lines of JSON are short."""
    return float(f"{value:.{digits}g}")


def right(record: Record) -> np.ndarray:
    """Return (T,) whether the pose is right."""
    return (np.array(record["degrees"]) <= RIGHT[0]) & (np.array(record["shift"]) <= RIGHT[1])


def lost(record: Record) -> np.ndarray:
    return np.array(record["lost"], dtype=bool)


def seen(record: Record) -> np.ndarray:
    return np.array(record["visible"]) >= SEEN


def followed(record: Record) -> np.ndarray:
    """Return (T,) whether the object is seen, and the tracker does not say that it is lost."""
    return seen(record) & ~lost(record)


def recoveries(record: Record) -> list[int | None]:
    """Return for each time that the object was gone how many frames pass from when it is back until the pose is right and is not
    said to be lost: 0, if at once; None: not within a second. Times that leave no whole second count if it was found again."""
    visible, good = np.array(record["visible"]), right(record) & ~lost(record)
    found, gone = [], False
    for k, share in enumerate(visible):
        if share < GONE:
            gone = True
        elif gone and share >= BACK:
            gone, later = False, good[k : k + SECOND + 1].nonzero()[0]
            if len(later):
                found.append(int(later[0]))
            elif len(visible) - k > SECOND:
                found.append(None)
    return found
