"""The JSON schema of glTF 2.0, by Khronos, and where a file departs from it."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ...optional import require
from .part import FormatError

TYPES: dict[str, Any] = {
    "object": dict,
    "array": list,
    "string": str,
    "number": (int, float),
    "integer": int,
    "boolean": bool,
}


@functools.cache
def schema() -> dict[str, Any]:
    """Return the schema of a whole file."""
    return require("trimesh.exchange.gltf", "trimesh", "reading meshes").get_schema()


def properties(schema: dict[str, Any]) -> dict[str, Any]:
    """Return the schemas of the properties of an object, by name."""
    found = dict(schema.get("properties", {}))
    for base in schema.get("allOf", ()):
        for name, inner in properties(base).items():
            found[name] = found.get(name) or inner  # a property that is only repeated is empty
    return found


@contextmanager
def explained(tree: dict[str, Any]) -> Iterator[None]:
    """Turn an error in the block into a FormatError that names the bad value by its path in the JSON, where the schema forbids
    one. Files are not held to the schema as long as they can be read."""
    try:
        yield
    except (FormatError, FileNotFoundError, ImportError):
        raise
    except Exception as error:
        for place, expected, got in _departures(tree, schema(), ""):
            raise FormatError(f"expected {expected} at {place}, got {got}; export it again") from error
        raise


def _departures(value: Any, schema: dict[str, Any], place: str) -> Iterator[tuple[str, str, str]]:
    """Yield (place, what was expected there, what came) for wrong types and missing values."""
    kind = _declared(schema, "type")
    if kind in TYPES and (not isinstance(value, TYPES[kind]) or (isinstance(value, bool) and kind != "boolean")):
        yield place, f"{'an' if kind[0] in 'aeio' else 'a'} {kind}", repr(value)[:60]
    elif isinstance(value, dict):
        known = properties(schema)
        for name in sorted(_required(schema)):
            if name not in value:
                yield f"{place}.{name}".lstrip("."), f"{_declared(known.get(name, {}), 'type') or 'a value'}", "none"
        for name, inner in value.items():
            if name in known or isinstance(schema.get("additionalProperties"), dict):
                below = known.get(name) or schema.get("additionalProperties") or {}
                yield from _departures(inner, below, f"{place}.{name}".lstrip("."))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from _departures(inner, schema.get("items", {}), f"{place}[{i}]")
    elif (least := _declared(schema, "minimum")) is not None and isinstance(value, (int, float)) and value < least:
        yield place, f"{least} or more", repr(value)


def _declared(schema: dict[str, Any], word: str) -> Any:
    """Return the value of a keyword in a schema, or in one that it builds on."""
    if word in schema:
        return schema[word]
    found = (_declared(base, word) for base in schema.get("allOf", ()))
    return next((value for value in found if value is not None), None)


def _required(schema: dict[str, Any]) -> set[str]:
    return set(schema.get("required", ())).union(*(_required(base) for base in schema.get("allOf", ())))
