"""BOP's result files: CSV with a header and the columns scene_id, im_id, obj_id, score, R, t, time.

R has 9 numbers by rows and t 3 in mm, separated by spaces. time is that of all estimates of an image together, in seconds, or
−1 if it is unknown. https://bop.felk.cvut.cz/challenges/bop-challenge-2019/#formatofresults
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..files.paths import PathLike, check_readable, check_suffix, replacing
from .json_files import rigid

COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")


@dataclass(frozen=True, eq=False)
class Estimate:
    """A row of a result file."""

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    pose: Tensor  # (4, 4) float64, mesh to camera, mm
    seconds: float = -1.0  # of all estimates of the image together; −1: unknown


def read_results(path: PathLike) -> list[Estimate]:
    """Return the rows in the order of the file. Raises FileNotFoundError, or ValueError that names file, line and column."""
    file = check_readable(path, (".csv",))
    found = []
    with file.open(newline="", encoding="utf-8-sig") as stream:
        for number, fields in enumerate(csv.reader(stream), 1):
            fields = [field.strip() for field in fields]
            if not any(fields) or (number == 1 and fields[0] == COLUMNS[0]):
                continue
            where = f"{path}, line {number}"
            if len(fields) != len(COLUMNS):
                raise ValueError(
                    f"{where}: expected {len(COLUMNS)} columns ({', '.join(COLUMNS)}), got {len(fields)}; part them by commas, "
                    "and the numbers of R and t by spaces"
                )
            row = dict(zip(COLUMNS, fields, strict=True))
            ids = [_id(where, name, row[name]) for name in COLUMNS[:3]]
            R = torch.tensor(_floats(where, "R", row["R"], 9), dtype=torch.float64).reshape(3, 3)
            t = torch.tensor(_floats(where, "t", row["t"], 3), dtype=torch.float64)
            (score,), (seconds,) = _floats(where, "score", row["score"], 1), _floats(where, "time", row["time"], 1)
            found.append(Estimate(ids[0], ids[1], ids[2], score, rigid(f"{where}, R", R, t), seconds))
    return found


def write_results(path: PathLike, estimates: Iterable[Estimate]) -> None:
    """Write rows as read_results reads them, to the last bit; the file is written whole or not at all. Raises ValueError or
    OSError."""
    file = check_suffix(path, (".csv",))
    with replacing(file) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(COLUMNS)
        for one in estimates:
            R, t = (" ".join(map(repr, part.flatten().tolist())) for part in (one.pose[:3, :3], one.pose[:3, 3]))
            writer.writerow(
                [one.scene_id, one.im_id, one.obj_id, repr(float(one.score)), R, t, repr(float(one.seconds))]
            )


def _id(where: str, name: str, text: str) -> int:
    if not text.isdecimal():
        raise ValueError(f"{where}, {name}: expected a whole number from 0 up, got {text!r}")
    return int(text)


def _floats(where: str, name: str, text: str, count: int) -> list[float]:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise ValueError(f"{where}, {name}: expected {count} finite number{'s' * (count > 1)}, got {text!r}")
    return values
