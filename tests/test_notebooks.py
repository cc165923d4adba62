"""The notebooks run from top to bottom."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # as the tests beside it
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}
    ).execute()
    outputs = [o for cell in notebook.cells if cell.cell_type == "code" for o in cell.outputs]
    assert any("image/png" in o.get("data", {}) for o in outputs)
    # The gradient cell prints the finite difference and the gradient with and without the boundary term.
    text = next(o.text for o in outputs if o.get("text", "").startswith("finite difference"))
    fd, with_boundary, without = (float(line.split()[-1]) for line in text.strip().splitlines())
    assert abs(with_boundary / fd - 1) < 0.05
    assert abs(without / fd - 1) > 0.2


def test_there_is_one() -> None:
    assert NOTEBOOKS
