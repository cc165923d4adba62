"""fit_camera(): where a picture of a known scene was taken, and through which lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ...camera.camera import Camera
from ...camera.lens import COEFFICIENT_COUNTS
from ...check import check_flag, check_int
from ...optim.history import Ending, Record
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ...scene.tree import map_tensors
from ..modes import in_full_precision
from ..options import POSE_OPTIONS, FitOptions, Settings
from ..views import Images, cameras_of
from .bundle_adjustment import Adjustment, adjust_bundle
from .camera_result import CameraFit, fitted, record_of
from .fit_pose import search_pose
from .hypotheses import norms_of
from .inputs import ArgumentNames
from .likelihood.objective import PoseLevel, pose_levels
from .likelihood.support import evidence_of
from .result import PoseFit, Step
from .settings import CAMERA
from .task import Unknowns
from .uncertainty import Uncertainty

START = torch.eye(4, dtype=torch.float64)  # Cameras are searched for as poses of the scene.


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
    watched = replace(settings, callback=None if callback is None else lambda search: callback(fitted([search])))
    names = ArgumentNames("scene")
    found = search_pose(
        scene, images, given, masks, START, lens, weights, None, names, watched, check_flag("search", search)
    )
    return fitted([found], Ending.INTERRUPTED) if found.interrupted else refined([found], settings)


def refined(searches: Sequence[PoseFit], settings: Settings) -> CameraFit:
    """Refine the poses of all places and their one lens together, and add how exactly they are known. Ctrl-C ends this with the
    best so far."""
    levels, joint, best = list[PoseLevel](), list[Record](), fitted(searches)

    def result(end: Adjustment, ending: Ending, scores: Sequence[tuple[float, float]]) -> CameraFit:
        places = enumerate(zip(searches, levels, scores, strict=True))
        # One lens in several places decides between poses that one picture alone leaves open by lenses of their own.
        shared = {"conflict": ""} if len(searches) > 1 else {}
        found = [
            _at_end(
                level,
                end,
                k,
                replace(search, loss=loss, explained=explained, converged=ending is Ending.FLAT, **shared),
            )
            for k, (search, level, (loss, explained)) in places
        ]
        return fitted(found, ending, joint)

    def after_step(end: Adjustment) -> None:
        nonlocal best
        places = [(level.task, pose) for level, pose in zip(levels, end.poses, strict=True)]
        dofs = places[0][0].dofs
        joint.append(record_of(len(joint), end.loss, norms_of(dofs, end.gradient(dofs)), places))
        scores = zip(end.costs, searches, strict=True)
        best = result(end, Ending.STEPS, [(cost, search.explained) for cost, search in scores])
        progress.step(f"loss {end.loss:.3e}")

    progress = settings.progress_of("lens", lambda: best)
    with progress:
        starts = [next(step.pose for step in reversed(search.history) if step.best) for search in searches]
        for k, (search, start) in enumerate(zip(searches, starts, strict=True)):
            task, own = search.task, replace(settings, seed=(settings.seed + 7919 * k) % 2**32)
            assert task is not None
            level = pose_levels(task, start, [None] * len(task.shots), own)[-1]
            levels.append(level.informed([start]).focused(start))
        end = adjust_bundle(levels, starts, min(CAMERA.adjust_steps, settings.steps), after_step)
        ends = zip(levels, end.poses, strict=True)
        scores = [(float(level.costs([pose])[0]), evidence_of(level, pose).edges) for level, pose in ends]
        best = result(end, Ending.FLAT if end.short else Ending.STEPS, scores)
    each = progress.seconds / len(searches)
    found = [replace(search, seconds=search.seconds + each) for search in best.searches]
    return replace(best, searches=found, ending=Ending.INTERRUPTED if progress.interrupted else best.ending)


def _at_end(level: PoseLevel, end: Adjustment, k: int, search: PoseFit) -> PoseFit:
    """Return the search of place k with the pose and lens that it reached at last; `converged` says whether it rests."""
    task, pose = level.task, end.poses[k]
    known = Uncertainty.from_covariance(task, pose, end.covariances[k])
    lenses = [task.lens(shot.camera, pose) for shot in task.shots]
    cameras = [
        seen.replace(K=lens.K.to(seen.K), distortion=None if lens.distortion is None else lens.distortion.to(seen.K))
        for seen, lens in zip(search.cameras, lenses, strict=True)
    ]
    cameras = [map_tensors(camera, Tensor.clone) for camera in cameras]
    # The last entry is the final comparison.
    earlier = search.history[:-1] if pose is search.history[-1].pose else search.history
    history = [*earlier, Step(level.size, search.loss, pose, True, {})]
    right = search.converged and search.explained >= search.enough and not search.conflict and not known.unknown
    return replace(
        search, R=pose.R.clone(), t=pose.t.clone(), scale=float(pose.scale), camera=cameras[0], cameras=cameras,
        history=map_tensors(history, Tensor.clone), steps=len(history), uncertainty=known, converged=right,
    )  # fmt: skip


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
    return camera.replace(distortion=torch.nn.functional.pad(camera.coefficients[..., :had], (0, wanted - had)))
