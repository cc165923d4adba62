"""Dataclasses of tensors that hold one another: scenes hold meshes and lights, meshes materials, materials textures."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


def tensors_in(thing: Any) -> Iterator[Tensor]:
    """All tensors of a dataclass, and of those within."""
    if isinstance(thing, Tensor):
        yield thing
    elif isinstance(thing, (tuple, list)):
        for part in thing:
            yield from tensors_in(part)
    elif dataclasses.is_dataclass(thing):
        for field in dataclasses.fields(thing):
            yield from tensors_in(getattr(thing, field.name))


def named_tensors(thing: Any, name: str = "") -> Iterator[tuple[str, Tensor]]:
    """All tensors with the way to them, fields and places joined by dots: "meshes.0.verts"."""
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
    """With the tensors of these names, as named_tensors() has them, replaced. Raises KeyError for a name that it lacks."""
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
    """The dataclass with `function` of each tensor in it; itself where all are as they were."""
    return _mapped(thing, function)


def moved(thing: T, *args: Any, **kwargs: Any) -> T:
    """With all tensors on a device, and those of floating point also of a dtype, as torch.Tensor.to()."""

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
        return thing if same else type(thing)(parts)
    if not dataclasses.is_dataclass(thing) or isinstance(thing, type):
        return thing
    fields = {}
    for field in dataclasses.fields(thing):
        old = getattr(thing, field.name)
        if (new := _mapped(old, function)) is not old:
            fields[field.name] = new
    return dataclasses.replace(thing, **fields) if fields else thing
