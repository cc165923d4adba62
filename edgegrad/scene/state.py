"""Dataclasses of tensors as plain dictionaries, which torch.load(weights_only=True) reads."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

from torch import Tensor

T = TypeVar("T")

VERSION = 1  # of the layout, kept under the key "version"


def to_state(thing: Any, classes: tuple[type, ...], name: str = "state") -> dict[str, Any]:
    """Return the fields of a dataclass by name, without those that are None, and its class under "type".

    Dataclasses among `classes` become dictionaries, sequences lists; tensors are detached and share their memory. Raises
    TypeError for any other class.
    """
    return {"version": VERSION, **_as_dictionary(thing, classes, name)}


def _as_dictionary(thing: Any, classes: tuple[type, ...], name: str) -> Any:
    if isinstance(thing, Tensor):
        return thing.detach()
    if isinstance(thing, (list, tuple)):
        return [_as_dictionary(part, classes, f"{name}[{i}]") for i, part in enumerate(thing)]
    if isinstance(thing, (str, int, float)):
        return thing
    if type(thing) not in classes:
        raise TypeError(
            f"{name}: expected one of {_names(classes)}, got {type(thing).__name__}; torch.save() of the whole object keeps it"
        )
    fields = {f.name: getattr(thing, f.name) for f in dataclasses.fields(thing)}
    parts = {key: _as_dictionary(part, classes, f"{name}.{key}") for key, part in fields.items() if part is not None}
    return {"type": type(thing).__name__, **parts}


def from_state(state: Any, kind: type[T], classes: tuple[type, ...]) -> T:
    """Return the `kind` that to_state() was given. Raises TypeError or ValueError."""
    if not isinstance(state, Mapping):
        raise TypeError(f"state: expected a dictionary of {kind.__name__}.state_dict(), got {type(state).__name__}")
    if (version := state.get("version")) != VERSION:
        raise ValueError(f"state: expected version {VERSION}, got {version!r}; load it with the edgegrad that saved it")
    if (given := state.get("type")) != kind.__name__:
        raise ValueError(f"state: expected the type {kind.__name__}, got {given!r}")
    return _whole({key: part for key, part in state.items() if key != "version"}, classes, "state")


def _whole(state: Any, classes: tuple[type, ...], name: str) -> Any:
    if isinstance(state, (list, tuple)):
        return tuple(_whole(part, classes, f"{name}[{i}]") for i, part in enumerate(state))
    if not isinstance(state, Mapping):
        return state
    kind = next((kind for kind in classes if kind.__name__ == state.get("type")), None)
    if kind is None:
        raise ValueError(f"{name}: expected a type among {_names(classes)}, got {state.get('type')!r}")
    given = {key: _whole(part, classes, f"{name}.{key}") for key, part in state.items() if key != "type"}
    fields = {field.name: field for field in dataclasses.fields(kind)}
    unset = dataclasses.MISSING
    needed = {key for key, f in fields.items() if f.default is unset and f.default_factory is unset}
    for wrong, keys in (("missing", needed - set(given)), ("unexpected", set(given) - set(fields))):
        if keys:
            raise ValueError(
                f"{name}: expected the keys of a {kind.__name__}, {wrong}: {', '.join(sorted(map(str, keys)))}"
            )
    return kind(**given)


def _names(classes: tuple[type, ...]) -> str:
    return ", ".join(kind.__name__ for kind in classes)
