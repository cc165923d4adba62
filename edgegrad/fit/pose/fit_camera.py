"""fit_camera(): where a picture of a known scene was taken, and through which lens."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from ...camera.camera import Camera
from ...camera.lens import COEFFICIENT_COUNTS
from ...check import check_flag, check_int
from ...files.cameras import save_camera
from ...files.paths import PathLike, write_json
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ...scene.tree import map_tensors
from ..history import Record, history_rows
from ..modes import in_full_precision
from ..options import POSE_OPTIONS, FitOptions, Settings
from ..result import FitResult, delegated, made_folder
from ..views import Images, cameras_of
from .bundle_adjustment import adjust_bundle
from .camera_uncertainty import CameraUncertainty
from .fit_pose import search_pose
from .inputs import ArgumentNames
from .loss_model import ColorLoss, LossSource, loss_source
from .pose import Pose
from .result import PoseFit, Step, with_own_history
from .settings import CAMERA
from .task import STEP_PARTS, Unknowns

# Each part of a step moves one tensor of a camera.
TENSOR_OF = {
    "rotation": "world_to_camera", "shift": "world_to_camera", "focal": "K", "principal": "K", "distortion": "distortion",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class CameraFit(FitResult):
    """The result of fit_camera(), a FitResult: the cameras, and the search, in which the scene moved before cameras at rest.

    `history` has a Record of each step: the loss, comparable within one level of the image pyramid; the cameras, float64, by
    the names that fit_scene() has for them ("cameras.0.world_to_camera", and "cameras.0.K" and "cameras.0.distortion" where
    they are sought); and norms of the gradient by "world_to_camera" (in radians and sizes of the scene), "K" (logarithm of
    the focal length, widths of the image) and "distortion", which all cameras share. Norms are those of numbers sought on the
    level; there are none where the loss rose and the step was taken back. The last record is the final comparison.
    `search.history` has the size of the level and marks the best steps so far.

    `uncertainty` has the standard deviation of each number that was sought; None before the last step and after an
    interruption.
    """

    cameras: list[Camera]
    search: PoseFit
    uncertainty: CameraUncertainty | None = None
    loss, explained, steps, seconds, converged, interrupted, plot, plot_history, _repr_png_ = delegated(
        "search", "loss explained steps seconds converged interrupted plot plot_history _repr_png_"
    )

    @property
    def camera(self) -> Camera:
        """Return the first camera."""
        return self.cameras[0]

    @property
    def history(self) -> list[Record]:
        return [self._record(number, step) for number, step in enumerate(self.search.history)]

    @property
    def reason(self) -> str:
        """Return the reason as PoseFit has it, or "not known: …" with numbers of pose and lens that the pictures hardly show."""
        known = self.uncertainty
        if known is None or not known.unknown:
            return self.search.reason
        return reason_with(replace(self.search, uncertainty=None, converged=True).reason, known)

    def save(self, folder: PathLike, figures: bool = True) -> list[str]:
        """Write the result to a folder, and return the names of the files. Raises OSError, ImportError.

        They are history.json, camera.json for load_camera (of several cameras camera-0.json and so on) and what PoseFit.save
        writes. ImportError comes at last, when matplotlib or pillow is missing.
        """
        out = made_folder(folder)
        several = len(self.cameras) > 1
        own = [f"camera-{i}.json" if several else "camera.json" for i in range(len(self.cameras))]
        for name, camera in zip(own, self.cameras, strict=True):
            save_camera(out / name, camera)
        own.append(self.write_history(folder))
        return [*own, *self.search.save(folder, figures)]

    def write_history(self, folder: PathLike) -> str:
        """Write history.json alone, with loss, gradient norms and cameras of each step; return its name. Raises OSError."""
        write_json(Path(folder) / "history.json", history_rows(self.history))
        return "history.json"

    def _record(self, number: int, step: Step) -> Record:
        task = self.search.task
        assert task is not None
        sought = [
            TENSOR_OF[name] for name, entries in STEP_PARTS.items() if any(entry in task.dofs for entry in entries)
        ]
        values = {}
        for i, shot in enumerate(task.shots):
            camera = moved(task.lens(shot.camera, step.pose), step.pose.matrix)
            values |= {f"cameras.{i}.{name}": getattr(camera, name).clone() for name in dict.fromkeys(sought)}
        squares: dict[str, float] = {}
        for part, norm in step.gradient.items():
            squares[TENSOR_OF[part]] = squares.get(TENSOR_OF[part], 0.0) + norm**2
        return Record(number, step.loss, {name: math.sqrt(square) for name, square in squares.items()}, values)


@in_full_precision
def fit_camera(
    scene: Mesh | Scene,
    images: Images | None,
    cameras: Camera | Sequence[Camera],
    *,
    masks: Images | None = None,
    weights: Images | None = None,
    focal: bool = True,
    principal: bool = False,
    distortion: int = 0,
    search: bool = True,
    options: FitOptions | None = None,
) -> CameraFit:
    """Find pose and lens of the camera that took a picture of a known scene.

    Parameters
    ----------
    scene : Mesh or Scene
        What the picture shows, where it is; unlit, or all colours as they are in the picture.
    images, masks, weights, search
        As of fit_pose().
    cameras : Camera or sequence of Camera
        Where the fit starts, within about 30° and 15 % of the scene's size. Several, one for each picture, keep their places to
        one another, as those of a rig, and share what is found of the lens.
    focal, principal : bool, default True and False
        Whether the focal length, one factor for both of K, and the principal point are sought.
    distortion : int, default 0
        Number of coefficients to find, at most 8 (of a fisheye 4): the first of those that a Camera has. Further ones stay.
    options : FitOptions, optional
        Of its defaults, `steps` is 60 on each level, `step_tolerance` 3e-4, `spp` 16 and `max_size` 512.

    Returns
    -------
    CameraFit
        `camera` and `cameras`; `uncertainty` has the standard deviation of each number.

    Raises
    ------
    TypeError, ValueError
        An argument is wrong; the message names it.

    Notes
    -----
    A picture may leave focal length and distance open, or the principal point and a rotation of the camera. The fit has not
    `converged` where a number of the lens is hardly known: where its deviation moves a corner of the image by more than 3 % of
    its distance from the principal point, or where a guess says as much. Several pictures from different sides say more, see
    calibrate().
    """
    given = [with_coefficients("cameras", one, distortion) for one in cameras_of(cameras)]
    lens = Unknowns(False, check_flag("focal", focal), check_flag("principal", principal), distortion)
    settings = Settings.from_options(options, "fit_camera", (*POSE_OPTIONS, "checkpoint"), steps=60, max_size=512)
    callback = settings.callback
    watched = replace(settings, callback=None if callback is None else lambda search: callback(fitted(search)))
    start = torch.eye(4, dtype=torch.float64)
    names = ArgumentNames("scene")
    found = search_pose(
        scene, images, given, masks, start, lens, weights, None, names, watched, check_flag("search", search)
    )
    return fitted(found) if found.interrupted else finished(found, given, settings)


def finished(search: PoseFit, cameras: Sequence[Camera], settings: Settings) -> CameraFit:
    """Finish a search by some steps of all numbers at once, and add their uncertainty."""
    began, task = time.perf_counter(), search.task
    assert task is not None
    pose, shown = pose_of(search), search.explained >= search.enough
    source = loss_source(task, pose, settings)
    # A search by colours holds back numbers that the pictures hardly show; one by photographs is at its end.
    further = shown and isinstance(source, ColorLoss)
    try:
        end = adjust_bundle([source], [pose], min(CAMERA.adjust_steps, settings.steps) if further else 0)
    except KeyboardInterrupt:
        return fitted(replace(search, interrupted=True, converged=False))
    rests = end.short if further else search.converged or search.reason.startswith("directions unknown")
    loss = end.loss if further else search.loss
    found = ended(search, source, end.poses[0], end.covariance, cameras, rests, loss, search.explained)
    whole = replace(found.search, seconds=search.seconds + time.perf_counter() - began)
    return replace(found, search=whole)


def ended(
    search: PoseFit, source: LossSource, pose: Pose, covariance: Tensor, cameras: Sequence[Camera], rests: bool, loss: float,
    explained: float,
) -> CameraFit:  # fmt: skip
    """Return a fit whose search reached another pose and lens at last, with the covariance of the entries of a step there."""
    task, known = source.task, CameraUncertainty.from_covariance(source, pose, covariance)
    lenses = [map_tensors(task.lens(one, pose), Tensor.clone) for one in cameras]
    last = search.history[-1]
    history = search.history if pose is last.pose else [*search.history, Step(source.level.size, loss, pose, True, {})]
    right = rests and explained >= search.enough and not search.conflict and not known.unknown
    found = replace(
        search, R=pose.R.clone(), t=pose.t.clone(), scale=float(pose.scale), camera=lenses[0], cameras=lenses, loss=loss,
        explained=explained, history=history, steps=len(history), uncertainty=known, converged=right,
    )  # fmt: skip
    return fitted(with_own_history(found), known)


def fitted(search: PoseFit, uncertainty: CameraUncertainty | None = None) -> CameraFit:
    """Return a search that moved the scene before cameras as a fit of the cameras."""
    return CameraFit([moved(seen, search.matrix) for seen in search.cameras], search, uncertainty)


def pose_of(search: PoseFit) -> Pose:
    """Return the best pose so far, with what was found of the lens."""
    return next(step.pose for step in reversed(search.history) if step.best)


def reason_with(words: str, known: CameraUncertainty) -> str:
    """Return `words`, or what is not known of poses and lens where the end is right otherwise."""
    if words != "converged" or not known.unknown:
        return words
    fix = "seek less of the lens, or give pictures that the object fills, from several sides or nearer"
    return f"not known: {known.unknown}; {fix}"


def with_coefficients(name: str, camera: object, count: object) -> Camera:
    """Return the camera with room for `count` coefficients of distortion. Raises TypeError or ValueError."""
    if not isinstance(camera, Camera):
        raise TypeError(f"{name}: expected a Camera, got {type(camera).__name__}; make one with Camera.look_at(…)")
    counts = COEFFICIENT_COUNTS[camera.projection]
    number, most = check_int("distortion", count, 0, 2**31 - 1), max(counts, default=0)
    if number > most:
        raise ValueError(f"distortion: expected at most {most} for a camera that is {camera.projection}, got {number}")
    had = 0 if camera.distortion is None else camera.distortion.shape[-1]
    if number <= had:
        return camera
    wanted = min(n for n in counts if n >= number)
    kept = camera.coefficients[..., :had]
    return camera.replace(distortion=torch.nn.functional.pad(kept, (0, wanted - had)))


def moved(camera: Camera, matrix: Tensor) -> Camera:
    """Return the camera W M that sees a scene at rest as this one, W, sees it moved by the matrix M (4, 4)."""
    W = camera.world_to_camera
    return camera.replace(world_to_camera=(W.detach().double() @ matrix).to(W))
