"""The notebooks run from top to bottom, each with its own checks at the end, and are kept as they were written."""

from __future__ import annotations

import base64
import importlib.util
import re
from pathlib import Path
from types import ModuleType

import jupytext
import matplotlib
import matplotlib.pyplot as plt
import nbformat
import pytest
import torch
from nbclient.exceptions import CellExecutionError
from nbformat import NotebookNode

pytestmark = pytest.mark.unsanitized

FOLDER = Path(__file__).parents[2] / "notebooks"
NAMES = sorted(path.stem for path in FOLDER.glob("[0-9]*_*.py"))
QUICK = "1_images_and_gradients"
LARGEST = 300_000  # bytes
# Such paths would show on whose machine the outputs were made.
PLACES = re.compile(r"/(home|root|tmp|usr|opt|mnt|work|Users)/|site-packages|[A-Z]:\\")


def maker() -> ModuleType:
    """Return the module notebooks/make.py."""
    spec = importlib.util.spec_from_file_location("make", FOLDER / "make.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def outputs(notebook: NotebookNode) -> list[NotebookNode]:
    return [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]


def committed(name: str) -> NotebookNode:
    return nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)


def test_there_are_eleven_pairs() -> None:
    assert sorted(int(name.partition("_")[0]) for name in NAMES) == list(range(1, 12))
    assert sorted(path.stem for path in FOLDER.glob("*.ipynb")) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_pairs_agree(name: str) -> None:
    """`python notebooks/make.py NAME` was run after the last change."""
    source = jupytext.read(FOLDER / f"{name}.py")
    made = committed(name)
    assert [(c.cell_type, c.source) for c in made.cells] == [(c.cell_type, c.source) for c in source.cells]


@pytest.mark.parametrize("name", NAMES)
def test_outputs_are_there_and_small(name: str) -> None:
    assert (FOLDER / f"{name}.ipynb").stat().st_size < LARGEST
    notebook = committed(name)
    nbformat.validate(notebook)
    assert all(cell.execution_count for cell in notebook.cells if cell.cell_type == "code")
    found = outputs(notebook)
    assert {output.output_type for output in found} <= {"stream", "display_data", "execute_result"}  # no errors
    assert all(output.name == "stdout" for output in found if output.output_type == "stream")  # no warnings
    pictures = [output.data["image/png"] for output in found if "image/png" in output.get("data", {})]
    assert pictures and all(base64.b64decode(picture)[25] == 3 for picture in pictures)  # PNG's colour type: a palette
    texts = [str(output.get("text", "")) + str(output.get("data", {}).get("text/plain", "")) for output in found]
    assert not [text for text in texts if PLACES.search(text)]
    last = next(cell for cell in reversed(notebook.cells) if cell.cell_type == "code")
    assert "assert " in last.source and not last.outputs


def run(name: str) -> None:
    assert any("image/png" in output.get("data", {}) for output in outputs(maker().executed(name)))


def test_the_quick_one_runs() -> None:
    """Its cells run in this process: Jupyter's own would import torch anew, which takes longer than they do."""
    matplotlib.use("agg")
    cells = jupytext.read(FOLDER / f"{QUICK}.py").cells
    try:
        exec("\n\n".join(cell.source for cell in cells if cell.cell_type == "code"), {})
        assert len(plt.get_fignums()) == 4
    finally:
        plt.close("all")
        torch.set_printoptions(profile="default")


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_runs(name: str) -> None:
    run(name)


@pytest.mark.slow
def test_a_wrong_gradient_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a gradient 5 % too large where it is compared, the first notebook stops."""
    make = maker()
    source = (FOLDER / f"{QUICK}.py").read_text(encoding="utf-8")
    wrong = source.replace("    return leaf.grad\n", "    return 1.05 * leaf.grad\n")
    assert wrong != source
    (tmp_path / f"{QUICK}.py").write_text(wrong, encoding="utf-8")
    monkeypatch.setattr(make, "FOLDER", tmp_path)
    with pytest.raises(CellExecutionError, match="interior \\+ edges is the gradient"):
        make.executed(QUICK)
