"""Fixtures of the tests of BOP, which name this module as a plugin of pytest."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from bop_scenes import make


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("bop"))


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    """Return a copy of the data set, to be changed."""
    return Path(shutil.copytree(made, tmp_path / "data"))
