"""Text of mesh files: its encoding, and the numbers in it."""

from __future__ import annotations

import codecs
import warnings

import numpy as np

from .part import FormatError

UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
MARKS = (codecs.BOM_UTF8, *UTF16)  # what tells the encoding, before a text


def as_utf8(data: bytes) -> bytes:
    """Return text in UTF-8 with newlines alone. Names and comments may be in Latin-1, files of Windows in UTF-16."""
    if data.startswith(UTF16):
        data = data.decode("utf-16", errors="replace").encode()
    data = data.removeprefix(codecs.BOM_UTF8)
    if not data.isascii():
        try:
            data.decode()
        except UnicodeDecodeError:
            data = data.decode("latin-1").encode()
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def numbers(text: bytes, what: str, kind: type = np.float64) -> np.ndarray:
    """Return all numbers of a text, separated by white space. Raises FormatError where it holds anything else."""
    with warnings.catch_warnings():  # where the text stops being numbers, NumPy drops the rest and only warns
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text, dtype=kind, sep=" ") if text and not text.isspace() else np.empty(0, kind)
        except (DeprecationWarning, ValueError):
            raise FormatError(
                f"expected numbers alone in {what}, got {_no_number(text, kind)!r}; it may be truncated, or damaged"
            ) from None


def ragged(lines: list[bytes], what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of all lines, one after the other, and how many each line has (N,). Raises FormatError."""
    if not lines:
        return np.empty(0), np.empty(0, np.int64)
    text = b"\n".join(lines) + b"\n"
    values, letters = numbers(text, what), np.frombuffer(text, np.uint8)
    counts = per_line(word_starts(letters > 32), letters)
    if counts.sum() != len(values):  # NumPy parts 1-2 into 1 and -2
        raise FormatError(f"expected numbers parted by spaces in {what}, got some that are not; it may be damaged")
    return values, counts


def table(lines: list[bytes], what: str, least: int, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the first numbers of each line in a row (N, up to `most`), and how many the line has (N,), `least` or more. Rows
    with fewer numbers are filled with zeros. Raises FormatError."""
    values, counts = ragged(lines, what)
    if counts.min(initial=least) < least:
        bad = lines[int(np.argmax(counts < least))].decode(errors="replace").strip()[:40]
        raise FormatError(
            f"expected {least} numbers for each of {what}, got {bad!r}; the file may be truncated or damaged"
        )
    width = int(counts.max(initial=least))
    if (counts == width).all():
        return values.reshape(len(lines), width)[:, :most], counts
    column = np.arange(min(width, most))
    there = column < counts[:, None]
    rows = np.zeros(there.shape)
    rows[there] = values[((np.cumsum(counts) - counts)[:, None] + column)[there]]
    return rows, counts


def unquoted(name: str) -> str:
    """Return a name without the quotes that some programs write around names of files."""
    return name[1:-1] if len(name) > 2 and name[0] == name[-1] == '"' else name


def word_starts(inside: np.ndarray) -> np.ndarray:
    """Return where runs of True begin."""
    starts = inside.copy()
    starts[1:] &= ~inside[:-1]
    return np.flatnonzero(starts)


def per_line(places: np.ndarray, letters: np.ndarray) -> np.ndarray:
    """Return how many of some places, ascending, lie in each line of a text that ends in a newline."""
    return np.diff(np.searchsorted(places, np.flatnonzero(letters == ord("\n"))), prepend=0)


def _no_number(text: bytes, kind: type) -> str:
    for word in text.split():
        try:
            kind(word)
        except ValueError:
            return word[:40].decode(errors="replace")
    return "numbers that are not parted"
