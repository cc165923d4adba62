"""The journal of a search: how far each way down has come, and the numbers that decided between them.

A search that goes on runs from its beginning and takes the same turns, for it reads from its journal what it found there
before: only the last way is followed further. The journal is true after every step, whenever the search is stopped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .pose import Pose
from .result import Step


class Way(NamedTuple):
    """How far the steps from one start on one level have come."""

    pose: Pose  # where the next step is observed
    here: Pose  # the last accepted one
    lowest: float  # loss so far, of this way and those that it is ranked with
    c: float = math.inf  # of the loss
    short: bool = False  # the last step
    still: bool = False  # whether it was so short, for whatever reason, that it led to the same place
    done: bool = False
    steps: tuple[Step, ...] = ()
    search: Mapping[str, Any] = MappingProxyType({})  # the state of Gauss-Newton
    random: Tensor = torch.empty(0)  # that of the generator


class Journal:
    """Ways and numbers in the order in which a search asks for them."""

    def __init__(self, saved: dict[str, Any] | None = None) -> None:
        saved = saved or {"ways": [], "numbers": []}
        self.ways = [_unpacked(way) for way in saved["ways"]]
        self._numbers: list[list[float]] = list(saved["numbers"])
        self._read = self._entered = 0

    @property
    def steps(self) -> int:
        return sum(len(way.steps) for way in self.ways)

    def entered(self) -> Way | None:
        """The next way as far as it has come before; None where it begins now."""
        self._entered += 1
        return self.ways[self._entered - 1] if self._entered <= len(self.ways) else None

    def keep(self, way: Way) -> None:
        """What the way that was entered last has come to."""
        self.ways[self._entered - 1 :] = [way]

    def numbers(self, compute: Callable[[], list[float]]) -> list[float]:
        """The next numbers, computed where they are not known yet."""
        self._read += 1
        if self._read > len(self._numbers):
            self._numbers.append(compute())
        return self._numbers[self._read - 1]

    def state(self) -> dict[str, Any]:
        """All of it in tensors and plain values."""
        return {"ways": [_packed(way) for way in self.ways], "numbers": list(self._numbers)}


def _packed(way: Way) -> dict[str, Any]:
    steps = [(step.size, step.loss, step.pose.numbers, step.best, dict(step.gradient)) for step in way.steps]
    return {
        **way._asdict(),
        "pose": way.pose.numbers,
        "here": way.here.numbers,
        "steps": steps,
        "search": dict(way.search),
    }


def _unpacked(packed: dict[str, Any]) -> Way:
    steps = tuple(Step(size, loss, Pose.from_numbers(pose), *rest) for size, loss, pose, *rest in packed["steps"])
    pose, here = (Pose.from_numbers(packed[name]) for name in ("pose", "here"))
    return Way(**{**packed, "pose": pose, "here": here, "steps": steps})
