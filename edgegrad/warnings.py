"""Warnings that point at the caller's line, and come once for each."""

from __future__ import annotations

import sys
import warnings

INSIDE = {"edgegrad", "torch"}  # torch runs the operators, and the forward() of modules that call a render


def warn(subject: str, text: str) -> None:
    """Issue a UserWarning at the line outside of the library that the call came from, however deep it is. By Python's default
    filter it comes once for each line and `subject`, though the numbers in the text may change."""
    warnings.warn(_About(text, subject), stacklevel=_stacklevel())  # type: ignore[arg-type]


class _About(str):
    """A text that equals all others on its subject, because Python distinguishes warnings of one line by their text."""

    subject: str

    def __new__(cls, text: str, subject: str) -> _About:
        self = super().__new__(cls, text)
        self.subject = subject
        return self

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _About) and other.subject == self.subject

    def __hash__(self) -> int:
        return hash(self.subject)


def _stacklevel() -> int:
    """Return the level of the innermost frame outside, as seen by the caller; or of the outermost frame of all. Python 3.12 has
    skip_file_prefixes for this."""
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").split(".")[0] in INSIDE:
        level, frame = level + 1, frame.f_back
    return level
