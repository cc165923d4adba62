"""The loop that all optimisers share, with a bar on standard error, a clock, Ctrl-C, and a state to go on from."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Protocol

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


class Optimizer(Protocol):
    """An optimiser takes steps until they lead no further. Its state is all that they depend on, in tensors and plain
    values."""

    @property
    def steps(self) -> int: ...
    @property
    def resting(self) -> bool: ...
    @property
    def loss(self) -> float: ...
    def advance(self) -> Any: ...
    def state(self) -> dict[str, Any]: ...
    def load(self, state: Mapping[str, Any]) -> None: ...


@dataclass(frozen=True)
class Loop:
    """How run() runs.

    steps       largest number of steps
    after_step  called after each step
    save        called with a state every `every` steps and at the end; the state has the seconds so far
    saved       such a state to go on from; None: begin anew
    title       of the bar on standard error; None: there is none
    """

    steps: int
    after_step: Callable[[], Any] = nothing
    save: Callable[[dict[str, Any]], Any] = nothing
    every: int | None = None
    saved: Mapping[str, Any] | None = None
    title: str | None = None


def run(optimizer: Optimizer, loop: Loop) -> tuple[float, bool]:
    """Take steps until the optimizer rests or the steps run out. Ctrl-C ends the loop with what the optimizer has. Return the
    seconds, those before a saved state included, and whether Ctrl-C ended it."""
    progress = Progress(loop.title, loop.after_step, every=loop.every, total=loop.steps)
    if loop.saved is not None:
        optimizer.load(loop.saved)
        progress.earlier, progress.steps = loop.saved["seconds"], optimizer.steps

    def keep() -> None:
        loop.save({**optimizer.state(), "seconds": progress.seconds})

    progress.keep = keep
    with progress:
        while optimizer.steps < loop.steps and not optimizer.resting:
            optimizer.advance()
            progress.step(f"loss {optimizer.loss:.3e}")
    keep()
    return progress.seconds, progress.interrupted
