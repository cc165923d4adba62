"""The Python of the docs runs, and prints what they say it prints.

Blocks marked `python` of a page run one after the other, as a reader would type them, in a folder of their own; those marked `py` are
code of other libraries, or need files that nobody has here. Where a block of `text` follows, it is what the block before prints: the
same words, and numbers within a fifth. What takes longer is below `slow` in a page's list.
"""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import matplotlib
import pytest
import torch

FOLDER = Path(__file__).parents[1] / "docs"
PAGES = ["quick-start.md", "concepts.md", *(str(p.relative_to(FOLDER)) for p in sorted(FOLDER.glob("how-to/*.md")))]
SLOW = {"how-to/pytorch3d.md"}
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"[-−+]?\d[\d,]*\.?\d*(?:e[-+]?\d+)?")
TOLERANCE = 0.2


def same(said: str, printed: str) -> bool:
    """Whether words are equal, spaces and numbers aside, and numbers close."""
    words = [" ".join(NUMBER.sub("#", text).split()) for text in (said, printed)]
    pairs = zip(*([float(n.replace(",", "").replace("−", "-")) for n in NUMBER.findall(t)] for t in (said, printed)))
    return words[0] == words[1] and all(abs(a - b) <= TOLERANCE * max(abs(a), abs(b)) for a, b in pairs)


def test_outputs_are_compared() -> None:
    assert same("loss  1.00e-3, 12 faces", "loss 1.1e-03, 12  faces")
    assert not same("loss 1.0", "loss 1.5") and not same("loss 1.0", "error 1.0")


@pytest.mark.parametrize("page", [pytest.param(p, marks=pytest.mark.slow if p in SLOW else ()) for p in PAGES])
def test_page(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    torch.manual_seed(0)
    text = (FOLDER / page).read_text(encoding="utf-8")
    names: dict[str, object] = {"__name__": "__main__"}
    printed = ""
    for block in FENCE.finditer(text):
        kind, source = block.groups()
        if kind == "python":
            line = text[: block.start(2)].count("\n")
            out = io.StringIO()
            with contextlib.redirect_stdout(out):
                exec(compile("\n" * line + source, str(FOLDER / page), "exec"), names)
            printed = out.getvalue()
        elif kind == "text":
            assert same(source, printed), f"{page}: it says\n{source}\nand prints\n{printed}"
