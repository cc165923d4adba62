"""Docstrings as reStructuredText, for Sphinx.

Docstrings here are plain text: paragraphs, lists with dashes, code in single backticks, formulas indented by four, and tables of
arguments, of which all rows begin in one column and all texts in another:

    verts   (V, 3) float   positions, which go
                           on below
    colors  (V, C) float   one a vertex

Such a table becomes a definition list, whose terms are all columns but the last. So do the sections of numpydoc, such as
Parameters, whose entries are a line `name : type` and indented lines of text.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from textwrap import dedent
from typing import NamedTuple

SPECIAL = re.compile(r"([\\*_|<>])")
ROW = re.compile(r"(\S[^.]*?)\s{2,}(?=\S)")  # what begins a row: an argument, or several
WORD = re.compile(r"[A-Za-z_]\w*$")
UNDERLINE = re.compile(r"-{3,}")  # of a section's name
References = dict[str, str]


class Row(NamedTuple):
    terms: list[str]  # the argument and what comes between it and the text
    text: list[str]
    nested: list[str]  # the lines of a table within it


def to_rst(lines: Iterable[str], references: References | None = None) -> list[str]:
    """The lines of a docstring, as inspect.cleandoc leaves them. `references` are roles by the names that mean them."""
    return list(_blocks([line.rstrip() for line in lines], references or {}))


def _blocks(lines: list[str], references: References) -> Iterator[str]:
    i = 0
    while i < len(lines):
        if not lines[i]:
            i += 1
            continue
        yield ""
        if i + 1 < len(lines) and UNDERLINE.fullmatch(lines[i + 1]):
            end = next((k for k in range(i + 2, len(lines) - 1) if UNDERLINE.fullmatch(lines[k + 1])), len(lines))
            yield from (f".. rubric:: {lines[i]}", "", *_section(lines[i + 2 : end], references))
        elif lines[i].startswith("    "):
            end = _end(lines, i, lambda line: not line.startswith(" "))
            yield from ("::", "", *("   " + line[1:] for line in lines[i:end]))
        elif ROW.match(lines[i]) and not lines[i].startswith("- "):
            end = _end(
                lines, i, lambda line: not line.startswith("  ") and not ROW.match(line) and not WORD.match(line)
            )
            yield from _definitions(_rows(lines[i:end]), references)
        else:
            end = _end(lines, i, lambda line: bool(ROW.match(line)) and not line.startswith(("-", " ")))
            if lines[i].startswith("- "):
                end = min(end, _end(lines, i, lambda line: line.startswith("- ")))
            yield from (_inline(line, references) for line in lines[i:end])
        yield ""
        i = end


def _section(lines: list[str], references: References) -> Iterator[str]:
    """The entries of a section of numpydoc, as a definition list."""
    starts = [k for k, line in enumerate(lines) if line and not line.startswith(" ")]
    for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
        name, _, kind = lines[start].partition(" : ")
        yield f"``{name}``" + f" : *{_inline(kind, {})}*" * bool(kind)
        text = dedent("\n".join(lines[start + 1 : end])).split("\n")
        found = list(_blocks(text, references)) if any(text) else ["\\ "]
        first = next(k for k, line in enumerate(found) if line)
        yield from ("   " + line for line in found[first:])


def _end(lines: list[str], start: int, ends: Callable[[str], bool]) -> int:
    """Of the block that begins at `start`."""
    return next((k for k in range(start + 1, len(lines)) if not lines[k] or ends(lines[k])), len(lines))


def _rows(lines: list[str]) -> list[Row]:
    """The rows of a table. Lines between the columns of names and texts are a table within the row."""
    rows: list[Row] = []
    column = 0  # where texts begin
    for line in lines:
        if not line.startswith("  "):
            *terms, text = re.split(r"\s{2,}", line)
            rows.append(Row(terms, [text], []) if terms else Row([text], [], []))
            column = len(line) - len(text)
        elif len(line) - len(line.lstrip()) < column or rows[-1].nested:
            rows[-1].nested.append(line)
        else:
            rows[-1].text.append(line.strip())
    return rows


def _definitions(rows: list[Row], references: References) -> Iterator[str]:
    for (name, *kinds), text, nested in rows:
        yield f"``{name}``" + "".join(f" : *{_inline(kind, {})}*" for kind in kinds)
        yield from ("   " + _inline(line, references) for line in text or ["\\ "])
        if nested:
            yield from ("", *("   " + line for line in _blocks(dedent("\n".join(nested)).split("\n"), references)))


def _inline(text: str, references: References) -> str:
    """Code in backticks as such, references, and whatever else reStructuredText would take for markup as it is."""
    parts = text.split("`")
    if len(parts) % 2 == 0:  # code that goes on in the next line
        return _plain(text.replace("`", "'"), references)
    return "".join(_code(part, references) if k % 2 else _plain(part, references) for k, part in enumerate(parts))


def _code(text: str, references: References) -> str:
    return references.get(text.removesuffix("()").removeprefix("eg."), f"``{text}``")


def _plain(text: str, references: References) -> str:
    """Calls such as render(), names with a dot such as Camera.stack, and classes are references where they are known."""
    pieces = re.split(r"([A-Za-z_][\w.]*\w(?:\(\))?)", text)
    return "".join(_word(p, references) if k % 2 else SPECIAL.sub(r"\\\1", p) for k, p in enumerate(pieces))


def _word(text: str, references: References) -> str:
    role = references.get(text.removesuffix("()"))
    if role is None or not (text.endswith("()") or "." in text or text[0].isupper()):
        return SPECIAL.sub(r"\\\1", text)
    return f"\\ {role}\\ "
