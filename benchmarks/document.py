"""What all tables and figures share: the machine, numbers in words, and the style of axes."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from edgegrad.library import core

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Document = dict[str, Any]
INK, FAINT, GRID = "#303030", "#8c8c8c", "#ececec"


def machine() -> dict[str, Any]:
    """Return the machine and the versions that measurements depend on."""
    return {
        "threads": torch.get_num_threads(), "processor": _processor(), "cores": os.cpu_count(),
        "system": platform.system(), "python": platform.python_version(), "torch": torch.__version__,
        "edgegrad": importlib.metadata.version("edgegrad"), "kernel": kernel_hash(),
        "embreex": importlib.metadata.version("embreex"),
    }  # fmt: skip


def kernel_hash() -> str:
    """Return a name of the compiled kernel, which differs after each change."""
    return hashlib.sha256(Path(core.__file__).read_bytes()).hexdigest()[:12]


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def machine_in_words(settings: dict[str, Any]) -> str:
    """Return a line of Markdown on what `machine` returned."""
    return (
        f"{settings['threads']} threads of {settings['processor']}, {settings['cores']} cores; edgegrad "
        f"{settings['edgegrad']} (kernel {settings['kernel']}), torch {settings['torch']}, embreex {settings['embreex']}, "
        f"Python {settings['python']}, {settings['system']}"
    )


def percent(error: float | None) -> str:
    """Return an error in percent, with two significant digits."""
    return "not finite" if error is None else f"{float(f'{100.0 * error:.2g}'):g} %"


def duration(seconds: float) -> str:
    """Return a time in seconds or milliseconds, with three significant digits."""
    return f"{seconds:.3g} s" if seconds >= 1.0 else f"{1e3 * seconds:.3g} ms"


def style(axes: Axes) -> None:
    """Give axes a faint grid, two spines and small labels."""
    axes.grid(True, which="major", color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.tick_params(which="both", labelsize=8, color=FAINT, labelcolor=INK)
    axes.tick_params(which="minor", length=0)
