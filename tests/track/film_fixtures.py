"""Fixtures of the tests of films, which name this module as a plugin of pytest."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from moving import Film
from torch import Tensor

import edgegrad as eg


@pytest.fixture(scope="session")
def film() -> Film:
    return Film.turning(160, 7, spp=8)


@pytest.fixture(scope="session")
def frames(film: Film) -> list[Tensor]:
    """Return frames with little noise of light, since the bounds on poses are not about its draws."""
    return list(replace(film, spp=32))


@pytest.fixture
def arguments(film: Film, tmp_path: Path) -> Callable[[str], list[str]]:
    """Return the arguments of `edgegrad track` for a video or a folder in tmp_path, by its name."""
    eg.save_mesh(tmp_path / "stone.ply", film.mesh)
    eg.save_camera(tmp_path / "camera.json", film.camera)
    (tmp_path / "init.json").write_text(json.dumps({"mesh_to_world": film.poses[0].tolist()}))

    def of(name: str) -> list[str]:
        given = ["track", str(tmp_path / "stone.ply"), str(tmp_path / name), "--out", str(tmp_path / "out")]
        return [*given, "--camera", str(tmp_path / "camera.json"), "--init", str(tmp_path / "init.json")]

    return of
