"""The loop that all optimisers share: it advances them until they rest, and keeps a state to go on from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from .progress import Progress, nothing


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
