"""Files of keys and values: YAML by PyYAML, OpenCV's too, and OpenCV's XML; and a record of the keys that nobody read.

OpenCV's own reader is not used, because it ends the process where a file is damaged.
"""

from __future__ import annotations

import base64
import operator
import re
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ...optional import require
from .context import UnreadLog
from .part import FormatError

MOST_NUMBERS = 1 << 20  # of a matrix; YAML's references announce more than they hold
MOST_PIXELS = 1 << 24  # on a side
ELEMENT = re.compile(r"([1-4]?)([ucwsifdh])")  # of OpenCV's matrices: how many channels, and their type
TYPES = {"u": "u1", "c": "i1", "w": "<u2", "s": "<i2", "i": "<i4", "f": "<f4", "d": "<f8", "h": "<f2"}
HEADER = 24  # bytes before the numbers of binary data, with the type in text
VERSION = re.compile(r"(?m)^\ufeff?%YAML:.*$")  # OpenCV's first line, which is no directive of YAML


def read_keys(file: Path) -> dict[str, Any]:
    """Return numbers, text, lists and dicts, also of matrices. Raises FormatError or ImportError."""
    if file.suffix.lower() == ".xml":
        return _read_xml(file.read_bytes())
    yaml: Any = require("yaml", "edgegrad[cameras]", "reading YAML")
    loader = type("Loader", (yaml.SafeLoader,), {})
    loader.add_multi_constructor(
        "tag:yaml.org,2002:opencv-", lambda loader, _, node: loader.construct_mapping(node, deep=True)
    )
    text = VERSION.sub("", file.read_text(encoding="utf-8", errors="replace"), count=1)
    try:
        # The first of several documents counts: `ros2 topic echo` ends a message of ROS by ---.
        found = next((document for document in yaml.load_all(text, loader) if document is not None), None)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise FormatError(
            f"expected YAML, got a file that PyYAML does not read ({' '.join(str(error).split())})"
        ) from error
    if not isinstance(found, dict):
        raise FormatError(f"expected YAML or XML of keys and values, got {type(found).__name__}")
    return {str(key): value for key, value in found.items() if value is not None}


def _read_xml(data: bytes) -> dict[str, Any]:
    try:
        root = ElementTree.fromstring(data)
        found = _value(root) if root.tag == "opencv_storage" else None
    except (ElementTree.ParseError, ValueError, LookupError, RecursionError) as error:
        raise FormatError(f"expected XML of cv2.FileStorage, got a file that cannot be read ({error})") from error
    if not isinstance(found, dict):
        raise FormatError(f"expected XML of cv2.FileStorage with keys and values, got {root.tag!r} without")
    return found


def _value(element: ElementTree.Element) -> Any:
    if len(element):
        if all(inner.tag == "_" for inner in element):
            return [_value(inner) for inner in element]
        return {inner.tag: _value(inner) for inner in element}
    words = (element.text or "").split()
    if element.get("type_id") == "binary":
        return base64.b64decode("".join(words))
    try:
        values = [int(word) if word.lstrip("+-").isdecimal() else float(word) for word in words]
    except ValueError:
        return (element.text or "").strip().strip('"')
    return values[0] if len(values) == 1 and element.tag not in ("data", "sizes") else values


def matrix(name: str, value: object) -> np.ndarray:
    """Return (rows, columns) float64 of OpenCV's or ROS's matrices, or of lists; a single list is a row. Raises FormatError."""
    try:
        if isinstance(value, dict):
            sides = _unpacked(value["sizes"]) if "sizes" in value else [value["rows"], value["cols"]]
            shape = [operator.index(side) for side in sides]
            kind = ELEMENT.fullmatch(str(value.get("dt", "d")))
            if min(shape) < 0 or kind is None:  # reshape() would choose negative ones
                raise ValueError(f"{' × '.join(map(str, shape))} of {value.get('dt', 'numbers')}")
            channels = [int(kind[1])] if kind[1] else []
            return np.array([float(x) for x in _unpacked(value["data"])]).reshape(*shape, *channels)
        rows: Any = value if isinstance(value, list) and value and isinstance(value[0], list) else [value]
        if sum(map(len, rows)) > MOST_NUMBERS:
            raise ValueError("too many numbers")
        return np.array([[float(x) for x in row] for row in rows])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FormatError(
            f"{name}: expected a matrix of OpenCV, or rows, cols and data, or a list of rows, got something else ({error})"
        ) from error


def _unpacked(value: Any) -> Any:
    """Return the numbers of OpenCV's binary data, others as they are."""
    if not isinstance(value, bytes):
        return value
    return np.frombuffer(value, TYPES[value[:HEADER].decode().strip()[-1:]], offset=HEADER).tolist()


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
    if isinstance(value, dict):
        return all(map(_says_nothing, [value["data"]] if "data" in value else value.values()))
    if isinstance(value, bytes):
        return not any(value[HEADER:])
    return all(_says_nothing(one) for one in value) if isinstance(value, list) else not value
