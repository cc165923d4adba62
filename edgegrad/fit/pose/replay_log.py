"""The log of a search, from which it is replayed after an interruption.

A search is deterministic: what it evaluates follows from its arguments and from earlier values. A resumed one runs from its
beginning, and reads from the log what was evaluated before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor

from ...optim.levenberg_marquardt import Model, Problem
from ..placement import Pose


class ReplayLog:
    """Values in the order in which a search asks for them: numbers, tensors, and lists of them."""

    def __init__(self, values: Sequence[Any] = ()) -> None:
        self.values, self._given = list(values), len(values)
        self._read = 0

    @property
    def replaying(self) -> bool:
        """Whether the last value was read from the log that the search was given."""
        return 0 < self._read <= self._given

    def replay(self, compute: Callable[[], Any]) -> Any:
        """Return the next value, which is computed unless the log has it."""
        if self._read == len(self.values):
            self.values.append(compute())
        self._read += 1
        return self.values[self._read - 1]


class Replayed(Problem[Pose]):
    """A problem whose models a log keeps."""

    def __init__(self, problem: Problem[Pose], log: ReplayLog) -> None:
        self.problem, self.log = problem, log

    def model(self, points: Sequence[Pose]) -> Model:
        return Model(*self.log.replay(lambda: list(self.problem.model(points))))

    def moved(self, points: Sequence[Pose], steps: Tensor) -> list[Pose]:
        return self.problem.moved(points, steps)
