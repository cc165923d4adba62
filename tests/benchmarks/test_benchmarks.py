"""The benchmarks import what the package has; tests of the reports run more of them."""

from __future__ import annotations

import importlib
import pkgutil
import re
from pathlib import Path

import benchmarks

FOLDER = Path(benchmarks.__file__).parent


def test_all_modules_can_be_imported() -> None:
    names = [module.name for module in pkgutil.walk_packages([str(FOLDER)], "benchmarks.")]
    assert len(names) > 40
    for name in names:
        importlib.import_module(name)


def test_the_list_names_all_modules() -> None:
    text = (FOLDER / "README.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"`(\w+)`", text))
    assert {module.name for module in pkgutil.iter_modules([str(FOLDER)])} <= listed
