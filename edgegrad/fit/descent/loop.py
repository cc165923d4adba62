"""The loop of a fit by descent: steps until they lead no further, and a state to go on from.

The loop knows nothing of what is fitted: an objective gives the loss of the parameters' values at a step. Steps are those of Adam
(adam_steps.py) or of Gauss and Newton (gauss_newton.py).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor
from tqdm import tqdm

from ..ending import Ending
from ..history import Record
from ..options import Options, Parameter
from .falls import Falls

SMALL = 64  # values of up to so many numbers are kept for each step
_PLAIN = ("best", "step", "seconds", "flat", "renewed")


class Loss(Protocol):
    """The objective of a descent, as the loop needs it."""

    def __call__(self, tensors: Mapping[str, Tensor], step: int) -> Tensor:
        """The loss of the tensors, with the samples of a step."""
        ...

    def renews(self, step: int) -> bool:
        """Whether a step begins with renew()."""
        ...

    def renew(self, tensors: Mapping[str, Tensor], step: int) -> None:
        """What the loss holds fixed between steps is what it is at these values."""
        ...


LossT = TypeVar("LossT", bound=Loss, contravariant=True)


class Descent(NamedTuple):
    """How a loop ended."""

    values: dict[str, Tensor]  # the best
    history: list[Record]
    seconds: float
    ending: Ending


class Way(Generic[LossT]):
    """The state of a descent: where it is, what was best, and whether the steps still lead down."""

    def __init__(self, parameters: Mapping[str, Parameter], options: Options, apart: bool = True) -> None:
        self.parameters, self.options = parameters, options
        self.values = {name: p.value.clone().requires_grad_() for name, p in parameters.items() if p.value is not None}
        self.best = self.copied()
        self.history: list[Record] = []
        self.step, self.seconds, self.flat = 0, 0.0, False
        self.falls = Falls(self.values, apart)
        self.renewed: tuple[int, dict[str, Tensor]] | None = None  # step and values of the objective's last renewal

    def advance(self, objective: LossT) -> Record:
        """One step, with the record of the point where it began."""
        raise NotImplementedError

    def renew(self, objective: LossT, values: Mapping[str, Tensor]) -> bool:
        """What the objective holds fixed between steps, where it is time to; False where losses stay comparable."""
        if not objective.renews(self.step):
            return False
        self.renewed = self.step, {name: value.detach().clone() for name, value in values.items()}
        objective.renew(self.renewed[1], self.step)
        self.falls.part()
        return True

    @property
    def falling(self) -> bool:
        """Whether as many more steps as the patience promise more than the tolerance allows, and than can be told from noise."""
        return self.falls.promise(self.options.patience) > self.falls.least(self.options)

    @property
    def impatient(self) -> bool:
        """Whether it leads down no longer, by a tolerance that says what counts; never by one of 0."""
        return self.options.tolerance > 0.0 and not self.falling

    def ending(self, interrupted: bool) -> Ending:
        if interrupted:
            return Ending.INTERRUPTED
        if self.flat:
            return Ending.FLAT
        return Ending.FALLING if self.falls.tell and self.falling else Ending.STEPS

    def copied(self) -> dict[str, Tensor]:
        return {name: value.detach().clone() for name, value in self.values.items()}

    @torch.no_grad()
    def set(self, values: Mapping[str, Tensor]) -> None:
        """Within the bounds."""
        for name, value in self.values.items():
            value.copy_(self.parameters[name].within(values[name]))

    def gradients(self, loss: Tensor) -> dict[str, Tensor | None]:
        found = torch.autograd.grad(loss, list(self.values.values()), allow_unused=True)
        return dict(zip(self.values, found, strict=True))

    def record(self, loss: float, gradients: Mapping[str, Tensor | None], rate: float) -> Record:
        """Kept, and the step counted."""
        norms = {name: 0.0 if g is None else float(g.norm()) for name, g in gradients.items()}
        small = {n: v.detach().clone() for n, v in self.values.items() if v.numel() <= SMALL}
        self.history.append(Record(self.step, loss, norms, small, rate))
        self.step += 1
        return self.history[-1]

    def state(self) -> dict[str, Any]:
        plain = {name: getattr(self, name) for name in _PLAIN}
        history = [tuple(record) for record in self.history]
        return {**plain, "values": self.copied(), "history": history, "falls": self.falls.state()}

    def load(self, saved: Mapping[str, Any]) -> None:
        for name in _PLAIN:
            setattr(self, name, saved[name])
        self.history = [Record(*record) for record in saved["history"]]
        self.falls.load(saved["falls"])
        self.set(saved["values"])


def is_finite(record: Record) -> bool:
    return math.isfinite(record.loss + sum(record.gradient.values()))


def descend(
    way: Way[LossT],
    objective: LossT,
    save: Callable[[dict[str, Any]], None],
    saved: dict[str, Any] | None = None,
    title: str = "fit",
    report: Callable[[Record, dict[str, Tensor]], Record] = lambda record, values: record,
) -> Descent:
    """Goes its way down. Ctrl-C ends it with the best values so far. The callback gets what `report` makes of a step's record
    and the tensors after it, and the history holds the same.

    `save` is given the way's state now and then, and at the end; `saved` is such a state to go on from.
    """
    began, options = time.perf_counter(), way.options
    if saved is not None:
        way.load(saved)
        if way.renewed is not None:
            objective.renew(way.renewed[1], way.renewed[0])
    earlier = way.seconds
    interrupted = False

    def keep() -> None:
        way.seconds = earlier + time.perf_counter() - began
        save(way.state())

    bar = tqdm(
        total=options.steps, initial=way.step, desc=title, unit="step", disable=not options.progress, leave=False
    )
    try:
        while way.step < options.steps and not way.flat:
            record = way.advance(objective)
            bar.set_postfix_str(f"loss {record.loss:.3e}", refresh=False)
            bar.update()
            if options.callback is not None:
                options.callback(report(record, way.values))
            if way.step % options.checkpoint_every == 0:
                keep()
    except KeyboardInterrupt:
        interrupted = True
    finally:
        bar.close()
    keep()
    return Descent(way.best, way.history, way.seconds, way.ending(interrupted))
