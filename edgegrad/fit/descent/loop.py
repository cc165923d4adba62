"""The loop of a fit by descent: it takes steps until they lead no further, and keeps a state to go on from.

An optimizer takes the steps (adam_steps.py, gauss_newton.py); an objective gives the loss of the values at a step.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from ..ending import Ending
from ..history import Record
from ..options import Settings
from ..parameter import Parameter
from .convergence import ConvergenceMonitor
from .objective import Objective

MAX_RECORDED = 64  # numbers of a parameter whose values the history holds


class Descent(NamedTuple):
    """The result of descend()."""

    values: dict[str, Tensor]  # the best
    history: list[Record]
    seconds: float
    ending: Ending


class Optimizer:
    """The state of a descent: its values, the best ones so far, and whether steps still lead down."""

    saved: ClassVar[tuple[str, ...]] = ("best", "step", "seconds", "flat", "renewed")  # attributes in checkpoints

    def __init__(self, parameters: Mapping[str, Parameter], options: Settings, apart: bool = True) -> None:
        self.parameters, self.options = parameters, options
        self.values = {name: p.value.clone().requires_grad_() for name, p in parameters.items() if p.value is not None}
        self.best = self.copied()
        self.history: list[Record] = []
        self.step, self.seconds, self.flat = 0, 0.0, False
        self.monitor = ConvergenceMonitor(self.values, apart)
        self.renewed: tuple[int, dict[str, Tensor]] | None = None  # step and values of the objective's last renewal

    def advance(self, objective: Objective) -> Record:
        """Take one step and return the record of the point where it began."""
        raise NotImplementedError

    def renew(self, objective: Objective, values: Mapping[str, Tensor]) -> bool:
        """Renew what the objective holds fixed, if it is due. Return whether losses stop being comparable by that."""
        if not objective.renews(self.step):
            return False
        self.renewed = self.step, {name: value.detach().clone() for name, value in values.items()}
        objective.renew(self.renewed[1], self.step)
        self.monitor.split_losses()
        return True

    @property
    def falling(self) -> bool:
        """Whether as many more steps as the patience are predicted to lower the loss by more than tolerance and noise."""
        return self.monitor.predicted_decrease(self.options.patience) > self.monitor.least_decrease(self.options)

    @property
    def impatient(self) -> bool:
        """Whether the steps lead down no longer. With a tolerance of 0 this is never so."""
        return self.options.loss_tolerance > 0.0 and not self.falling

    def ending(self, interrupted: bool) -> Ending:
        if interrupted:
            return Ending.INTERRUPTED
        if self.flat:
            return Ending.FLAT
        return Ending.FALLING if self.monitor.is_ready and self.falling else Ending.STEPS

    def copied(self) -> dict[str, Tensor]:
        return {name: value.detach().clone() for name, value in self.values.items()}

    @torch.no_grad()
    def set(self, values: Mapping[str, Tensor]) -> None:
        """Take these values, clamped to their bounds."""
        for name, value in self.values.items():
            value.copy_(self.parameters[name].within(values[name]))

    def gradients(self, loss: Tensor) -> dict[str, Tensor | None]:
        if not loss.requires_grad:  # None of the step's views shows what is sought.
            return dict.fromkeys(self.values)
        found = torch.autograd.grad(loss, list(self.values.values()), allow_unused=True)
        return dict(zip(self.values, found, strict=True))

    def record(self, loss: float, gradients: Mapping[str, Tensor | None], rate: float) -> Record:
        """Add a record to the history and count the step."""
        norms = {name: 0.0 if g is None else float(g.norm()) for name, g in gradients.items()}
        small = {n: v.detach().clone() for n, v in self.values.items() if v.numel() <= MAX_RECORDED}
        self.history.append(Record(self.step, loss, norms, small, rate))
        self.step += 1
        return self.history[-1]

    def state(self) -> dict[str, Any]:
        own = {name: getattr(self, name) for name in self.saved}
        history = [tuple(record) for record in self.history]
        return {**own, "values": self.copied(), "history": history, "monitor": self.monitor.state()}

    def load(self, state: Mapping[str, Any]) -> None:
        for name in self.saved:
            setattr(self, name, state[name])
        self.history = [Record(*record) for record in state["history"]]
        self.monitor.load(state["monitor"])
        self.set(state["values"])


def is_finite(record: Record) -> bool:
    return math.isfinite(record.loss + sum(record.gradient.values()))


def descend(
    optimizer: Optimizer,
    objective: Objective,
    save: Callable[[dict[str, Any]], None],
    saved: dict[str, Any] | None = None,
    title: str = "fit",
    report: Callable[[Record, dict[str, Tensor]], Record] = lambda record, values: record,
) -> Descent:
    """Take steps until the optimizer is flat or the steps run out. Ctrl-C ends the loop with the best values so far.

    save    called with the optimizer's state every few steps, as the checkpoint says, and at the end
    saved   such a state to go on from; None: begin anew
    report  makes what the callback gets, of a step's record and the tensors after the step
    """
    began, options = time.perf_counter(), optimizer.options
    if saved is not None:
        optimizer.load(saved)
        if optimizer.renewed is not None:
            objective.renew(optimizer.renewed[1], optimizer.renewed[0])
    earlier = optimizer.seconds
    interrupted = False

    def keep() -> None:
        optimizer.seconds = earlier + time.perf_counter() - began
        save(optimizer.state())

    bar = tqdm(
        total=options.steps, initial=optimizer.step, desc=title, unit="step", disable=not options.progress, leave=False
    )
    try:
        while optimizer.step < options.steps and not optimizer.flat:
            record = optimizer.advance(objective)
            bar.set_postfix_str(f"loss {record.loss:.3e}", refresh=False)
            bar.update()
            if options.callback is not None:
                options.callback(report(record, optimizer.values))
            if options.checkpoint is not None and optimizer.step % options.checkpoint.every == 0:
                keep()
    except KeyboardInterrupt:
        interrupted = True
    finally:
        bar.close()
    keep()
    return Descent(optimizer.best, optimizer.history, optimizer.seconds, optimizer.ending(interrupted))
