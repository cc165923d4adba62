"""Dataclasses of tensors that hold one another: scenes hold meshes and lights, meshes materials, materials textures."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


def tensors_in(thing: Any) -> Iterator[Tensor]:
    """Yield all tensors of a dataclass, and of those within."""
    if isinstance(thing, Tensor):
        yield thing
    elif isinstance(thing, (tuple, list)):
        for part in thing:
            yield from tensors_in(part)
    elif dataclasses.is_dataclass(thing):
        for field in dataclasses.fields(thing):
            yield from tensors_in(getattr(thing, field.name))


def named_tensors(thing: Any, name: str = "") -> Iterator[tuple[str, Tensor]]:
    """Yield all tensors with their paths, fields and places joined by dots: "meshes.0.verts"."""
    dot = f"{name}." if name else ""
    if isinstance(thing, Tensor):
        yield name, thing
    elif isinstance(thing, (tuple, list)):
        for i, part in enumerate(thing):
            yield from named_tensors(part, f"{dot}{i}")
    elif dataclasses.is_dataclass(thing):
        for field in dataclasses.fields(thing):
            yield from named_tensors(getattr(thing, field.name), f"{dot}{field.name}")


def with_named(thing: T, tensors: Mapping[str, Tensor]) -> T:
    """Replace the tensors of these names, which are named_tensors()'s. Raises KeyError for an unknown name."""
    return _with_named(thing, dict(tensors))


def _with_named(thing: Any, tensors: dict[str, Tensor]) -> Any:
    if "" in tensors:
        return tensors[""]
    inside: dict[str, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        first, _, rest = name.partition(".")
        inside.setdefault(first, {})[rest] = tensor
    if not inside:
        return thing
    if isinstance(thing, (tuple, list)):
        parts = list(thing)
        for first, below in inside.items():
            if not first.isdecimal() or int(first) >= len(parts):
                raise KeyError(first)
            parts[int(first)] = _with_named(parts[int(first)], below)
        return type(thing)(parts)
    if not dataclasses.is_dataclass(thing) or isinstance(thing, type):
        raise KeyError(next(iter(inside)))
    names = {field.name for field in dataclasses.fields(thing)}
    if missing := set(inside) - names:
        raise KeyError(missing.pop())
    return dataclasses.replace(
        thing, **{first: _with_named(getattr(thing, first), below) for first, below in inside.items()}
    )


def map_tensors(thing: T, function: Callable[[Tensor], Tensor]) -> T:
    """Return the dataclass with `function` applied to each tensor in it; itself where all are unchanged."""
    return _mapped(thing, function)


def moved(thing: T, *args: Any, **kwargs: Any) -> T:
    """Return all tensors on a device, and those of floating point also of a dtype, as torch.Tensor.to() does."""

    def to(tensor: Tensor) -> Tensor:
        if tensor.is_floating_point():
            return tensor.to(*args, **kwargs)
        return tensor.to(torch.empty(0).to(*args, **kwargs).device)

    return _mapped(thing, to)


def _mapped(thing: Any, function: Callable[[Tensor], Tensor]) -> Any:
    if isinstance(thing, Tensor):
        return function(thing)
    if isinstance(thing, (tuple, list)):
        parts = [_mapped(part, function) for part in thing]
        same = all(new is old for new, old in zip(parts, thing, strict=True))
        return thing if same else getattr(thing, "_make", type(thing))(parts)  # of a NamedTuple
    if not dataclasses.is_dataclass(thing) or isinstance(thing, type):
        return thing
    fields = {}
    for field in dataclasses.fields(thing):
        old = getattr(thing, field.name)
        if (new := _mapped(old, function)) is not old:
            fields[field.name] = new
    return dataclasses.replace(thing, **fields) if fields else thing


def savable(thing: T) -> T:
    """Copy tensors that were made in torch.inference_mode(), which autograd does not save, unless that mode is on."""
    if torch.compiler.is_compiling() or torch.is_inference_mode_enabled():
        return thing
    return _mapped(thing, lambda tensor: tensor.clone() if tensor.is_inference() else tensor)


def to_text(thing: Any, tensors: list[Tensor]) -> str:
    """Return all of a dataclass but its tensors, which are added to `tensors`, as JSON that torch.compile can trace."""
    if isinstance(thing, Tensor):
        tensors.append(thing)
        return f'{{"tensor": {len(tensors) - 1}}}'
    if isinstance(thing, (tuple, list)):
        return "[" + ", ".join([to_text(part, tensors) for part in thing]) + "]"
    if dataclasses.is_dataclass(thing):
        parts = [f'"{f.name}": {to_text(getattr(thing, f.name), tensors)}' for f in dataclasses.fields(thing)]
        return f'{{"{type(thing).__name__}": {{{", ".join(parts)}}}}}'
    if thing is None:
        return "null"
    if isinstance(thing, bool):
        return "true" if thing else "false"
    if isinstance(thing, (int, float)):
        return f"{thing}"
    escaped = thing.replace("\\", r"\\").replace('"', r"\"")
    return f'"{escaped}"'


def from_text(text: str, tensors: Sequence[Tensor], classes: Sequence[type]) -> Any:
    """Return the object that to_text() was given, of dataclasses among `classes`."""
    known = {kind.__name__: kind for kind in classes}

    def whole(thing: Any) -> Any:
        if isinstance(thing, list):
            return tuple(whole(part) for part in thing)
        if not isinstance(thing, dict):
            return thing
        ((kind, parts),) = thing.items()
        return tensors[parts] if kind == "tensor" else known[kind](**{n: whole(part) for n, part in parts.items()})

    return whole(json.loads(text, strict=False))
