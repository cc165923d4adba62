"""The elements of PLY files as arrays, in text or binary, whatever they are called.

trimesh reads lists of one length only, refuses bytes after the last element, and silently drops what it does not know.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from .part import FormatError
from .text import as_utf8, numbers

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "int64": "i8", "uint64": "u8",
    "float16": "f2", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class Property(NamedTuple):
    name: str
    type: np.dtype
    length: np.dtype | None  # of the length of a list; None: one number


class Lists(NamedTuple):
    counts: np.ndarray  # (n,) int64
    values: np.ndarray  # those of all rows, one after the other


class Element(NamedTuple):
    name: str
    size: int  # how many rows
    properties: list[Property]
    columns: dict[str, np.ndarray | Lists]  # by name of the property: (size,), or lists


class Header(NamedTuple):
    order: str  # of bytes, "<" or ">"; "" for text
    elements: list[Element]
    comments: list[str]
    start: int  # of the data


def read_header(data: bytes) -> Header:
    end = re.search(rb"end_header[ \t]*(\r\n|\n|\r|$)", data)
    if not data.startswith(b"ply") or end is None:
        raise FormatError("expected a PLY file from ply to end_header, which cannot be read here; it may be truncated")
    order, elements, comments = None, list[Element](), []
    for line in as_utf8(data[: end.start()]).decode(errors="replace").split("\n")[1:]:
        words = line.split()
        try:
            match words:
                case ["format", kind, *_]:
                    order = FORMATS[kind.lower()]
                case ["comment" | "obj_info", *_]:
                    comments.append(line.strip())
                case ["element", name, size]:
                    elements.append(Element(name, int(size), [], {}))
                case ["property", "list", count, kind, name]:
                    length = _type(count, order) if order else np.dtype("f8")
                    elements[-1].properties.append(Property(name, _type(kind, order), length))
                case ["property", kind, name]:
                    elements[-1].properties.append(Property(name, _type(kind, order), None))
                case [_, *_]:
                    raise ValueError
        except (ValueError, KeyError, IndexError):
            raise FormatError(
                f"expected a line of a PLY header, got {line.strip()!r}, which cannot be read; repair it"
            ) from None
    if order is None or any(element.size < 0 for element in elements):
        raise FormatError(
            "expected a PLY header with its format and sizes of elements, got one that cannot be read; repair it"
        )
    return Header(order, elements, comments, end.end())


def _type(name: str, order: str | None) -> np.dtype:
    return np.dtype((order or "") + TYPES[name])


def read_elements(data: bytes, header: Header) -> int:
    """Fill the columns of all elements, and return how many bytes, or numbers of a text, come after the last. Raises
    FormatError."""
    if header.order:
        units: _BinaryData | _TextData = _BinaryData(np.frombuffer(data, np.uint8)[header.start :])
    else:
        units = _TextData(numbers(as_utf8(data[header.start :]), "a PLY file"))
    at = 0
    for element in header.elements:
        at = _read(element, units, at)
    return len(units.array) - at


class _BinaryData(NamedTuple):
    array: np.ndarray

    def width(self, kind: np.dtype) -> int:
        return kind.itemsize

    def cast(self, units: np.ndarray, kind: np.dtype) -> np.ndarray:
        return np.ascontiguousarray(units).reshape(-1).view(kind)


class _TextData(NamedTuple):
    array: np.ndarray

    def width(self, kind: np.dtype) -> int:
        return 1

    def cast(self, units: np.ndarray, kind: np.dtype) -> np.ndarray:
        units = units.reshape(-1)
        if kind.kind == "f":
            return units  # stay double, for a text may say more than its header does
        if not (np.isfinite(units).all() and (units == np.floor(units)).all()):
            raise FormatError("expected whole numbers where the header announces integers, got others; repair it")
        return units.astype(np.int64).astype(kind)


def _read(element: Element, data: _BinaryData | _TextData, at: int) -> int:
    """Read one element that begins at `at`, and return where the next one does. Raises FormatError."""
    n, columns, room = element.size, element.properties, len(data.array) - at
    least = sum(data.width(p.length or p.type) for p in columns)
    if n * least > room:  # before anything of this size is made
        raise _truncated(element, room // max(least, 1))
    if n and (end := _read_even(element, data, at)):
        return end
    where, counts = np.empty((n, len(columns)), np.int64), np.ones((n, len(columns)), np.int64)
    widths = [data.width(p.type) for p in columns]
    for row in range(n):
        for c, p in enumerate(columns):
            if p.length is not None:
                counts[row, c] = length = _length(element, row, data, at, p.length)
                at += data.width(p.length)
            else:
                length = 1
            where[row, c] = at
            at += length * widths[c]
    if at > len(data.array):
        raise _truncated(element, n - 1)
    for c, p in enumerate(columns):
        values = data.cast(data.array[_spans(where[:, c], counts[:, c] * widths[c])], p.type)
        element.columns[p.name] = values if p.length is None else Lists(counts[:, c], values)
    return at


def _read_even(element: Element, data: _BinaryData | _TextData, at: int) -> int | None:
    """Read as _read() does, at once, where the lists of all rows are as long as those of the first; else return None."""
    n, width, lengths, begins = element.size, 0, [], []
    for p in element.properties:
        lengths.append(1 if p.length is None else _length(element, 0, data, at + width, p.length))
        begins.append(width + (0 if p.length is None else data.width(p.length)))
        width = begins[-1] + lengths[-1] * data.width(p.type)
    end = at + n * width
    if end > len(data.array):
        return None
    rows = data.array[at:end].reshape(n, width)
    for p, length, begin in zip(element.properties, lengths, begins, strict=True):
        if (
            p.length is not None
            and (data.cast(rows[:, begin - data.width(p.length) : begin], p.length) != length).any()
        ):
            return None
    for p, length, begin in zip(element.properties, lengths, begins, strict=True):
        values = data.cast(rows[:, begin : begin + length * data.width(p.type)], p.type)
        element.columns[p.name] = values if p.length is None else Lists(np.full(n, length), values)
    return end


def _length(element: Element, row: int, data: _BinaryData | _TextData, at: int, kind: np.dtype) -> int:
    width, room = data.width(kind), len(data.array) - at
    if width > room:
        raise _truncated(element, row)
    value = data.array.item(at) if width == 1 else data.cast(data.array[at : at + width], kind).item()
    if not 0 <= value <= room or value != int(value):
        raise FormatError(
            f"expected the length of a list in row {row} of {element.name}, got {value:g}; the file cannot be read"
        )
    return int(value)


def _truncated(element: Element, found: int) -> FormatError:
    return FormatError(
        f"expected {element.size} rows of {element.name}, as the header announces, got {found}; the file cannot be read "
        "as a whole, for it is truncated or damaged"
    )


def _spans(starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the numbers from starts[i] up to starts[i] + counts[i], one span after the other."""
    ends = np.cumsum(counts)
    return np.arange(counts.sum()) + (starts - ends + counts).repeat(counts)
