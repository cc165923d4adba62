"""The notebooks run from top to bottom."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[1] / "notebooks"


def outputs(path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The texts that a notebook prints; it also draws a picture."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # as the tests beside it
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(path.parent)}}
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
    found = [o for cell in notebook.cells if cell.cell_type == "code" for o in cell.outputs]
    assert any("image/png" in o.get("data", {}) for o in found)
    return [o.text for o in found if o.get("name") == "stdout"]


def last_numbers(text: str) -> list[float]:
    return [float(line.split()[-1]) for line in text.strip().splitlines()]


def test_first_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    # The gradient cell prints the finite difference and the gradient with and without the boundary term.
    texts = outputs(FOLDER / "first_steps.ipynb", monkeypatch)
    fd, with_boundary, without = last_numbers(next(text for text in texts if text.startswith("finite difference")))
    assert abs(with_boundary / fd - 1) < 0.05
    assert abs(without / fd - 1) > 0.2


def test_derivatives(monkeypatch: pytest.MonkeyPatch) -> None:
    texts = outputs(FOLDER / "derivatives.ipynb", monkeypatch)
    forward, reverse = last_numbers(next(text for text in texts if text.startswith("forward")))
    assert abs(forward / reverse - 1) < 0.02


def test_shaders(monkeypatch: pytest.MonkeyPatch) -> None:
    texts = outputs(FOLDER / "shaders.ipynb", monkeypatch)
    fd, gradient = last_numbers(next(text for text in texts if text.startswith("finite difference")))
    assert abs(gradient / fd - 1) < 0.03
    start, end = last_numbers(next(text for text in texts if text.startswith("error at the start")))
    assert end < 0.2 * start


def test_light(monkeypatch: pytest.MonkeyPatch) -> None:
    texts = outputs(FOLDER / "light.ipynb", monkeypatch)
    fd, derivative = last_numbers(next(text for text in texts if text.startswith("finite difference")))
    assert abs(derivative / fd - 1) < 0.05
    start, end = last_numbers("\n".join(next(text for text in texts if "off by" in text).splitlines()[1:]))
    assert end < 0.2 * start


def test_there_is_no_other() -> None:
    assert sorted(path.stem for path in FOLDER.glob("*.ipynb")) == ["derivatives", "first_steps", "light", "shaders"]
