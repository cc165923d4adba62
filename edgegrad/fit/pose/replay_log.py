"""The log of a search, from which it is replayed after an interruption.

A resumed search runs from its beginning and reads earlier descents and decisive numbers from the log, so it takes the same
turns; only the last descent continues. The log is valid after every step.
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


class DescentState(NamedTuple):
    """The state of the steps from one start on one level."""

    pose: Pose  # evaluated next
    here: Pose  # accepted last
    lowest: float  # lowest loss so far, also of the descents it is ranked with
    c: float = math.inf  # width of the robust loss
    short: bool = False  # The last step was short.
    still: bool = False  # It was short even if damping is the reason.
    done: bool = False
    steps: tuple[Step, ...] = ()
    search: Mapping[str, Any] = MappingProxyType({})  # state of Gauss-Newton
    random: Tensor = torch.empty(0)  # state of the generator


class ReplayLog:
    """Descents and numbers in the order in which a search asks for them."""

    def __init__(self, saved: dict[str, Any] | None = None) -> None:
        saved = saved or {"descents": [], "numbers": []}
        self.descents = [_unpacked(state) for state in saved["descents"]]
        self._numbers: list[Any] = list(saved["numbers"])
        self._read = self._entered = 0

    @property
    def steps(self) -> int:
        return sum(len(state.steps) for state in self.descents)

    def next_descent(self) -> DescentState | None:
        """Return the logged state of the next descent, or None where it begins now."""
        self._entered += 1
        return self.descents[self._entered - 1] if self._entered <= len(self.descents) else None

    def record(self, state: DescentState) -> None:
        """Record the state of the descent that was entered last."""
        self.descents[self._entered - 1 :] = [state]

    def replay(self, compute: Callable[[], Any]) -> Any:
        """Return the next numbers, or dictionaries and lists of them, which are computed unless the log has them."""
        self._read += 1
        if self._read > len(self._numbers):
            self._numbers.append(compute())
        return self._numbers[self._read - 1]

    def state(self) -> dict[str, Any]:
        """Return the whole log as tensors and plain values."""
        return {"descents": [_packed(state) for state in self.descents], "numbers": list(self._numbers)}


def _packed(state: DescentState) -> dict[str, Any]:
    steps = [(step.size, step.loss, step.pose.numbers, step.best, dict(step.gradient)) for step in state.steps]
    poses = {"pose": state.pose.numbers, "here": state.here.numbers}
    return {**state._asdict(), **poses, "steps": steps, "search": dict(state.search)}


def _unpacked(packed: dict[str, Any]) -> DescentState:
    steps = tuple(Step(size, loss, Pose.from_numbers(pose), *rest) for size, loss, pose, *rest in packed["steps"])
    return DescentState(
        **{
            **packed,
            "pose": Pose.from_numbers(packed["pose"]),
            "here": Pose.from_numbers(packed["here"]),
            "steps": steps,
        }
    )
