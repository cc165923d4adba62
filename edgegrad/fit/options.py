"""Options that all fits share: what a user sets, and what a fit makes of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..check import check_flag, check_int, check_positive, check_positive_int
from ..files.paths import PathLike
from ..sampling import Sampling, drawn_seed
from .checkpoints import Checkpoint, saved_seed
from .losses import REGION, Loss, loss_of

METHODS = ("adam", "gauss-newton")
MIN_PICTURE_SIDE = 8  # Pixels on the shorter side of a picture: fewer show no contour.
# Options that only some fits use, and why others leave them out.
POSE_OPTIONS = ("steps", "step_tolerance", "spp", "max_size", "callback")
DESCENT_OPTIONS = (
    "steps", "loss_tolerance", "patience", "spp", "views_per_step", "loss", "mask_loss", "method", "callback", "checkpoint",
    "sampling", "shadows", "bounces",
)  # fmt: skip
UNUSED = {
    "steps": "takes as many steps as each picture needs",
    "step_tolerance": "ends by its loss, as options.loss_tolerance says",
    "loss_tolerance": "ends by the length of its steps, as options.step_tolerance says",
    "patience": "ends by the length of its steps, as options.step_tolerance says",
    "max_size": "compares pictures at their own size, which camera.resized() changes",
    "views_per_step": "compares all views in each step",
    "loss": "has a loss of its own",
    "mask_loss": "has a loss of its own",
    "method": "has steps of its own",
    "coarsest": "chooses its levels of resolution",
    "callback": "gives its results one by one to your loop",
    "checkpoint": "keeps no state in files",
    "sampling": "compares colours without light",
    "shadows": "compares colours without light",
    "bounces": "compares colours without light",
}


@dataclass(frozen=True)
class FitOptions:
    """Options of all fits. What is None takes the fit's own default, which its description names.

    A fit refuses options that it does not use. The main ones are `steps`, `spp`, `seed`, `progress` and `callback`.

    Parameters
    ----------
    steps : int
        Largest number of steps; of fits on several levels, on each.
    step_tolerance : float
        Poses and cameras: a step is short below this, in radians, sizes of the object, and logarithms of scale and focal
        length.
    loss_tolerance, patience : float and int, default 0.01 and 40
        Descents end where `patience` more steps would lower the loss by less than this share of it, or by less than its noise.
        0: all steps are taken.
    spp : int
        Samples a pixel.
    seed : int
        Of all samples. By default torch's generator draws it, or it is that of the checkpoint.
    max_size : int
        Larger pictures are reduced to so many pixels on their longer side.
    views_per_step : int
        Number of views in each step, drawn anew. By default all are compared.
    loss, mask_loss : str or function, default "l2"
        Between render and picture, and between alpha and mask: "l1", "l2", "huber", "robust", "ssim", for masks "iou", or a
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
        value: Any
        for name, value in vars(self).items():
            if value is None:
                continue
            shown = f"options.{name}"
            if name in ("steps", "spp", "patience", "views_per_step"):
                check_positive_int(shown, value)
            elif name == "seed":
                check_int(shown, value, 0, 2**32 - 1)
            elif name == "coarsest":
                check_int(shown, value, 4, 65536)
            elif name == "max_size":
                check_int(shown, value, MIN_PICTURE_SIDE, 2**31 - 1)
            elif name == "method" and value not in METHODS:
                raise ValueError(f"{shown}: expected one of {', '.join(METHODS)}, got {value!r}")
            elif name == "loss_tolerance":
                check_positive(shown, value, least=0.0, most=1.0)
            elif name == "step_tolerance":
                check_positive(shown, value, least=1e-30, most=1.0)
            elif name == "progress":
                check_flag(shown, value)
            elif name == "callback" and not callable(value):
                raise TypeError(f"{shown}: expected a function of the result so far, got {type(value).__name__}")
            elif name == "sampling" and not isinstance(value, Sampling):
                raise TypeError(f"{shown}: expected a Sampling, got {type(value).__name__}; give Sampling(…)")
            elif name in ("loss", "mask_loss") and (name, value) != ("loss", REGION):
                loss_of(shown, value)
            elif name == "checkpoint" and not isinstance(value, Checkpoint):
                Checkpoint(value)


@dataclass(frozen=True)
class Settings:
    """The options of one fit, as FitOptions has them, with its defaults in place of None."""

    steps: int = 500
    step_tolerance: float = 3e-4
    loss_tolerance: float = 0.01
    patience: int = 40
    spp: int = 16
    seed: int = 0
    max_size: int = 256
    views_per_step: int | None = None
    loss: str | Loss = "l2"
    mask_loss: str | Loss = "l2"
    method: str = "adam"
    progress: bool = True
    callback: Callable[[Any], Any] | None = None
    checkpoint: Checkpoint | None = None
    sampling: Sampling | None = None
    shadows: bool | None = None
    bounces: int | None = None
    coarsest: int = 16

    @staticmethod
    def from_options(options: FitOptions | None, fit: str, used: tuple[str, ...], **defaults: Any) -> Settings:
        """Return the settings of a fit that uses some options. Raises TypeError, or ValueError for an option that it does not
        use."""
        given = FitOptions() if options is None else options
        if not isinstance(given, FitOptions):
            raise TypeError(f"options: expected FitOptions, got {type(given).__name__}; give FitOptions(steps=…)")
        set_ones = {name: value for name, value in vars(given).items() if value is not None}
        for name in set_ones:
            if name in UNUSED and name not in used:
                raise ValueError(f"options.{name}: {fit} {UNUSED[name]}; leave it out")
        checkpoint = given.checkpoint
        checkpoint = checkpoint if checkpoint is None or isinstance(checkpoint, Checkpoint) else Checkpoint(checkpoint)
        seed = saved_seed(checkpoint) if given.seed is None else given.seed
        seed = drawn_seed(below=2**32) if seed is None else seed
        return Settings(**{**defaults, **set_ones, "seed": seed, "checkpoint": checkpoint})

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
