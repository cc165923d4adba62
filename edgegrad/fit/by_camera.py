"""Arguments of fits that have an entry for each camera: one, a list, or an array with one more dimension."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..check import shape_text


def one_for_each(name: str, given: Any, count: int, dims: int) -> list[Any]:
    """Return one for each of `count` cameras: of a list, of an array with more than `dims` dimensions, or the one of the one
    camera. Raises ValueError."""
    if given is None:
        return [None] * count
    shape = getattr(given, "shape", None)
    if shape is None:
        several = isinstance(given, Sequence) and not isinstance(given, str)
    else:  # (H, W, 1) is one mask.
        one = len(shape) == 3 and len(given) != count and (count == 1 or shape[-1] == 1)
        several = len(shape) > dims and not one
    each = list(given) if several else [given]
    if len(each) != count:
        got = str(len(each)) if shape is None else f"{len(each)} in shape {shape_text(shape)}"
        fix = "give as many cameras" if count == 1 else "give a list of them, with None where a camera has none"
        raise ValueError(f"{name}: expected {count}, one for each camera, got {got}; {fix}")
    return each


def numbered(name: str, k: int, count: int) -> str:
    """Return the name of an argument's entry k, in messages."""
    return name if count == 1 else f"{name}[{k}]"
