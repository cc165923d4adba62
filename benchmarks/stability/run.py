"""Extreme cases: the error of image and gradient for each, in one table.

A row is written as soon as it is measured, so that Ctrl-C keeps what there is.
"""

from __future__ import annotations

import importlib.util
import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from edgegrad.files.paths import replacing

from ..document import Document, machine, percent
from . import NAME, fits, statistics, steps
from .cases import CASES
from .cases.measure import NOISY, QUICK, WRONG, Effort, measure, worst_part

SECTIONS = {"statistics": statistics.measure, "steps": steps.measure, "fits": fits.measure}
NEEDS = {"statistics": ["scipy"], "fits": ["cholespy"]}


def stability(out: Path, cases: Sequence[str] | None = None, *, quick: bool = False) -> tuple[Document, bool]:
    """Measures and writes stability.json, .md and .png in the folder `out`; (what is in the JSON, whether Ctrl-C ended it).

    cases  names of cases, groups of them, "statistics", "steps" or "fits"; all when None
    quick  fewer seeds, to try it out

    Raises ValueError for an unknown name, ImportError where SciPy or cholespy is missing that a chosen section needs.
    """
    chosen, sections = _chosen(cases)
    begin = time.perf_counter()
    document: Document = {"settings": {"quick": quick, **machine()}, "cases": [], "sections": {}}
    for name, packages in NEEDS.items():
        if name in sections and (lack := [p for p in packages if importlib.util.find_spec(p) is None]):
            text = f"{name} needs {' and '.join(lack)}; install with: pip install 'edgegrad[fit]'"
            if cases is not None:
                raise ImportError(text)
            tqdm.write(f"{name}: left out; it {text.removeprefix(name + ' ')}")
            sections.remove(name)
    interrupted = False
    effort = QUICK if quick else Effort()
    with tqdm(total=len(chosen) + len(sections), unit="case", dynamic_ncols=True, miniters=0) as bar:

        def say(text: str) -> None:
            bar.set_postfix_str(text, refresh=False)
            bar.update(0)

        try:
            for name in chosen:
                bar.set_description(name)
                row = measure(CASES[name], effort)
                document["cases"].append(row)
                tqdm.write(in_a_line(row))
                _write(out, document)
                bar.update()
            for name in sections:
                bar.set_description(name)
                document["sections"][name] = SECTIONS[name](quick, say)
                _write(out, document)
                bar.update()
        except KeyboardInterrupt:
            interrupted = True
    document["seconds"] = time.perf_counter() - begin
    if document["cases"] or document["sections"]:
        _write(out, document)
        from . import plots  # matplotlib takes a while to import

        plots.publish(out, document)
    return document, interrupted


def failures(document: Document) -> list[str]:
    """Names of the cases that are wrong or too noisy to decide."""
    return [row["name"] for row in document["cases"] if row["verdict"] in (WRONG, NOISY)]


def _chosen(names: Sequence[str] | None) -> tuple[list[str], list[str]]:
    groups = {case.group for case in CASES.values()}
    for name in names or ():
        if name not in CASES and name not in groups and name not in SECTIONS:
            raise ValueError(
                f"case: expected one of {', '.join([*CASES, *SECTIONS])}, or a group ({', '.join(sorted(groups))}), got {name!r}"
            )
    if names is None:
        return list(CASES), list(SECTIONS)
    return [n for n, case in CASES.items() if n in names or case.group in names], [n for n in SECTIONS if n in names]


def _write(out: Path, document: Document) -> None:
    with replacing(out / f"{NAME}.json") as temporary:
        text = json.dumps(_plain(document), indent=1, ensure_ascii=False)
        temporary.write_text(text + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    """JSON knows no NaN and no infinity: they become null."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def in_a_line(row: dict[str, Any]) -> str:
    if "raised" in row:
        return f"{row['name']:26s} {row['verdict']}: {row['raised']}"
    image, (name, part) = row["image"], worst_part(row)
    return (
        f"{row['name']:26s} image {percent(image['error']):>9s} ± {percent(image['noise']):9s} "
        f"gradient {percent(part['error']):>9s} ± {percent(part['noise']):9s} ({name})  {row['verdict']}"
    )
