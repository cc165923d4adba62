"""Files of keys and values: OpenCV's YAML and XML by OpenCV, other YAML by PyYAML; and a record of the keys that nobody
read."""

from __future__ import annotations

import math
import re
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...optional import require
from .context import UnreadLog
from .part import FormatError

MOST_NUMBERS = 1 << 20  # of a matrix; YAML's references announce more than they hold
MOST_PIXELS = 1 << 24  # on a side
DEEP = 1000
INDENT = re.compile(rb"(?<![ \t?-])[ \t?-]{1000}")
ELEMENT = re.compile(r"([1-4]?)[ucwsifdh]")  # of OpenCV's matrices: how many channels, and their type
OPENCV = ("%YAML:", "opencv-matrix", "opencv_storage")  # in files of cv2.FileStorage


def read_keys(file: Path) -> dict[str, Any]:
    """Return numbers, text, lists, dicts and, from OpenCV, arrays. Raises FormatError or ImportError."""
    text = file.read_text(encoding="utf-8", errors="replace")
    if file.suffix.lower() == ".xml" or any(mark in text for mark in OPENCV):
        if _is_deep(text.encode()):  # on which OpenCV ends the process
            raise FormatError(f"expected a calibration, got lists or keys inside one another more than {DEEP} times")
        return _of_opencv(file)
    yaml = require("yaml", "edgegrad[cameras]", "reading YAML")
    try:
        # The first of several documents counts: `ros2 topic echo` ends a message of ROS by ---.
        found = next((document for document in yaml.safe_load_all(text) if document is not None), None)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise FormatError(
            f"expected YAML, got a file that PyYAML does not read ({' '.join(str(error).split())})"
        ) from error
    if not isinstance(found, dict):
        raise FormatError(f"expected YAML or XML of keys and values, got {type(found).__name__}")
    return {str(key): value for key, value in found.items() if value is not None}


def _of_opencv(file: Path) -> dict[str, Any]:
    cv2: Any = require("cv2", "edgegrad[cameras]", "reading OpenCV's calibrations")
    try:
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
        root = storage.root()
        return _value(root) if root.isMap() else {}
    except (cv2.error, SystemError, RecursionError) as error:
        raise FormatError("expected YAML or XML of cv2.FileStorage, got a file that OpenCV does not read") from error


def _is_deep(text: bytes) -> bool:
    """Return whether values nest too deeply, by brackets, by tags, or by the indentation of YAML."""
    letters = np.frombuffer(text + b" ", np.uint8)
    first, second = letters[:-1], letters[1:]
    brackets = np.isin(first, list(b"[{")).astype(np.int64) - np.isin(first, list(b"]}"))
    tag, slash = first == ord("<"), ord("/")
    tags = (tag & ~np.isin(second, list(b"/!?"))).astype(np.int64) - (tag & (second == slash))
    tags -= (first == slash) & (second == ord(">"))
    return max(brackets.cumsum().max(), tags.cumsum().max()) > DEEP or INDENT.search(text) is not None


def _value(node: Any) -> Any:
    if node.isSeq():
        return [_value(node.at(i)) for i in range(node.size())]
    if node.isMap():
        names = node.keys()
        return _matrix(node) if {"dt", "data"} <= set(names) else {n: _value(node.getNode(n)) for n in names}
    return node.string() if node.isString() else node.real() if node.isInt() or node.isReal() else None


def _matrix(node: Any) -> np.ndarray:
    """Return a matrix, whose size is checked first because OpenCV writes past its memory where numbers do not match."""
    shape, data, dt = node.getNode("sizes"), node.getNode("data"), node.getNode("dt")
    sides = [shape.at(i) for i in range(shape.size())] if shape.isSeq() else [node.getNode(n) for n in ("rows", "cols")]
    known = ELEMENT.fullmatch(dt.string()) if dt.isString() else None
    count = data.size() if data.isSeq() else int(data.isInt() or data.isReal())
    sizes = [node.real() if node.isInt() else -1.0 for node in sides]
    if known is None or min(sizes, default=-1.0) < 0 or math.prod(sizes) * int(known[1] or 1) != count:
        shown = " × ".join(f"{size:g}" if size >= 0 else "?" for size in sizes)
        raise FormatError(
            f"{node.name()}: expected rows, cols and dt of a matrix of OpenCV and as many numbers, got {shown}, dt "
            f"{dt.string() if dt.isString() else 'none'!r} and {count} numbers; save it again by cv2.FileStorage"
        )
    return node.mat() if count else np.zeros((0, 0))


def matrix(name: str, value: object) -> np.ndarray:
    """Return (rows, columns) float64 of OpenCV's or ROS's matrices, or of lists; a single list is a row. Raises FormatError."""
    try:
        if isinstance(value, np.ndarray):
            return value.astype(np.float64)
        if isinstance(value, dict):
            flat, shape = value["data"], (int(value["rows"]), int(value["cols"]))
            if min(shape) < 0:  # which reshape() would choose
                raise ValueError(f"{shape[0]} rows and {shape[1]} columns")
            return np.array([float(x) for x in flat]).reshape(shape)
        rows: Any = value if isinstance(value, list) and value and isinstance(value[0], list) else [value]
        if sum(map(len, rows)) > MOST_NUMBERS:
            raise ValueError("too many numbers")
        return np.array([[float(x) for x in row] for row in rows])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FormatError(
            f"{name}: expected a matrix of OpenCV, or rows, cols and data, or a list of rows, got something else ({error})"
        ) from error


def image_size(width: float, height: float) -> tuple[int, int]:
    if not all(0 < side <= MOST_PIXELS and side == round(side) for side in (width, height)):  # nor NaN
        raise FormatError(f"size: expected whole numbers of pixels, got width {width:g} and height {height:g}")
    return round(height), round(width)


def note_unread(
    fields: Mapping[str, Any], known: Container[str], unread: UnreadLog, instead: Mapping[str, str] | None = None
) -> None:
    """Note the keys that are not known, unless their values are null, zeros or empty."""
    for key, value in fields.items():
        if key not in known and not _says_nothing(value):
            unread.note(key, (instead or {}).get(key, "left out"))


def _says_nothing(value: object) -> bool:
    if isinstance(value, np.ndarray):
        return not value.any()
    if isinstance(value, dict):
        return all(_says_nothing(one) for one in value.values())
    return all(_says_nothing(one) for one in value) if isinstance(value, list) else not value
