"""This project's own checks in `make lint` report what they are to report."""

from __future__ import annotations

from pathlib import Path

import check_includes
import check_words
import pytest


def test_the_code_passes() -> None:
    root = Path(__file__).parents[2]
    assert check_includes.violations(root / "csrc") == []
    assert check_words.violations() == []


@pytest.mark.parametrize(
    ("file", "include", "found"),
    [
        ("rays/trace.h", "shading/shade.h", "rays may not include shading"),
        ("secondary/shadows.cpp", "primary/curve_measure.h", "secondary may not include primary"),
        ("raster/texels.h", "camera/camera.h", "raster may not include camera"),
        ("extra/new.h", "core/math.h", "the folder extra has no layer"),
    ],
)
def test_an_include_upward_is_found(tmp_path: Path, file: str, include: str, found: str) -> None:
    path = tmp_path / file
    path.parent.mkdir()
    path.write_text(f'#include "core/math.h"\n#include "{include}"\n')
    (line,) = check_includes.violations(tmp_path)
    assert found in line


def test_a_private_word_is_found_with_the_term_for_it(tmp_path: Path) -> None:
    for folder in check_words.FOLDERS:
        (tmp_path / folder).mkdir()
    (tmp_path / "edgegrad" / "light.py").write_text("lamp = 1\nclamp = lamps_of = 2\n")
    (tmp_path / "csrc" / "film").mkdir()
    (tmp_path / "csrc" / "film" / "film.h").write_text("double x = std::floor(y);  // beside\n")
    assert check_words.violations(tmp_path) == [
        "edgegrad/light.py:1: lamp: write light, emitter, EmitterHit, apply_mis",
        "edgegrad/light.py:2: lamps: write light, emitter, EmitterHit, apply_mis",
        "csrc/film/film.h:1: beside: write next to, auxiliary channels, parallel, margin",
    ]
