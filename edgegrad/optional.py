"""Packages that only some calls need."""

from __future__ import annotations

import importlib
from types import ModuleType

DRAWING = "edgegrad[figures]", "drawing a fit"  # the package and the purpose, as require() takes them


def require(module: str, package: str, purpose: str) -> ModuleType:
    """Return a module that is imported only when it is needed. Raises ImportError with the way to install it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        quoted = f"'{package}'" if "[" in package else package  # for shells that take brackets for a pattern
        raise ImportError(f"{purpose} needs {package}; install it with: pip install {quoted} ({error})") from error
