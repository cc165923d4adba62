"""The context of all loops of steps: a bar on standard error, a clock, Ctrl-C, and times to keep the state."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

from tqdm import tqdm


def nothing(*_: Any) -> None:
    """Do nothing after a step, or with a state."""


@dataclass
class Progress:
    """The context in which a fit takes its steps. Ctrl-C ends it, and `interrupted` says so afterwards.

    title       of the bar; None: there is none
    after_step  called after each step
    keep        called every `every` steps, where that is not None
    total       number of steps, where it is known
    steps       number of steps so far; before the context, those of the state from which the fit goes on
    earlier     seconds until that state
    """

    title: str | None = None
    after_step: Callable[[], Any] = nothing
    keep: Callable[[], Any] = nothing
    every: int | None = None
    total: int | None = None
    steps: int = 0
    earlier: float = 0.0
    interrupted: bool = False
    began: float = field(default_factory=time.perf_counter)

    @property
    def seconds(self) -> float:
        """The seconds since this object was made, and those until the saved state."""
        return self.earlier + time.perf_counter() - self.began

    def __enter__(self) -> Progress:
        self.bar = tqdm(
            total=self.total, initial=self.steps, desc=self.title, unit="step", disable=self.title is None, leave=False
        )
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> bool:
        self.bar.close()
        self.interrupted = kind is not None and issubclass(kind, KeyboardInterrupt)
        return self.interrupted

    def step(self, words: str) -> None:
        """Count a step, with its state in words on the bar."""
        self.steps += 1
        self.bar.set_postfix_str(words, refresh=False)
        if self.total is not None and self.steps > self.total:
            self.bar.total = None  # The number of further steps is not known.
        self.bar.update()
        self.after_step()
        if self.every is not None and self.steps % self.every == 0:
            self.keep()
