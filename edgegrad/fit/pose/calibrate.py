"""calibrate(): the lens that took several pictures of a known object, and where each of them was taken.

Each picture is first searched alone, as by fit_camera(), at half the resolution. Then Gauss-Newton steps move all poses and
the one lens together (bundle_adjustment.py).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from tqdm import tqdm

from ...camera.camera import Camera
from ...check import check_flag
from ...files.cameras import save_camera
from ...files.paths import PathLike, write_figures, write_json
from ...optional import DRAWING, require
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..by_camera import one_for_each
from ..checkpoints import Checkpoint
from ..ending import Ending
from ..history import Record, history_rows, number_or_none
from ..modes import in_full_precision
from ..options import MIN_PICTURE_SIDE, POSE_OPTIONS, FitOptions, Settings
from ..result import FitResult, chosen, made_folder
from ..views import Images, cameras_of, check_image
from .bundle_adjustment import Adjustment, adjust_bundle, poses_of
from .camera_uncertainty import CameraUncertainty
from .fit_camera import CameraFit, ended, fitted, moved, pose_of, with_coefficients
from .fit_pose import search_pose
from .inputs import ArgumentNames
from .loss_model import LossSource, loss_source
from .result import PoseFit
from .task import DISTORTION, FOCAL_LENGTH, Unknowns

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PROJECTIONS = "perspective", "fisheye"


@dataclass(frozen=True, eq=False)
class Calibration(FitResult):
    """The result of calibrate(), a FitResult: cameras with one lens, and how exactly each number is known.

    Attributes
    ----------
    fits : a CameraFit of each picture
        Its camera, the search by itself at a lower resolution, and the uncertainty of all numbers, None before the lens was
        found.
    ending : why the fit took no more steps
    history : a Record of each step of all numbers at once
        The loss, the norms of its gradient by "world_to_camera" (in radians and sizes of the mesh), "K" (logarithm of the
        focal length, widths of the image) and "distortion", and the cameras by the names "cameras.0.world_to_camera",
        "cameras.0.K" and "cameras.0.distortion".
    """

    fits: list[CameraFit]
    ending: Ending
    seconds: float
    history: list[Record] = field(repr=False)

    @property
    def cameras(self) -> list[Camera]:
        """Return the camera of each picture, at its place."""
        return [fit.camera for fit in self.fits]

    @property
    def camera(self) -> Camera:
        """Return the first camera; all have its K and distortion."""
        return self.fits[0].camera

    @property
    def uncertainty(self) -> CameraUncertainty | None:
        """Return the uncertainty of the first camera, whose lens is that of all."""
        return self.fits[0].uncertainty

    @property
    def loss(self) -> float:
        """Return the mean loss over the pictures."""
        return sum(fit.loss for fit in self.fits) / len(self.fits)

    @property
    def explained(self) -> float:
        """Return the least share over the pictures, 0 … 1, of the render's edges that a picture shows, too."""
        return min(fit.explained for fit in self.fits)

    @property
    def steps(self) -> int:
        """Return the number of steps that moved all numbers at once."""
        return len(self.history)

    @property
    def converged(self) -> bool:
        """Return whether further steps lead no further, pictures show the render's edges, and all that was sought is known."""
        return self.reason == "converged"

    @property
    def interrupted(self) -> bool:
        return self.ending is Ending.INTERRUPTED

    @property
    def reason(self) -> str:
        """Return "converged", or what kept the fit from that, in words.

        These are "images[2]: edges not explained: …", "not known: …" with numbers that the pictures hardly show, "steps ran
        out: …" and "interrupted".
        """
        if self.ending is not Ending.FLAT:
            known = self.uncertainty
            if self.ending is Ending.STEPS and known is not None and known.vague:
                return f"not known: {', '.join(known.vague)}"
            return (
                "steps ran out: what is sought has not come to rest" if self.ending is Ending.STEPS else "interrupted"
            )
        for k, fit in enumerate(self.fits):
            if not fit.converged:
                of_lens = fit.reason.startswith("not known") and fit.uncertainty is not None and fit.uncertainty.vague
                return fit.reason if of_lens else f"images[{k}]: {fit.reason}"
        return "converged"

    def plot(self, most: int = 4) -> Figure:
        """Draw target | start | fit | difference of at most so many pictures, as they were compared."""
        fits = [self.fits[k].search for k in chosen(len(self.fits), most)]
        return require("edgegrad.fit.pose.pictures", *DRAWING).sheet(*fits)

    def save(self, folder: PathLike, figures: bool = True) -> list[str]:
        """Write the result to a folder, which is made where it is missing, and return the files' names.

        - calibration.json: focal length, principal point and distortion with their standard deviations, those of the poses,
          loss and reason
        - history.json: loss, gradient norms and cameras of each step
        - camera-0.json and so on: the cameras, as load_camera reads them
        - fit.png and loss.png: plot() and plot_history(); not with figures=False

        Each file is written whole or not at all. Raises OSError, or at last ImportError when matplotlib is missing.
        """
        out = made_folder(folder)
        written = ["calibration.json", "history.json"]
        write_json(out / "calibration.json", self._summary())
        write_json(out / "history.json", history_rows(self.history))
        for k, camera in enumerate(self.cameras):
            save_camera(out / f"camera-{k}.json", camera)
            written.append(f"camera-{k}.json")
        draw = {"fit.png": self.plot} | ({"loss.png": self.plot_history} if self.history else {})
        return written + (write_figures(out, draw) if figures else [])

    def _summary(self) -> dict[str, Any]:
        camera = self.camera
        found: dict[str, Any] = {
            "K": camera.K.tolist(), "distortion": camera.coefficients.tolist(), "size": list(camera.size),
            "projection": camera.projection,
        }  # fmt: skip
        if (known := self.uncertainty) is not None:
            found["standard_deviations"] = {
                "focal": known.focal * float(camera.K[0, 0]), "principal": known.principal.tolist(),
                "distortion": known.distortion.tolist(),
                "poses": [
                    {"degrees": one.degrees, "shift": one.shift} for fit in self.fits if (one := fit.uncertainty) is not None
                ],
            }  # fmt: skip
        return found | {
            "reason": self.reason, "converged": self.converged, "loss": number_or_none(self.loss),
            "explained": [fit.explained for fit in self.fits], "steps": self.steps, "seconds": round(self.seconds, 3),
        }  # fmt: skip

    @property
    def _can_draw(self) -> bool:
        return all(fit.search.history for fit in self.fits)


@in_full_precision
def calibrate(
    mesh: Mesh | Scene,
    images: Images | None,
    cameras: Camera | Sequence[Camera],
    *,
    masks: Images | None = None,
    principal: bool = True,
    distortion: int = 4,
    options: FitOptions | None = None,
) -> Calibration:
    """Find the lens that took several pictures of a known object, and the place of each.

    Parameters
    ----------
    mesh : Mesh or Scene
        What the pictures show, with its colours; the background of a Scene is known, if it has one.
    images, masks
        As of fit_pose(), of one size.
    cameras : Camera or sequence of Camera
        One for each picture, with one K and distortion: where the fit starts, each within about 30° and 15 % of the mesh's
        size.
    principal, distortion
        As of fit_camera(). The focal length is always found.
    options : FitOptions, optional
        Of its defaults, `steps` is 60 on each level of a search, `step_tolerance` 3e-4, `spp` 16 and `max_size` 512. The files
        of a checkpoint are PATH.0, PATH.1, … with the search of each picture.

    Returns
    -------
    Calibration
        `camera`, `cameras`, and `uncertainty` with the standard deviation of each number.

    Raises
    ------
    TypeError, ValueError
        An argument is wrong; the message names it.

    Notes
    -----
    Pictures that were cropped or zoomed have another lens than the others. The object should fill the pictures, lie near their
    corners in some, and be seen from several sides. Where a number is hardly known, the fit has not `converged`, and `reason`
    names it.
    """
    began = time.perf_counter()
    given = _cameras(cameras, distortion)
    lens = Unknowns(False, True, check_flag("principal", principal), distortion)
    used = (*POSE_OPTIONS, "checkpoint")
    first = None if options is None else _file(options.checkpoint, 0)
    own = options if first is None or options is None else replace(options, checkpoint=first)
    settings = Settings.from_options(own, "calibrate", used, steps=60, max_size=512)
    if images is None and masks is None:
        raise ValueError("images: expected pictures or masks to compare with, got neither")
    n = len(given)
    pictures, shapes = one_for_each("images", images, n, 3), one_for_each("masks", masks, n, 2)
    name = "masks" if images is None else "images"
    for k, (camera, picture) in enumerate(
        zip(given, shapes if images is None else pictures, strict=True)
    ):  # All are checked before the first search.
        check_image(f"{name}[{k}]", picture, camera.size)
    fits: list[CameraFit] = []
    callback = settings.callback

    def report(now: PoseFit) -> None:
        assert callback is not None
        callback(Calibration([*fits, fitted(now)], Ending.STEPS, time.perf_counter() - began, []))

    start = torch.eye(4, dtype=torch.float64)
    for k, (camera, picture, shape) in enumerate(zip(given, pictures, shapes, strict=True)):
        names = ArgumentNames(images=f"images[{k}]", masks=f"masks[{k}]")
        alone = replace(
            settings, max_size=max(MIN_PICTURE_SIDE, min(settings.max_size, max(camera.size)) // 2),
            callback=None if callback is None else report, checkpoint=_file(None if options is None else options.checkpoint, k),
        )  # fmt: skip
        search = search_pose(mesh, picture, camera, shape, start, lens, None, None, names, alone)
        fits.append(fitted(search))
        if search.interrupted:
            return Calibration(fits, Ending.INTERRUPTED, time.perf_counter() - began, [])
    return _adjust(fits, given, settings, began)


def _file(checkpoint: Checkpoint | PathLike | None, k: int) -> Checkpoint | None:
    """Return the checkpoint of picture k. Only the first must be there to go on from: a fit may end before the others begin."""
    if checkpoint is None:
        return None
    whole = checkpoint if isinstance(checkpoint, Checkpoint) else Checkpoint(checkpoint)
    path = f"{whole.path}.{k}"
    return replace(whole, path=path, resume=whole.resume and (k == 0 or Path(path).exists()))


def _adjust(fits: list[CameraFit], given: list[Camera], settings: Settings, began: float) -> Calibration:
    """Refine all poses and the lens together, from the fits of single pictures."""
    searches, history = [fit.search for fit in fits], list[Record]()
    sources: list[LossSource] = []
    bar = tqdm(desc="calibrate", unit="step", disable=not settings.progress, leave=False)

    def result(end: Adjustment, ending: Ending, judged: Sequence[tuple[float, float]]) -> Calibration:
        found = [
            ended(search, source, pose, end.covariance_of(k, source), [camera], ending is Ending.FLAT, *judgement)
            for k, (search, source, pose, camera, judgement) in enumerate(
                zip(searches, sources, end.poses, given, judged, strict=True)
            )
        ]
        return Calibration(found, ending, time.perf_counter() - began, list(history))

    def after_step(end: Adjustment) -> None:
        nonlocal best
        history.append(_record(len(history), sources, end))
        bar.set_postfix_str(f"loss {history[-1].loss:.3e}", refresh=False)
        bar.update()
        shares = zip(end.evidence, searches, strict=True)
        best = result(end, Ending.STEPS, [(one.loss, search.explained) for one, search in shares])
        if settings.callback is not None:
            settings.callback(best)

    best = Calibration(fits, Ending.INTERRUPTED, 0.0, history)
    try:
        for k, search in enumerate(searches):
            assert search.task is not None
            own = replace(settings, seed=(settings.seed + 7919 * k) % 2**32)
            sources.append(loss_source(search.task, pose_of(search), own))
        end = adjust_bundle(sources, [pose_of(search) for search in searches], after_step=after_step)
        judged = [source.judged(pose) for source, pose in zip(sources, end.poses, strict=True)]
        return result(end, Ending.FLAT if end.short else Ending.STEPS, judged)
    except KeyboardInterrupt:
        return replace(best, ending=Ending.INTERRUPTED, seconds=time.perf_counter() - began)
    finally:
        bar.close()


def _record(number: int, sources: Sequence[LossSource], end: Adjustment) -> Record:
    values: dict[str, Tensor] = {}
    squares = {"world_to_camera": 0.0, "K": 0.0, "distortion": 0.0}
    of_lens: Tensor | float = 0.0
    for k, (source, pose, evidence) in enumerate(zip(sources, end.poses, end.evidence, strict=True)):
        camera = moved(source.task.lens(source.task.shots[0].camera, pose), pose.matrix)
        sought = ("world_to_camera", "K", *(("distortion",) if DISTORTION in source.task.dofs else ()))
        values |= {f"cameras.{k}.{name}": getattr(camera, name).clone() for name in sought}
        count = len(poses_of(source))
        gradient = evidence.per_loss / len(sources) * evidence.gradient
        squares["world_to_camera"] += float(gradient[:count].square().sum())
        of_lens = of_lens + gradient[count:]
    assert isinstance(of_lens, Tensor)
    entries = [entry for entry in sources[0].task.dofs if entry >= FOCAL_LENGTH]
    for entry, slope in zip(entries, of_lens.tolist(), strict=True):
        squares["K" if entry < DISTORTION else "distortion"] += slope**2
    if DISTORTION not in entries:
        del squares["distortion"]
    return Record(number, end.loss / len(sources), {name: square**0.5 for name, square in squares.items()}, values)


def _cameras(cameras: object, distortion: object) -> list[Camera]:
    """Return the cameras one by one, with one lens. Raises TypeError or ValueError."""
    found = [with_coefficients(f"cameras[{k}]", camera, distortion) for k, camera in enumerate(cameras_of(cameras))]
    first = found[0]
    for k, camera in enumerate(found):
        if camera.projection not in PROJECTIONS:
            raise ValueError(
                f"cameras[{k}]: expected a perspective or a fisheye camera, got {camera.projection}, which has no lens to find"
            )
        if camera.size != first.size or camera.projection != first.projection:
            raise ValueError(
                f"cameras[{k}]: expected {first.projection}, {first.size[0]} × {first.size[1]} pixels, like cameras[0], got "
                f"{camera.projection}, {camera.size[0]} × {camera.size[1]}; calibrate pictures of one size and lens at a time"
            )
        same = torch.equal(camera.K.double(), first.K.double())
        if not same or not torch.equal(camera.coefficients.double(), first.coefficients.double()):
            raise ValueError(
                f"cameras[{k}]: expected the K and distortion of cameras[0], got others; the pictures are of one lens: start all "
                "from the same guess of it"
            )
    return found
