"""Descents in named tensors: what Adam and Levenberg-Marquardt share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from .convergence import Settling
from .loop import Progress, nothing
from .parameter import Parameter

COMPARISON_STEP = 2**20  # The first that gives losses which are compared their samples: no descent reaches it.
MAX_RECORDED = 64  # numbers of a parameter whose values the history holds
Tensors = Mapping[str, Tensor]


class Record(NamedTuple):
    """One step of a descent in named tensors."""

    step: int
    loss: float  # of this step's samples
    gradient: dict[str, float]  # norm of the gradient by each parameter
    values: dict[str, Tensor]  # of parameters of up to 64 numbers, before the step
    rate: float = 1.0  # factor of the learning rates


class Ending(Enum):
    """Why a fit took no more steps."""

    FLAT = "the steps led no further"
    STEPS = "steps ran out"
    FALLING = "loss still falling"
    INTERRUPTED = "interrupted"


class Objective:
    """A loss of named tensors, by samples of its own in each step."""

    renewal_steps: int | None = None  # from one renew() to the next; None: nothing is held fixed
    sample_sets: int = 2  # by which losses are compared
    provisional: bool = False  # whether later steps have another loss, at which alone a descent may rest

    def __call__(self, tensors: Tensors, step: int) -> Tensor:
        """Return the loss."""
        raise NotImplementedError

    def renew(self, tensors: Tensors, step: int) -> None:
        """Compute what the loss holds fixed between steps at these values."""


class TensorDescent:
    """The state of a descent: its tensors, the best ones so far, and whether steps still lead down."""

    saved: ClassVar[tuple[str, ...]] = ("steps", "resting", "renewed")  # attributes in checkpoints
    settling: Settling  # of the loss, which says whether more steps would lower it

    def __init__(self, objective: Objective, parameters: Mapping[str, Parameter]) -> None:
        self.objective, self.parameters = objective, parameters
        self.values = {name: p.value.clone().requires_grad_() for name, p in parameters.items() if p.value is not None}
        self.history: list[Record] = []
        self.steps, self.resting = 0, False
        self.renewed: tuple[int, dict[str, Tensor]] | None = None  # step and values of the objective's last renewal

    def advance(self) -> None:
        """Take one step, and add a record of the point where it began."""
        raise NotImplementedError

    @property
    def best(self) -> dict[str, Tensor]:
        """The result so far."""
        raise NotImplementedError

    @property
    def loss(self) -> float:
        """The loss of the last record."""
        return self.history[-1].loss

    def ending(self, interrupted: bool) -> Ending:
        if interrupted:
            return Ending.INTERRUPTED
        falling = self.settling.points > 1 and self.settling.settled == 0
        return Ending.FLAT if self.resting else Ending.FALLING if falling else Ending.STEPS

    def renew_objective(self, values: Tensors) -> bool:
        """Renew what the objective holds fixed, if it is due. Return whether losses stop being comparable by that."""
        period, last = self.objective.renewal_steps, self.renewed
        if period is None or (last is not None and self.steps < last[0] + period):
            return False
        self.renewed = self.steps, detached(values)
        self.objective.renew(self.renewed[1], self.steps)
        return True

    @torch.no_grad()
    def set(self, values: Tensors) -> None:
        """Take these values, clamped to their bounds."""
        for name, value in self.within(values).items():
            self.values[name].copy_(value)

    def within(self, values: Tensors) -> dict[str, Tensor]:
        """Return values clamped to their bounds."""
        return {name: self.parameters[name].within(values[name]) for name in self.values}

    @torch.no_grad()
    def compared(self, values: Tensors) -> Tensor:
        """Return losses (S,) by the same samples at all values."""
        sets = range(self.objective.sample_sets)
        return torch.stack([self.objective(values, COMPARISON_STEP + k).double() for k in sets])

    def record(self, loss: float, norms: dict[str, float], rate: float = 1.0) -> None:
        """Add a record of the present values to the history, and count the step."""
        small = {n: v.detach().clone() for n, v in self.values.items() if v.numel() <= MAX_RECORDED}
        self.history.append(Record(self.steps, loss, norms, small, rate))
        self.steps += 1

    def state(self) -> dict[str, Any]:
        own = {name: getattr(self, name) for name in self.saved}
        return {**own, "values": detached(self.values), "history": [tuple(record) for record in self.history]}

    def load(self, state: Mapping[str, Any]) -> None:
        for name in self.saved:
            setattr(self, name, state[name])
        self.history = [Record(*record) for record in state["history"]]
        self.set(state["values"])
        if self.renewed is not None:
            self.objective.renew(self.renewed[1], self.renewed[0])


class DescentResult(NamedTuple):
    """The result of descend()."""

    values: dict[str, Tensor]  # the best
    history: list[Record]
    seconds: float
    ending: Ending


def descend(
    descent: TensorDescent, steps: int, after_step: Callable[[], Any] = nothing, *,
    save: Callable[[dict[str, Any]], Any] = nothing, every: int | None = None, saved: Mapping[str, Any] | None = None,
    title: str | None = None,
) -> DescentResult:  # fmt: skip
    """Take at most so many steps, until they lead no further. Ctrl-C ends them with the best so far.

    save   called with a state every `every` steps and at the end; the state has the seconds so far
    saved  such a state to go on from; None: begin anew
    title  of the bar on standard error; None: there is none
    """
    progress = Progress(title, after_step, every=every, total=steps)
    if saved is not None:
        descent.load(saved)
        progress.earlier, progress.steps = saved["seconds"], descent.steps

    def keep() -> None:
        save({**descent.state(), "seconds": progress.seconds})

    progress.keep = keep
    with progress:
        while descent.steps < steps and not descent.resting:
            descent.advance()
            progress.step(f"loss {descent.loss:.3e}")
    keep()
    return DescentResult(descent.best, descent.history, progress.seconds, descent.ending(progress.interrupted))


def gradients_of(loss: Tensor, values: Tensors) -> dict[str, Tensor | None]:
    """Return the gradients by name, None by tensors on which the loss does not depend."""
    if not loss.requires_grad:  # None of the step's samples show what is sought.
        return dict.fromkeys(values)
    found = torch.autograd.grad(loss, list(values.values()), allow_unused=True)
    return dict(zip(values, found, strict=True))


def named(numbers: Tensor, like: Tensors, dtype: torch.dtype | None = None) -> dict[str, Tensor]:
    """Return numbers (n,) as tensors by name, by default of the types of those that they are like."""
    parts = numbers.split([value.numel() for value in like.values()])
    return {
        name: part.reshape(value.shape).to(dtype or value.dtype)
        for (name, value), part in zip(like.items(), parts, strict=True)
    }


def flat(tensors: Tensors) -> Tensor:
    """Return all numbers (n,) float64, one tensor after the other."""
    return torch.cat([tensor.detach().double().flatten() for tensor in tensors.values()])


def detached(values: Tensors) -> dict[str, Tensor]:
    """Return copies without gradients."""
    return {name: value.detach().clone() for name, value in values.items()}
