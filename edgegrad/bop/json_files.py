"""BOP's JSON files: objects with numbers as keys, and errors that say what is wrong with them."""

from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..files.paths import check_readable

LISTED = 20  # ids in a message
ROUNDING = 1e-2  # largest deviation of R Rᵀ from 1 in files


def read_json(path: Path, kind: type) -> Any:
    """Read an object or a list. Raises FileNotFoundError or ValueError that names the file."""
    file = check_readable(path, (".json",))
    try:
        found = json.loads(file.read_bytes())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected JSON, got something else ({error}); download it again") from None
    if not isinstance(found, kind):
        names = {dict: "an object {…}", list: "a list […]"}
        raise ValueError(f"{path}: expected {names[kind]}, got {type(found).__name__}; is it another file of BOP's?")
    return found


def by_number(path: Path, found: dict[str, Any]) -> dict[int, Any]:
    """Return the object with its keys as whole numbers. Raises ValueError."""
    for key in found:
        if not key.isdecimal():
            raise ValueError(f"{path}: expected ids as keys, got {key!r}; is it another file of BOP's?")
    return {int(key): value for key, value in found.items()}


def numbers(where: str, entry: Any, key: str, *shape: int) -> Tensor:
    """Return the numbers under a key as float64 of that shape. Raises ValueError."""
    if not isinstance(entry, dict) or key not in entry:
        got = ", ".join(entry) or "none" if isinstance(entry, dict) else type(entry).__name__
        raise ValueError(f"{where}: expected the key {key!r}, got {got}; add it")
    try:
        value = torch.tensor(entry[key], dtype=torch.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}, {key}: expected numbers, got something else ({error})") from None
    count = int(torch.tensor(shape).prod()) if shape else 1
    if value.numel() != count or not bool(torch.isfinite(value).all()):
        raise ValueError(f"{where}, {key}: expected {count} finite number{'s' * (count > 1)}, got {entry[key]!r}")
    return value.reshape(shape)


def rigid(where: str, R: Tensor, t: Tensor) -> Tensor:
    """Return (4, 4) from a file's R (3, 3) and t (3,). Raises ValueError if R is no rotation up to rounding."""
    off = float((R @ R.T - torch.eye(3)).abs().max())
    if off > ROUNDING or float(torch.linalg.det(R)) < 0.0:
        raise ValueError(f"{where}: expected a rotation matrix by rows, got |R Rᵀ − 1| up to {off:.2g} and determinant "
                         f"{float(torch.linalg.det(R)):.3g}")  # fmt: skip
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = R, t
    return pose


def listed(ids: Collection[int]) -> str:
    """Return ids as text for a message; the first of many."""
    first = sorted(ids)[:LISTED]
    return (", ".join(map(str, first)) or "none") + (f" … ({len(ids)} in all)" if len(ids) > LISTED else "")
