"""The frame of a fit by gradient descent: parameters, one loop, a rule when to stop, a history, and checkpoints.

The loop knows nothing of what is fitted: an objective gives the loss of the parameters' values at a step. Steps are Adam's
(Kingma and Ba 2015). When the loss no longer falls, all learning rates fall; after CUTS falls the loss is flat, and the fit ends.
"""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from .._check import as_tensor, check_finite, check_float, check_int, check_positive, check_positive_int
from .._files import PathLike
from ..aovs import render_aovs
from .losses import Loss, loss_of

CUT, CUTS = 0.3, 3  # learning rates fall by this factor when the loss is flat; so often before the fit ends
SMOOTH = 0.9  # the best values are those of the least loss, averaged over some ten steps for its noise
RENDER = tuple(inspect.signature(render_aovs).parameters)[3:]
SMALL = 64  # values of up to so many numbers are kept for each step


@dataclass(frozen=True)
class Parameter:
    """What is sought: a tensor and its steps.

    lr       the learning rate: about how far each number moves in a step, in its own units
    value    where the fit starts; None: what the scene holds under this name
    low      bounds, numbers or tensors that broadcast
    high
    uniform  one step size for all numbers instead of each its own, as the coordinates of one surface need
    """

    lr: float
    value: Tensor | None = None
    low: float | Tensor | None = None
    high: float | Tensor | None = None
    uniform: bool = False

    def checked(self, name: str) -> Parameter:
        """With a value of its own, on the CPU. Raises TypeError or ValueError."""
        check_positive(f"{name}: lr", self.lr, least=0.0, most=1e30)
        if self.value is None:
            raise ValueError(f"{name}: expected a value to start from, got None; give Parameter(lr, value)")
        value = as_tensor(name, self.value, floating=True).detach().cpu().clone()
        check_float(name, value)
        check_finite(name, value)
        if self.low is not None and self.high is not None:
            low, high = torch.as_tensor(self.low), torch.as_tensor(self.high)
            if bool((low > high).any()):
                raise ValueError(f"{name}: expected low ≤ high, got {self.low} and {self.high}")
        if not torch.equal(self.within(value), value):
            raise ValueError(
                f"{name}: expected a start within low and high, {self.low} and {self.high}, got {float(value.min()):g} to "
                f"{float(value.max()):g}; clamp it first"
            )
        return replace(self, value=value)

    def within(self, value: Tensor) -> Tensor:
        low, high = (
            b if b is None or isinstance(b, Tensor) else torch.as_tensor(b, dtype=value.dtype)
            for b in (self.low, self.high)
        )
        return value if low is None and high is None else value.clamp(low, high)


class Record(NamedTuple):
    """One step."""

    step: int
    loss: float  # of this step's views and samples, regularizer included
    gradient: dict[str, float]  # norm, by parameter
    values: dict[str, Tensor]  # of parameters of up to 64 numbers, before the step
    rate: float = 1.0  # factor of the learning rates; 1 where there are none


@dataclass(frozen=True)
class Options:
    """What all fits by descent can be told.

    loss              between render and picture: "l1", "l2", "huber", "robust", "ssim", or a function of image, target and
                      weight; edgegrad.fit.losses has more, with their parameters
    mask_loss         the same between the render's alpha and the mask, also "iou"
    steps             at most so many
    views_per_step    so many views, drawn anew, in each step; None: all of them
    spp               samples a pixel
    seed              the same seed gives the same fit
    patience          steps: the loss is flat when its mean over so many falls by less than
    tolerance         this share against the mean over as many before
    progress          show a bar with the loss on standard error
    callback          called after each step with its Record, which is a Progress: it has scene and cameras too; KeyboardInterrupt
                      from it ends the fit
    checkpoint        a file that holds the fit's state, written every `checkpoint_every` steps and at the end, and never in part
    checkpoint_every  steps
    resume            go on from the checkpoint, if there is one: the fit ends as if it had never stopped. One of a fit that was
                      given something else is refused
    render            further arguments of render(), such as light_samples
    """

    loss: str | Loss = "l2"
    mask_loss: str | Loss = "l2"
    steps: int = 500
    views_per_step: int | None = None
    spp: int = 16
    seed: int = 0
    patience: int = 40
    tolerance: float = 0.01
    progress: bool = True
    callback: Callable[[Record], Any] | None = None
    checkpoint: PathLike | None = None
    checkpoint_every: int = 25
    resume: bool = False
    render: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("steps", "spp", "patience"):
            check_positive_int(name, getattr(self, name))
        if self.views_per_step is not None:
            check_positive_int("views_per_step", self.views_per_step)
        check_int("seed", self.seed, 0, 2**32 - 1)
        check_positive("tolerance", self.tolerance, least=0.0, most=1.0)
        for name in ("loss", "mask_loss"):
            loss_of(name, getattr(self, name))
        if self.callback is not None and not callable(self.callback):
            raise TypeError(f"callback: expected a function of a Record, got {type(self.callback).__name__}")
        own = ("spp", "seed")
        if unknown := [name for name in self.render if name not in RENDER or name in own]:
            fix = "; it is an option of its own" if unknown[0] in own else ""
            known = ", ".join(name for name in RENDER if name not in own)
            raise ValueError(f"render: expected arguments of render() among {known}, got {unknown[0]!r}{fix}")
        check_checkpoint(self.checkpoint, self.checkpoint_every, self.resume)


def check_checkpoint(checkpoint: PathLike | None, every: int, resume: bool) -> None:
    """Raises TypeError, ValueError or FileNotFoundError."""
    check_positive_int("checkpoint_every", every)
    if resume and checkpoint is None:
        raise ValueError("resume: expected a checkpoint to go on from, got none; give checkpoint=path")
    if checkpoint is not None and not isinstance(checkpoint, (str, PurePath)):
        raise TypeError(f"checkpoint: expected a path, got {type(checkpoint).__name__} ({checkpoint!r})")
    if checkpoint is not None and not (folder := Path(checkpoint).absolute().parent).is_dir():
        raise FileNotFoundError(f"checkpoint: expected the folder {folder} to exist; make it first with Path.mkdir")


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
        self.optimizer = Adam(
            {"params": [self.values[name]], "lr": p.lr, "uniform": p.uniform} for name, p in parameters.items()
        )
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
            self.optimizer.state.clear()
            with torch.no_grad():
                for name, value in self.values.items():
                    value.copy_(self.best[name])
            return record
        self.smooth = SMOOTH * self.smooth + (1.0 - SMOOTH) * number
        mean = self.smooth / (1.0 - SMOOTH ** len(self.history))
        if mean <= self.least:
            self.least = mean
            self.best = {name: value.detach().clone() for name, value in self.values.items()}
        for value, gradient in zip(self.values.values(), gradients, strict=True):
            value.grad = gradient
        self.optimizer.step()
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
        for group in self.optimizer.param_groups:
            group["lr"] *= CUT

    def state(self) -> dict[str, Any]:
        plain = {name: getattr(self, name) for name in _PLAIN}
        values = {name: value.detach() for name, value in self.values.items()}
        history = [tuple(record) for record in self.history]
        return {**plain, "values": values, "history": history, "optimizer": self.optimizer.state_dict()}

    def load(self, saved: dict[str, Any]) -> None:
        for name in _PLAIN:
            setattr(self, name, saved[name])
        self.history = [Record(*record) for record in saved["history"]]
        self.optimizer.load_state_dict(saved["optimizer"])
        with torch.no_grad():
            for name, value in self.values.items():
                value.copy_(saved["values"][name])


class Adam(torch.optim.Optimizer):
    """Adam; with `uniform` in a group, its step is divided by the largest second moment instead of each by its own: then a
    smooth gradient gives a smooth step (Nicolet, Jacobson and Jakob 2021)."""

    def __init__(self, groups: Any, betas: tuple[float, float] = (0.9, 0.999)) -> None:
        super().__init__(list(groups), {"lr": 1e-2, "uniform": False, "betas": betas})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        for group in self.param_groups:
            b1, b2 = group["betas"]
            for p in group["params"]:
                if p.grad is None:
                    continue
                state = self.state[p]
                if not state:
                    state.update(step=0, mean=torch.zeros_like(p), square=torch.zeros_like(p))
                state["step"] += 1
                state["mean"].lerp_(p.grad, 1.0 - b1)
                state["square"].lerp_(p.grad.square(), 1.0 - b2)
                size = (state["square"] / (1.0 - b2 ** state["step"])).sqrt()
                size = size.max() if group["uniform"] else size
                # Relative to the largest, for losses have any units.
                floor = 1e-8 * float(size.max()) + 1e-30
                p.sub_(group["lr"] / (1.0 - b1 ** state["step"]) * state["mean"] / (size + floor))
