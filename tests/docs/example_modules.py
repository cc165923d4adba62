"""The modules of examples/, which tests import by name."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

FOLDER = Path(__file__).parents[2] / "examples"


def example(name: str, size: int | None = None) -> ModuleType:
    """Return the example's module, with pictures of `size` pixels in place of its own."""
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if size is not None:
        assert size < module.SIZE
        vars(module)["SIZE"] = size
    return module
