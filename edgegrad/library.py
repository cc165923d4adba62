"""Opening of Embree and import of the compiled kernel."""

from __future__ import annotations

import atexit
import importlib
import importlib.metadata
import importlib.util
import os
import sys
from typing import Any

import torch  # noqa: F401  first, so that the kernel shares torch's OpenMP runtime

HOW_TO_GET_EMBREE = (
    "edgegrad needs the Embree 4 library that comes with the embreex package; install it with "
    "`pip install 'embreex>=4.4,<5'` (wheels exist for x86-64 Linux, Windows and macOS), or with conda the package embree"
)


def embree_path() -> str:
    """Return the path of libembree4: of the embreex distribution, or of conda's package embree. Raises ImportError."""
    try:
        embreex = importlib.metadata.distribution("embreex")
        missing = f"the installed embreex {embreex.version} carries no libembree4"
        for file in embreex.files or []:
            if "embree4" in file.name and (".so" in file.name or file.suffix in (".dll", ".dylib")):
                return str(file.locate())
    except importlib.metadata.PackageNotFoundError:
        missing = "embreex is not installed"
    for place in ("lib/libembree4.so", "lib/libembree4.dylib", "Library/bin/embree4.dll"):
        if os.path.exists(path := os.path.join(sys.prefix, place)):
            return path
    raise ImportError(f"{HOW_TO_GET_EMBREE}; {missing}")


def load(name: str = "_core") -> Any:
    """Return a compiled module, with Embree open: the kernel, or `_core_tests`, which only tests call. Raises ImportError that
    says how to get what is missing. Two environment variables serve tests. EDGEGRAD_KERNEL is the file of another build of the
    kernel, with sanitizers. EDGEGRAD_EMBREE has options of Embree's device, such as "max_isa=avx2" for older processors."""
    if path := os.environ.get("EDGEGRAD_KERNEL"):
        path = os.path.join(os.path.dirname(path), os.path.basename(path).replace("_core", name, 1))
        spec = importlib.util.spec_from_file_location(f"edgegrad.{name}", path)
        assert spec is not None and spec.loader is not None, f"EDGEGRAD_KERNEL: expected a compiled module, got {path}"
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    else:
        module = importlib.import_module(f"edgegrad.{name}")

    try:
        module.open_embree(embree_path(), os.environ.get("EDGEGRAD_EMBREE", ""))
    except RuntimeError as error:
        raise ImportError(f"{HOW_TO_GET_EMBREE}; {error}") from None
    return module


core = load()
# A process that ends while daemon threads render would often be aborted (csrc/python/unlocked.h).
atexit.register(core.await_callers)
# Without this a worker of a DataLoader, or of multiprocessing, that is forked after its parent rendered waits for ever.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=core.before_fork,
        after_in_parent=lambda: core.after_fork(child=False),
        after_in_child=lambda: core.after_fork(child=True),
    )
