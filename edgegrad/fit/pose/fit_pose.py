"""fit_pose(): the pose of a known mesh in one or several pictures.

An image pyramid is searched from coarse to fine, from several hypotheses (hypotheses.py), by a sum of log likelihoods
(likelihood/), in which what covers the object hardly counts. Each damped Gauss-Newton step rotates the object about its centre,
shifts it in units of its size, and changes logarithms of scale and focal length.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from ...camera.camera import Camera
from ...check import check_flag, check_int
from ...optim.loop import Progress
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ...scene.symmetries import Symmetries
from ...scene.tree import map_tensors
from ..checkpoints import CheckpointFile, traits
from ..measured import depth_images
from ..modes import in_full_precision
from ..options import POSE_OPTIONS, FitOptions, Settings
from ..placement import Pose, angle, pose_from_matrix
from ..views import Images, cameras_of
from .confidence import features_of
from .hypotheses import probabilities
from .initial_pose import initial_pose
from .inputs import ArgumentNames, check_in_front, warn_of_units
from .pose_search import Groups, PoseSearch, Report, anywhere, around, everywhere
from .replay_log import ReplayLog
from .result import PoseFit, PoseMode
from .settings import CAMERA, POSE
from .task import PoseTask, Unknowns
from .uncertainty import Uncertainty

MOST_STARTS = 1000
Search = bool | int | Literal["global"]


@in_full_precision
def fit_pose(
    mesh: Mesh | Scene,
    images: Images | None,
    cameras: Camera | Sequence[Camera],
    masks: Images | None = None,
    init: PoseFit | Tensor | None = None,
    *,
    scale: bool = False,
    focal: bool = False,
    weights: Images | None = None,
    depths: Images | None = None,
    search: Search = True,
    symmetries: Symmetries | Literal["find"] | None = None,
    options: FitOptions | None = None,
) -> PoseFit:
    """Find rotation and translation of a known mesh in a picture, or in several.

    Parameters
    ----------
    mesh : Mesh or Scene
        What the pictures show, with its colours; the meshes of a Scene move together, before its background. Without one, the
        background is the median colour of the picture's border, or unknown where the border has many colours.
    images : Tensor or sequence of Tensor, or None
        (H, W, C) linear radiance in any unit, as read_image() gives it; None: the masks alone.
    cameras : Camera or sequence of Camera
        One for each picture, of its size.
    masks : Tensor or sequence of Tensor, optional
        (H, W), 1 on the object and 0 elsewhere. A plain mesh is fitted to the mask alone.
    init : PoseFit or Tensor, optional
        An earlier fit, or mesh to world (4, 4), within about 30° and 15 % of the object's size of the true pose. By default
        where the mesh file puts the object, or else in the middle of the mask or picture.
    scale, focal : bool, default False
        Whether the mesh's scale, and the focal length, are sought too.
    weights, depths : Tensor or sequence of Tensor, optional
        (H, W): how much a pixel counts, ≥ 0; and distances along the camera's axis +Z, 0 or NaN where none was measured.
    search : bool, int or "global", default True
        False: `init` alone is refined. True: poses turned from it are compared, too. A number of starts, rotated around `init`,
        or in all ways without one. "global": the whole picture is searched.
    symmetries : Symmetries or "find", optional
        Of the mesh. Of the poses that they make equal, the one nearest to the start is returned.
    options : FitOptions, optional
        Of its defaults, `steps` is 40 on each level, `step_tolerance` 3e-4, `spp` 16 and `max_size` 256.

    Returns
    -------
    PoseFit
        `R`, `t`, `scale`, `matrix` and `camera`; `uncertainty` says how exactly the pictures show them.

    Raises
    ------
    TypeError, ValueError
        An argument is wrong, or the object leaves no trace in the picture at the start; the message names it.
    """
    lens = Unknowns(check_flag("scale", scale), check_flag("focal", focal))
    settings = Settings.from_options(options, "fit_pose", (*POSE_OPTIONS, "checkpoint"), steps=40)
    known = symmetries_of(symmetries, mesh)
    return search_pose(
        mesh, images, cameras, masks, init, lens, weights, depths, ArgumentNames(), settings, search, known
    )


def search_pose(
    mesh: Mesh | Scene, images: object, cameras: object, masks: object, init: object, lens: Unknowns, weights: object,
    depths: object, names: ArgumentNames, settings: Settings, search: Search = True, symmetries: Symmetries | None = None,
) -> PoseFit:  # fmt: skip
    """Run fit_pose() with any set of sought numbers of the lens."""
    progress = settings.progress_of("fit", lambda: fit_of(state, progress, given_cameras))
    given_cameras = cameras_of(cameras)
    _check_search(search, init, given_cameras, names.init)
    given = pose_from_matrix("init", torch.eye(4) if init is None else getattr(init, "matrix", init))
    task = PoseTask.from_arguments(mesh, images, given_cameras, masks, weights, lens, float(given.scale), names)
    start = initial_pose(task) if init is None else given
    check_in_front(names.init, task.shots[0].camera, start, task.center)
    file = CheckpointFile(settings.checkpoint, {
        names.init: None if init is None else given.matrix, names.mesh: mesh, names.images: images, "masks": masks,
        "weights": weights, "cameras": [traits(one) for one in given_cameras], **lens._asdict(), "depths": depths,
        "search": search, "symmetries": symmetries,
        **{name: getattr(settings, name) for name in ("max_size", "steps", "spp", "step_tolerance", "seed")},
    })  # fmt: skip
    saved = file.read()
    log = ReplayLog() if saved is None else ReplayLog(saved["values"])
    seen = [shot.camera for shot in task.shots]
    measured = depth_images(depths, seen)
    if search != "global":
        warn_of_units(task.scene.transformed(start.R, start.t, start.scale), seen, measured, "at the start")

    proposals: Callable[[Report], Groups] | None = None
    if search == "global":
        proposals = partial(anywhere, task, settings.seed)
    elif not isinstance(search, bool):
        poses = (around if init is not None else everywhere)(task, start, search)
        proposals = lambda _: [(start, poses)]  # noqa: E731
    state = PoseSearch(
        task, start, measured, settings, log, search is not False, proposals=proposals, symmetries=symmetries
    )  # fmt: skip

    def keep() -> None:
        file.write({"values": log.values, "seconds": progress.seconds})

    def after_step() -> None:
        last = state.history[-1]
        progress.step(f"{last.size[1]} × {last.size[0]} px, loss {last.loss:.2e}")

    progress.keep, progress.steps, progress.earlier = keep, len(log.values), 0.0 if saved is None else saved["seconds"]
    progress.total = max(state.planned, progress.steps)
    state.after_step = after_step
    with progress:
        state.report = progress.bar.set_postfix_str
        state.run()
        if search == "global":
            warn_of_units(task.scene.transformed(state.best.R, state.best.t, state.best.scale), seen, measured, "found")
    keep()
    return fit_of(state, progress, given_cameras)


def fit_of(
    state: PoseSearch, progress: Progress, cameras: Sequence[Camera], conflict: str = "", visible: float = 1.0
) -> PoseFit:  # fmt: skip
    """Return what a search has found so far, in tensors of its own, which a callback may change."""
    task, symmetries = state.task, state.symmetries
    best: Pose = state.best if symmetries is None else state.best.closest(symmetries, state.start)
    shares = zip(state.modes, probabilities(state.modes), strict=True)
    modes = [PoseMode(mode.pose.matrix.clone(), share) for mode, share in shares]
    known, features = None, dict[str, float]()
    if state.information is not None and state.evidence is not None:
        known = Uncertainty.from_information(task, best, state.information, symmetries)
        features = features_of(state.evidence, modes[0].probability, known)
    conflict = conflict or ambiguity(best, state.ambiguous, symmetries, task)
    rests = state.rests and not progress.interrupted
    seen = [map_tensors(task.lens(one, best), Tensor.clone) for one in cameras]
    history = map_tensors(list(state.history), Tensor.clone)
    return PoseFit(
        best.R.clone(), best.t.clone(), float(best.scale), seen[0], state.loss, len(history), progress.seconds, rests,
        progress.interrupted, state.edge_support, history, task, seen, known, visible, conflict, state.enough, modes, features,
    )  # fmt: skip


def ambiguity(pose: Pose, others: Sequence[Pose], symmetries: Symmetries | None, task: PoseTask) -> str:
    """Return in words that another pose, which is not known to be equivalent, may be the right one; else an empty string."""
    same = others if symmetries is None else [other.closest(symmetries, pose) for other in others]
    apart = max((angle(pose.R, other.R) for other in same), default=0.0)
    away = max((task.between(pose, other) for other in same), default=0.0)
    if apart < POSE.same_mode and away < CAMERA.most_shift:
        return ""
    other = f"turned by {math.degrees(apart):.0f}°" if apart >= POSE.same_mode else f"{away:.0%} of the size away"
    colors = "the mesh's colours, " if task.colorless else ""
    return (
        f"ambiguous: the pictures hardly separate it from a pose that is {other}; give {colors}"
        "symmetries of the mesh, depth, or another picture"
    )


def _check_search(search: object, init: object, cameras: Sequence[Camera], name: str) -> None:
    """Raise TypeError or ValueError for a search that does not go with the other arguments."""
    if search == "global":
        if init is not None:
            raise ValueError(
                f'search: expected a number with {name}, got "global", which searches for the object in the whole picture; '
                f"leave {name} out, or give a number of starts around it"
            )
        if (projection := cameras[0].projection) not in ("perspective", "orthographic"):
            raise ValueError(
                f'search: expected a perspective or orthographic camera for "global", got a {projection}; give {name}'
            )
    elif isinstance(search, str) or search is None:
        raise ValueError(f'search: expected True, False, a number of starts or "global", got {search!r}')
    elif not isinstance(search, bool):
        check_int("search", search, 2, MOST_STARTS)


def symmetries_of(given: object, mesh: Mesh | Scene, name: str = "symmetries") -> Symmetries | None:
    """Return the given or found symmetries. Raises TypeError or ValueError, or what Symmetries.find() raises."""
    if given is None or isinstance(given, Symmetries):
        return given
    if given == "find":
        return Symmetries.find(mesh)
    if isinstance(given, str):
        raise ValueError(f'{name}: expected Symmetries, "find" or None, got {given!r}')
    raise TypeError(f'{name}: expected Symmetries, "find" or None, got {type(given).__name__}')
