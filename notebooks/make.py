"""Runs notebooks and writes them with small outputs: N_name.ipynb from N_name.py.

python notebooks/make.py [NAME ...]     all of them without a name; needs `pip install '.[test]'`
"""

from __future__ import annotations

import base64
import io
import os
import sys
import time
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image

FOLDER = Path(__file__).parent
COLORS = 256  # of a picture's palette
WIDTH = 760  # pixels, at most


def names() -> list[str]:
    return sorted((path.stem for path in FOLDER.glob("[0-9]*_*.py")), key=lambda name: int(name.partition("_")[0]))


def executed(name: str, seconds: int = 300) -> NotebookNode:
    """The notebook with its outputs. Raises nbclient's CellExecutionError where a cell does."""
    notebook = jupytext.read(FOLDER / f"{name}.py")
    notebook.metadata = nbformat.from_dict(
        {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    )
    resources = {"metadata": {"path": FOLDER}}
    client = NotebookClient(notebook, timeout=seconds, kernel_name="python3", resources=resources, record_timing=False)
    # Those of torch's own code, and of progress bars that scikit-image does not draw.
    ignored = "ignore::FutureWarning,ignore:IProgress not found"
    return client.execute(env={**os.environ, "PYTHONWARNINGS": ignored})


def small(png: str) -> str:
    """The same picture with a palette; PNG in base64, as notebooks hold it."""
    picture = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
    file = io.BytesIO()
    picture.thumbnail((WIDTH, WIDTH))
    palette = picture.quantize(COLORS, kmeans=1)
    picture.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG).save(file, "PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode()


def make(name: str) -> Path:
    notebook = executed(name)
    for number, cell in enumerate(notebook.cells):
        cell.id = f"cell-{number}"  # the same each time, for small diffs
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "image/png" in data:
                data["image/png"] = small(data["image/png"])
                data["text/plain"] = "<picture>"
    path = FOLDER / f"{name}.ipynb"
    nbformat.write(notebook, path)
    return path


if __name__ == "__main__":
    for chosen in sys.argv[1:] or names():
        began = time.perf_counter()
        written = make(Path(chosen).stem)
        print(f"{written.name}: {time.perf_counter() - began:.0f} s, {written.stat().st_size / 1e3:.0f} kB", flush=True)
