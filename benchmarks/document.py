"""What the documents of all reports have: the settings of a run, numbers in words, the colours of figures."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

import torch

from edgegrad.library import core

Document = dict[str, Any]
METRICS = ("vertex", "translation", "rotation")
INK, FAINT, GRID = "#303030", "#8c8c8c", "#ececec"


def settings(size: int, seeds: int, quick: bool) -> dict[str, Any]:
    """All that must agree for points to be compared."""
    kernel = hashlib.sha256(Path(core.__file__).read_bytes()).hexdigest()[:12]
    return {
        "size": size, "seeds": list(range(seeds)), "quick": quick, "threads": torch.get_num_threads(),
        "processor": _processor(), "cores": os.cpu_count(), "system": platform.system(),
        "python": platform.python_version(), "torch": torch.__version__,
        "edgegrad": importlib.metadata.version("edgegrad"), "kernel": kernel, "embreex": importlib.metadata.version("embreex"),
    }  # fmt: skip


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def percent(error: float | None) -> str:
    """With two digits that count."""
    return "not finite" if error is None else f"{float(f'{100.0 * error:.2g}'):g} %"


def duration(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 1.0 else f"{1e3 * seconds:.3g} ms"
