"""Docstrings as reStructuredText, for Sphinx.

Docstrings here are plain text: paragraphs, lists with dashes, code in single backticks, formulas and code indented by four, and
the sections of numpydoc. An entry of a section, a line `name : type` and indented lines of text, becomes one of a definition
list. Napoleon would read all of that as reStructuredText, in which `|x|` and `x_i` are markup.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from textwrap import dedent

SPECIAL = re.compile(r"([\\*_|<>])")
UNDERLINE = re.compile(r"-{3,}")  # of a section's name
TEXT = "Notes", "Examples"  # sections without entries
References = dict[str, str]


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
            section = _blocks if lines[i] in TEXT else _entries
            yield from (f".. rubric:: {lines[i]}", "", *section(lines[i + 2 : end], references))
        elif lines[i].startswith("    "):
            end = _end(lines, i, lambda line: not line.startswith(" "))
            yield from ("::", "", *("   " + line[1:] for line in lines[i:end]))
        elif lines[i].startswith(">>> "):
            end = _end(lines, i, lambda line: False)
            yield from lines[i:end]
        else:
            marker = "- " if lines[i].startswith("- ") else ">>> "
            end = _end(lines, i, lambda line, marker=marker: line.startswith(marker))
            yield from (_inline(line, references) for line in lines[i:end])
        yield ""
        i = end


def _entries(lines: list[str], references: References) -> Iterator[str]:
    """The entries of a section of numpydoc, as a definition list."""
    starts = [k for k, line in enumerate(lines) if line and not line.startswith(" ")]
    for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
        name, _, kind = lines[start].partition(" : ")
        yield f"``{name}``" + f" : *{_plain(kind.replace('`', ''), {})}*" * bool(kind)
        text = dedent("\n".join(lines[start + 1 : end])).split("\n")
        found = list(_blocks(text, references)) if any(text) else ["\\ "]
        first = next(k for k, line in enumerate(found) if line)
        yield from ("   " + line for line in found[first:])


def _end(lines: list[str], start: int, ends: Callable[[str], bool]) -> int:
    """Of the block that begins at `start`."""
    return next((k for k in range(start + 1, len(lines)) if not lines[k] or ends(lines[k])), len(lines))


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
