"""fit_camera() and calibrate(): where pictures of a known scene were taken, and through which lens.

Of several places, each is first searched alone, at half the resolution. Then Gauss-Newton steps move all poses and the one lens
together (bundle_adjustment.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ...camera.camera import Camera
from ...camera.lens import COEFFICIENT_COUNTS
from ...check import check_flag, check_int
from ...optim.levenberg_marquardt import LevenbergMarquardt, Rest, minimise
from ...optim.tensors import Ending
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ...scene.tree import map_tensors
from ..by_camera import one_for_each
from ..checkpoints import checkpoint_of
from ..modes import in_full_precision
from ..options import MIN_PICTURE_SIDE, POSE_OPTIONS, FitOptions, Settings, options_of
from ..placement import Pose
from ..views import Images, cameras_of, check_image
from .bundle_adjustment import Adjustment, Bundle, Poses
from .camera_result import CameraFit, fitted
from .fit_pose import search_pose
from .hypotheses import norms_of
from .inputs import ArgumentNames
from .likelihood.objective import PoseLevel, pose_levels
from .likelihood.support import evidence_of
from .result import PoseFit, Step
from .settings import CAMERA
from .task import Unknowns
from .uncertainty import Uncertainty

PROJECTIONS = "perspective", "fisheye"
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
) -> CameraFit:
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
        Of its defaults, `steps` is 60 on each level of a search, `step_tolerance` 3e-4, `spp` 16 and `max_size` 512. A
        checkpoint has a file for the search of each picture, with its number in the name.

    Returns
    -------
    CameraFit
        `cameras`, `uncertainty` with the standard deviation of each number of the first camera, and `uncertainties` of all.

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
    given = _cameras(cameras, distortion)
    lens = Unknowns(False, True, check_flag("principal", principal), distortion)
    parts = options_of(options)
    settings = Settings.from_options(
        parts.of_part(0), "calibrate", (*POSE_OPTIONS, "checkpoint"), steps=60, max_size=512
    )
    if images is None and masks is None:
        raise ValueError("images: expected pictures or masks to compare with, got neither")
    n = len(given)
    pictures, shapes = one_for_each("images", images, n, 3), one_for_each("masks", masks, n, 2)
    name = "masks" if images is None else "images"
    for k, (camera, picture) in enumerate(
        zip(given, shapes if images is None else pictures, strict=True)
    ):  # All are checked before the first search.
        check_image(f"{name}[{k}]", picture, camera.size)
    searches: list[PoseFit] = []
    callback = settings.callback

    for k, (camera, picture, shape) in enumerate(zip(given, pictures, shapes, strict=True)):
        names = ArgumentNames(images=f"images[{k}]", masks=f"masks[{k}]")
        alone = replace(
            settings, max_size=max(MIN_PICTURE_SIDE, min(settings.max_size, max(camera.size)) // 2),
            callback=None if callback is None else lambda now: callback(fitted([*searches, now])),
            checkpoint=checkpoint_of(parts.of_part(k).checkpoint),
        )  # fmt: skip
        searches.append(search_pose(mesh, picture, camera, shape, START, lens, None, None, names, alone))
        if searches[-1].interrupted:
            return fitted(searches, Ending.INTERRUPTED)
    return refined(searches, settings)


def refined(searches: Sequence[PoseFit], settings: Settings) -> CameraFit:
    """Refine the poses of all places and their one lens together, and add how exactly they are known. Ctrl-C ends this with the
    best so far."""
    joint, best, end = list[Step](), fitted(searches), None
    supports, ending = [search.explained for search in searches], Ending.STEPS
    progress = settings.progress_of("lens", lambda: best)

    def result(end: Adjustment) -> CameraFit:
        places = zip(searches, levels, end.poses, end.covariances, end.costs, supports, strict=True)
        found = [_at_end(*place, rests=ending is Ending.FLAT, alone=len(searches) == 1) for place in places]
        return fitted(found, ending, joint)

    def after_step(descents: LevenbergMarquardt[Poses]) -> None:
        nonlocal best, end
        if bundle.last is not None and descents.descents[0].point is bundle.last.poses:
            end = bundle.last
        assert end is not None
        dofs = levels[0].task.dofs
        joint.append(Step(levels[0].size, end.loss, end.poses[0], True, norms_of(dofs, end.gradient(dofs))))
        best = result(end)
        progress.step(f"loss {end.loss:.3e}")

    with progress:
        levels, starts = list[PoseLevel](), list[Pose]()
        for k, search in enumerate(searches):
            task, own = search.task, replace(settings, seed=(settings.seed + 7919 * k) % 2**32)
            assert task is not None
            starts.append(next(step.pose for step in reversed(search.history) if step.best))
            levels.append(pose_levels(task, starts[k], [None] * len(task.shots), own)[-1])
        levels = [level.informed([pose]).focused(pose) for level, pose in zip(levels, starts, strict=True)]
        bundle = Bundle(levels)
        most = min(CAMERA.adjust_steps, settings.steps)
        found = minimise(bundle, [bundle.agreed(starts)], bundle.settings(most), after_step)
        if found.interrupted:
            raise KeyboardInterrupt
        assert end is not None
        # Where the searches ended, a part of the residuals was of the poses: deviations by these would be nearly twice as wide.
        levels = [level.informed([pose]).focused(pose) for level, pose in zip(levels, end.poses, strict=True)]
        bundle = Bundle(levels)
        bundle.model([end.poses])
        assert bundle.last is not None
        end = bundle.last._replace(costs=end.costs)
        supports = [evidence_of(level, pose).edges for level, pose in zip(levels, end.poses, strict=True)]
        ending = Ending.FLAT if found.descents[0].rest is Rest.SHORT else Ending.STEPS
        best = result(end)
    each = progress.seconds / len(searches)
    places = [replace(search, seconds=search.seconds + each) for search in best.searches]
    return replace(best, searches=places, ending=Ending.INTERRUPTED if progress.interrupted else best.ending)


def _at_end(
    search: PoseFit, level: PoseLevel, pose: Pose, covariance: Tensor, loss: float, explained: float, rests: bool, alone: bool
) -> PoseFit:  # fmt: skip
    """Return the search of one place with the pose and lens that it reached at last."""
    task = level.task
    known = Uncertainty.from_covariance(task, pose, covariance)
    lenses = [task.lens(shot.camera, pose) for shot in task.shots]
    cameras = [
        seen.replace(K=lens.K.to(seen.K), distortion=None if lens.distortion is None else lens.distortion.to(seen.K))
        for seen, lens in zip(search.cameras, lenses, strict=True)
    ]
    cameras = map_tensors(cameras, Tensor.clone)
    # The last entry is the final comparison.
    earlier = search.history[:-1] if pose is search.history[-1].pose else search.history
    history = map_tensors([*earlier, Step(level.size, loss, pose, True, {})], Tensor.clone)
    # One lens in several places decides between poses that one picture alone leaves open by lenses of their own.
    conflict = search.conflict if alone else ""
    return replace(
        search, R=pose.R.clone(), t=pose.t.clone(), scale=float(pose.scale), camera=cameras[0], cameras=cameras, loss=loss,
        explained=explained, conflict=conflict, history=history, steps=len(history), uncertainty=known, converged=rests,
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
