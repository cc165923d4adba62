"""The loop of a fit by gradient descent: steps, a rule when to stop, the best values, and a state to go on from.

The loop knows nothing of what is fitted: an objective gives the loss of the parameters' values at a step. When the loss no longer
falls, all learning rates fall; after CUTS falls the loss is flat, and the fit ends.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from ..history import Record
from ..options import Options, Parameter
from .adam import Adam

CUT, CUTS = 0.3, 3  # learning rates fall by this factor when the loss is flat; so often before the fit ends
SMOOTH = 0.9  # the best values are those of the least loss, averaged over some ten steps for its noise
WARM = 10  # steps of few views until their losses are averaged enough to be compared
SMALL = 64  # values of up to so many numbers are kept for each step


class Descent(NamedTuple):
    """How a loop ended."""

    values: dict[str, Tensor]  # the best
    history: list[Record]
    seconds: float
    flat: bool  # the loss no longer fell
    interrupted: bool


def descend(
    objective: Callable[[dict[str, Tensor], int], Tensor],
    parameters: Mapping[str, Parameter],
    options: Options,
    save: Callable[[dict[str, Any]], None],
    saved: dict[str, Any] | None = None,
    title: str = "fit",
    report: Callable[[Record, dict[str, Tensor]], Record] = lambda record, values: record,
) -> Descent:
    """Follows the gradient of `objective(values, step)`. Ctrl-C ends it with the best values so far. The callback gets what
    `report` makes of a step's record and the values after it.

    `save` is given the loop's state now and then, and at the end; `saved` is such a state to go on from.
    """
    began = time.perf_counter()
    loop = _Loop(parameters, options)
    if saved is not None:
        loop.load(saved)
    earlier = loop.seconds
    interrupted = False

    def keep() -> None:
        loop.seconds = earlier + time.perf_counter() - began
        save(loop.state())

    bar = tqdm(
        total=options.steps, initial=loop.step, desc=title, unit="step", disable=not options.progress, leave=False
    )
    try:
        while loop.step < options.steps and not loop.flat:
            record = loop.advance(objective)
            loop.settle()
            bar.set_postfix_str(f"loss {record.loss:.3e}", refresh=False)
            bar.update()
            if options.callback is not None:
                options.callback(report(record, loop.values))
            if loop.step % options.checkpoint_every == 0:
                keep()
    except KeyboardInterrupt:
        interrupted = True
    finally:
        bar.close()
    keep()
    seconds = earlier + time.perf_counter() - began
    return Descent(loop.best, loop.history, seconds, loop.flat, interrupted)


_PLAIN = ("best", "step", "cuts", "since", "smooth", "least", "seconds", "flat")


class _Loop:
    """The state of a descent."""

    def __init__(self, parameters: Mapping[str, Parameter], options: Options) -> None:
        self.parameters, self.options = parameters, options
        self.values = {name: p.value.clone().requires_grad_() for name, p in parameters.items() if p.value is not None}
        rates = {name: p.lr for name, p in parameters.items()}
        self.optimizer = Adam(self.values, rates, {name for name, p in parameters.items() if p.uniform})
        self.best = {name: value.detach().clone() for name, value in self.values.items()}
        self.history: list[Record] = []
        self.step = self.cuts = self.since = 0  # `since`: the step of the last cut
        self.smooth, self.least, self.seconds = 0.0, math.inf, 0.0
        self.flat = False

    def advance(self, objective: Callable[[dict[str, Tensor], int], Tensor]) -> Record:
        loss = objective(self.values, self.step)
        gradients = torch.autograd.grad(loss, list(self.values.values()), allow_unused=True)
        number = float(loss.detach())
        norms = {n: 0.0 if g is None else float(g.norm()) for n, g in zip(self.values, gradients, strict=True)}
        small = {n: v.detach().clone() for n, v in self.values.items() if v.numel() <= SMALL}
        record = Record(self.step, number, norms, small, CUT**self.cuts)
        self.history.append(record)
        self.step += 1
        if not math.isfinite(number + sum(norms.values())):
            # Too far: back to the best values, with shorter steps.
            self._cut()
            self.optimizer.forget()
            with torch.no_grad():
                for name, value in self.values.items():
                    value.copy_(self.best[name])
            return record
        self.smooth = SMOOTH * self.smooth + (1.0 - SMOOTH) * number
        mean = self.smooth / (1.0 - SMOOTH ** len(self.history))
        # The first views of several may be those of the least loss, whatever the values.
        warming = self.options.views_per_step is not None and len(self.history) <= WARM
        if mean <= self.least or warming:
            self.least = mean
            self.best = {name: value.detach().clone() for name, value in self.values.items()}
        self.optimizer.step(dict(zip(self.values, gradients, strict=True)))
        with torch.no_grad():
            for name, value in self.values.items():
                value.copy_(self.parameters[name].within(value))
        return record

    def settle(self) -> None:
        """Lowers the learning rates when the loss no longer falls; when it does not after the last time, it is flat."""
        p = self.options.patience
        if self.step - self.since < 2 * p:
            return
        losses = [record.loss for record in self.history[-2 * p :]]
        before, now = sum(losses[:p]) / p, sum(losses[p:]) / p
        # not <=, so that losses that are NaN count as flat
        if not before - now > self.options.tolerance * abs(before):
            self._cut()

    def _cut(self) -> None:
        self.flat = self.cuts == CUTS
        self.cuts, self.since = self.cuts + 1, self.step
        self.optimizer.shorten(CUT)

    def state(self) -> dict[str, Any]:
        plain = {name: getattr(self, name) for name in _PLAIN}
        values = {name: value.detach() for name, value in self.values.items()}
        history = [tuple(record) for record in self.history]
        return {**plain, "values": values, "history": history, "optimizer": self.optimizer.state()}

    def load(self, saved: dict[str, Any]) -> None:
        for name in _PLAIN:
            setattr(self, name, saved[name])
        self.history = [Record(*record) for record in saved["history"]]
        self.optimizer.load(saved["optimizer"])
        with torch.no_grad():
            for name, value in self.values.items():
                value.copy_(saved["values"][name])
