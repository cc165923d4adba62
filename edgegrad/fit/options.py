"""The parameters and options of fits by descent."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any

import torch
from torch import Tensor

from ..aovs import render_aovs
from ..check import as_tensor, check_finite, check_float, check_int, check_positive, check_positive_int
from ..files.paths import PathLike
from .history import Record
from .losses import REGION, Loss, loss_of

METHODS = ("adam", "gauss-newton")
RENDER = tuple(inspect.signature(render_aovs).parameters)[3:]


@dataclass(frozen=True)
class Parameter:
    """A tensor to find, and how it moves.

    lr       learning rate: about how far each number moves in a step, in its own units
    value    where the fit starts; None: the scene's tensor of this name
    low      lower bound, a number or a tensor that broadcasts; None: none
    high     upper bound, likewise
    uniform  one step size for all numbers of the tensor, as coordinates of one surface need; False: one for each number
    """

    lr: float
    value: Tensor | None = None
    low: float | Tensor | None = None
    high: float | Tensor | None = None
    uniform: bool = False

    def checked(self, name: str) -> Parameter:
        """Return a copy with a value of its own on the CPU. Raises TypeError or ValueError."""
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


@dataclass(frozen=True)
class Options:
    """Options of all fits by descent.

    loss              between render and picture: "l1", "l2", "huber", "robust", "ssim", or a function of image, target and
                      weight; edgegrad.fit.losses has more, with their parameters. "robust" is for what the render lacks, not
                      for noise of glossy light. "region" is for photographs without masks in unknown light: the object is where
                      the colours are that lie within its silhouette, counted near the contour. It moves shapes, poses and
                      cameras, and takes all meshes of the scene for the object; the scene's own colours do not count. Colours
                      are counted every three steps
    mask_loss         between alpha and mask: one of the same, or "iou"
    method            "adam", for any count of numbers; or "gauss-newton", for up to 400: far fewer steps, each with the
                      derivative by every number in forward mode. It needs all views in each step, and a loss that compares each
                      pixel by itself (not "ssim", "iou" or a pyramid); a step moves no number by more than ten learning rates
    steps             largest number of steps
    views_per_step    number of views in each step, drawn anew; None: all
    spp               samples per pixel
    seed              of the samples; the same seed gives the same fit
    patience          number of steps over which the fit predicts the decrease of its loss, from gradients at the end of the
                      last steps
    tolerance         the fit ends if that decrease is less than this share of the loss, or of its decrease so far, or less than
                      its noise; "adam" first shortens its steps, three times. 0: the fit takes all its steps
    progress          show a bar with the loss on standard error
    callback          called after each step with its Record, a Progress with scene and cameras; KeyboardInterrupt from it ends
                      the fit
    checkpoint        file for the fit's state, written every `checkpoint_every` steps and at the end, never in part; None: no
                      file
    checkpoint_every  steps
    resume            go on from the checkpoint if there is one: the fit ends as if it had never stopped. A checkpoint of a fit
                      with other arguments is refused
    render            further arguments of render(), such as sampling
    """

    loss: str | Loss = "l2"
    mask_loss: str | Loss = "l2"
    method: str = "adam"
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
        if self.method not in METHODS:
            raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {self.method!r}")
        check_int("seed", self.seed, 0, 2**32 - 1)
        check_positive("tolerance", self.tolerance, least=0.0, most=1.0)
        for name in ("loss", "mask_loss"):
            if name != "loss" or self.loss != REGION:
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
    """Check arguments for checkpoints. Raises TypeError, ValueError or FileNotFoundError."""
    check_positive_int("checkpoint_every", every)
    if resume and checkpoint is None:
        raise ValueError("resume: expected a checkpoint to go on from, got none; give checkpoint=path")
    if checkpoint is not None and not isinstance(checkpoint, (str, PurePath)):
        raise TypeError(f"checkpoint: expected a path, got {type(checkpoint).__name__} ({checkpoint!r})")
    if checkpoint is not None and not (folder := Path(checkpoint).absolute().parent).is_dir():
        raise FileNotFoundError(f"checkpoint: expected the folder {folder} to exist; make it first with Path.mkdir")
