"""Options that all fits share: what a user sets, and what a fit makes of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from ..check import check_flag, check_int, check_positive
from ..files.paths import PathLike
from ..optim.loop import Progress, nothing
from ..sampling import Sampling, drawn_seed
from .checkpoints import Checkpoint, checkpoint_of, saved_seed
from .losses import REGION, Loss, loss_of

METHODS = ("adam", "gauss-newton")
MIN_PICTURE_SIDE = 8  # Pixels on the shorter side of a picture: fewer show no contour.
RANGES = {
    **dict.fromkeys(("steps", "spp", "patience", "views_per_step"), (1, 2**31 - 1)), "seed": (0, 2**32 - 1),
    "max_size": (MIN_PICTURE_SIDE, 2**31 - 1), "coarsest": (4, 65536),
}  # fmt: skip
# Options that only some fits use, and why others leave them out.
POSE_OPTIONS = ("steps", "step_tolerance", "spp", "max_size", "callback")
DESCENT_OPTIONS = (
    "steps", "loss_tolerance", "patience", "spp", "views_per_step", "loss", "mask_loss", "method", "callback", "checkpoint",
    "sampling", "shadows", "bounces",
)  # fmt: skip
UNUSED = {
    "steps": "takes as many steps as each picture needs",
    "step_tolerance": "ends by its loss, as options.loss_tolerance says",
    **dict.fromkeys(("loss_tolerance", "patience"), "ends by the length of its steps, as options.step_tolerance says"),
    "max_size": "compares pictures at their own size, which camera.resized() changes",
    "views_per_step": "compares all views in each step",
    **dict.fromkeys(("loss", "mask_loss", "method"), "has a loss and steps of its own"),
    "coarsest": "chooses its levels of resolution",
    "callback": "gives its results one by one to your loop",
    "checkpoint": "keeps no state in files",
    **dict.fromkeys(("sampling", "shadows", "bounces"), "compares colours without light"),
}


@dataclass(frozen=True)
class FitOptions:
    """Options of all fits. What is None takes the fit's own default, which its description names.

    A fit refuses options that it does not use. The main ones are `steps`, `spp`, `seed`, `progress` and `callback`.

    Parameters
    ----------
    steps : int
        Largest number of steps. A fit on several levels takes up to so many on each level, which may run again, and each search
        or restart takes as many again.
    step_tolerance : float
        Poses and cameras: a step is short below this, in radians, sizes of the object, and logarithms of scale and focal
        length.
    loss_tolerance, patience : float and int, default 0.01 and 40
        Descents end where `patience` more steps would lower the loss by less than this share of it, or by less than its noise.
        With a tolerance of 0 all steps are taken.
    spp : int
        Samples a pixel.
    seed : int
        Of all samples. By default torch's generator draws it, or it is that of the checkpoint.
    max_size : int
        Larger pictures are reduced to so many pixels on their longer side.
    views_per_step : int
        Number of views in each step, drawn anew. By default all are compared.
    loss, mask_loss : str or function, default "l2"
        Between render and picture, and between alpha and mask: "l1", "l2", "huber", "robust", for masks "iou", or a
        function of image, target and weight, as in edgegrad.fit.losses. "region" finds the object in photographs by its
        colours.
    method : "adam" or "gauss-newton"
        The latter takes far fewer steps, for up to 400 numbers, all views in each step, and losses of single pixels.
    progress : bool, default True
        Whether a bar with the loss is shown on standard error.
    callback : function
        Called after each step with the result so far; of descents with the step's record, which has `scene` and `cameras`.
        KeyboardInterrupt from it ends the fit with its best result.
    checkpoint : Checkpoint or path
        A file for the fit's state.
    sampling, shadows, bounces : Sampling, bool, int
        As render() takes them.
    coarsest : int, default 16
        Pixels on the shorter side of the pictures on the first level of fit_rig(); each further level has twice as many.
    """

    steps: int | None = None
    step_tolerance: float | None = None
    loss_tolerance: float | None = None
    patience: int | None = None
    spp: int | None = None
    seed: int | None = None
    max_size: int | None = None
    views_per_step: int | None = None
    loss: str | Loss | None = None
    mask_loss: str | Loss | None = None
    method: str | None = None
    progress: bool = True
    callback: Callable[[Any], Any] | None = None
    checkpoint: Checkpoint | PathLike | None = None
    sampling: Sampling | None = None
    shadows: bool | None = None
    bounces: int | None = None
    coarsest: int | None = None

    def __post_init__(self) -> None:
        for name, (least, most) in RANGES.items():
            if (number := getattr(self, name)) is not None:
                check_int(f"options.{name}", number, least, most)
        for name, smallest in (("loss_tolerance", 0.0), ("step_tolerance", 1e-30)):
            if (number := getattr(self, name)) is not None:
                check_positive(f"options.{name}", number, least=smallest, most=1.0)
        if self.method not in (None, *METHODS):
            raise ValueError(f"options.method: expected one of {', '.join(METHODS)}, got {self.method!r}")
        if self.loss not in (None, REGION):
            loss_of("options.loss", self.loss)
        if self.mask_loss is not None:
            loss_of("options.mask_loss", self.mask_loss)
        check_flag("options.progress", self.progress)
        if self.callback is not None and not callable(self.callback):
            raise TypeError(
                f"options.callback: expected a function of the result so far, got {type(self.callback).__name__}"
            )
        if not isinstance(self.sampling, Sampling | None):
            raise TypeError(f"options.sampling: expected a Sampling, got {type(self.sampling).__name__}")
        checkpoint_of(self.checkpoint)

    def of_part(self, k: int) -> FitOptions:
        """Return the options of part k of a fit, which keeps its state in a file of its own."""
        checkpoint = checkpoint_of(self.checkpoint)
        return self if checkpoint is None else replace(self, checkpoint=checkpoint.of_part(k))


def options_of(given: object) -> FitOptions:
    """Return the options that a fit was given, by default none. Raises TypeError."""
    if not isinstance(given, FitOptions | None):
        raise TypeError(f"options: expected FitOptions, got {type(given).__name__}; give FitOptions(steps=…)")
    return FitOptions() if given is None else given


@dataclass(frozen=True)
class Settings(FitOptions):
    """The options of one fit, with its defaults in place of None."""

    steps: int = 500
    step_tolerance: float = 3e-4
    loss_tolerance: float = 0.01
    patience: int = 40
    spp: int = 16
    seed: int = 0
    max_size: int = 256
    loss: str | Loss = "l2"
    mask_loss: str | Loss = "l2"
    method: str = "adam"
    checkpoint: Checkpoint | None = None
    coarsest: int = 16

    @staticmethod
    def from_options(options: FitOptions | None, fit: str, used: tuple[str, ...], **defaults: Any) -> Settings:
        """Return the settings of a fit that uses some options. Raises TypeError, or ValueError for an option that it does not
        use."""
        given = options_of(options)
        set_ones = {name: value for name, value in vars(given).items() if value is not None}
        for name in set_ones:
            if name in UNUSED and name not in used:
                raise ValueError(f"options.{name}: {fit} {UNUSED[name]}; leave it out")
        checkpoint = checkpoint_of(given.checkpoint)
        seed = saved_seed(checkpoint) if given.seed is None else given.seed
        seed = int(drawn_seed()) % 2**32 if seed is None else seed
        return Settings(**{**defaults, **set_ones, "seed": seed, "checkpoint": checkpoint})

    def progress_of(self, title: str, result: Callable[[], Any]) -> Progress:
        """Return the context of a fit's steps. After each, the callback gets the result so far."""
        callback = self.callback
        after_step = nothing if callback is None else lambda: callback(result())
        every = None if self.checkpoint is None else self.checkpoint.every
        return Progress(title if self.progress else None, after_step, every=every)

    @property
    def of_steps(self) -> dict[str, Any]:
        """The settings of a descent that its steps depend on."""
        names = ("loss", "mask_loss", "method", "views_per_step", "spp", "seed", "patience", "loss_tolerance")
        return {name: getattr(self, name) for name in (*names, "sampling", "shadows", "bounces")}

    @property
    def render(self) -> dict[str, Any]:
        """Further arguments of render_aovs()."""
        return {
            name: value for name in ("sampling", "shadows", "bounces") if (value := getattr(self, name)) is not None
        }
