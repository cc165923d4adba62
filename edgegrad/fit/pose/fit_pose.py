"""fit_pose(): the pose of a known mesh in one or several pictures.

An image pyramid is searched from coarse to fine. Colours as they are, or the mask of a plain mesh, are compared by a robust
squared difference of blurred pictures and renders (color_search.py); photographs by a sum of likelihoods (photo/level.py). In
both, what covers the object hardly counts. Each Gauss-Newton step rotates the object about its centre, shifts it in units of
its size, and changes logarithms of scale and focal length.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor
from tqdm import tqdm

from ...camera.camera import Camera
from ...check import as_tensor, check_flag, check_float, check_int, check_shape
from ...files.paths import PathLike
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ...scene.symmetries import Symmetries
from ..checkpoints import Checkpoint, traits
from ..options import check_checkpoint
from ..row_order import MIN_IOU_GAIN, warn_of_flipped_rows
from .color_search import ColorSearch
from .initial_pose import initial_pose
from .inputs import ArgumentNames, check_settings, warn_of_scale
from .photo.depth import warn_of_units
from .photo.match import matches
from .photo.multi_start import MultiStartSearch, Report, around, everywhere
from .photo.photo_search import SAME_POSE_ANGLE, PhotoSearch
from .pose import Pose, angle, pose_from_matrix
from .replay_log import ReplayLog
from .result import PoseFit
from .task import PoseTask, Unknowns
from .uncertainty import MAX_SHIFT, Uncertainty

MOST_STARTS = 1000


@torch.inference_mode(False)
@torch.enable_grad()
def fit_pose(
    mesh: Mesh | Scene,
    target: Tensor | Sequence[Tensor],
    camera: Camera | Sequence[Camera],
    mask: Tensor | Sequence[Tensor] | None = None,
    init: PoseFit | Tensor | None = None,
    *,
    fit_scale: bool = False,
    fit_focal: bool = False,
    background: Tensor | float | None = None,
    weight: Tensor | Sequence[Tensor] | None = None,
    depth: Tensor | Sequence[Tensor] | None = None,
    max_size: int = 256,
    steps: int = 40,
    spp: int = 16,
    tolerance: float = 3e-4,
    seed: int = 0,
    search: bool = True,
    starts: int | Literal["global"] = 1,
    progress: bool = True,
    callback: Callable[[PoseFit], None] | None = None,
    checkpoint: PathLike | None = None,
    checkpoint_every: int = 25,
    resume: bool = False,
    symmetries: Symmetries | Literal["find"] | None = None,
) -> PoseFit:
    """Find rotation and translation (and scale, and focal length) of a known mesh in a picture, or in several.

    mesh        what the picture shows, with its colours; the meshes of a Scene move together
    target      (H, W, C) linear radiance in any unit, as read_image gives it, with the mesh's channels; or a list of
                pictures. The object's gain in each of them is found together with the pose, and so is that of a background
                that is given
    camera      the camera of the picture, of size (H, W), or a list of them; with fit_focal, its focal length is where the
                fit starts
    mask        (H, W) or (H, W, 1), 1 on the object and 0 elsewhere, as read_mask gives it. Then the colours inside the mask
                and the mask itself are compared; a plain mesh, which has no colours to compare, is fitted to the mask alone.
                At the border of a soft mask the neighbouring colour counts, times the mask: what the picture has there,
                before black, a photograph's background or straight alpha, makes no difference. A mask that nowhere reaches
                0.5 causes a warning
    init        the pose to start from, within about 30° and 15 % of the object's size of the true one: an earlier fit, or
                mesh to world as a matrix (4, 4) for column vectors. When None, where the mesh file puts the object, if the
                camera sees it there (and the mask agrees); else in the middle of the mask, or of the picture
    fit_scale   also find the mesh's scale. One picture shows size over distance only, so the centre then keeps its depth
    fit_focal   also find the focal length: one factor for both of K
    background  without a mask, what stands behind the object: a number, (C,) or (H, W, C); when None, the scene's own, or
                else the median colour of the picture's border. If the border has many colours, the background counts as
                unknown: then only what the object covers is compared
    weight      (H, W) or (H, W, 1), from 0: how much a pixel counts, relative to the largest weight
    depth       (H, W) or (H, W, 1), as a depth camera measures it from where the picture was taken: distances along +Z of the
                camera in world units, 0 or NaN where there is none; or a list of them
    max_size    a larger picture is reduced to so many pixels on its longer side
    steps       largest number of steps on each level of the pyramid; in photographs 8, 12 or 20 of 40, and proportionally of
                more
    spp         samples a pixel of each render on the finest level; the others take as many in all
    tolerance   a step on the finest level is short when it is below this: in radians, object sizes (the diagonal of the
                bounding box), and logarithms of scale and focal length
    seed        the same seed gives the same fit
    search      False for a start near the answer: it alone is refined, wherever it leads
    starts      number of initial poses. Each is refined for a few steps; the best ones are refined to the end, until one
                shows 85 % of the render's edges. Around `init` they are rotated by up to 45°; without it they are rotated in
                all ways, at the place that `init` has for None. "global" searches for the object in the whole first picture,
                seen by a perspective or orthographic camera, from all sides and at sizes from 0.25 to 1.25 of the picture's
                shorter side, in 20 … 40 s of processor time, or in the mask, in 4 … 10 s; `init` is None then. 1: the start
                alone, and what `search` adds; more starts ignore `search`
    progress    show a bar with the loss on standard error
    callback    called after each step with the best fit so far
    checkpoint  a file that holds the fit's state, written every `checkpoint_every` steps and at the end, never in part
    resume      continue from the checkpoint, if there is one: the fit ends as if it had never stopped. A checkpoint of a fit
                with other arguments is refused
    symmetries  of the mesh: of the equivalent poses, the one nearest to the start is reported, by its rotation. "find" computes
                them with Symmetries.find(). They do not change the search itself

    Something unknown may cover about a quarter of the object; fit_poses() is for meshes that cover one another. The picture may
    be blurred by up to 1.4 pixels, and compressed: renders get the same blur. The start is refined first. The fit is
    `converged` if its last step was short and the pictures show enough of the render's edges (`explained`): 60 % where its
    colours as they are, or the mask of a plain mesh, were compared; 65 % by the terms for photographs; 85 % by these terms
    where the mesh is plain, or where its colours were compared first and did not fit. Where the pictures show less, it searches
    for better poses further off, which takes a few times as long, less where nothing in the picture matches the object. Where
    they show enough, but the object is covered or of another colour, it searches nearby, in about the same time again. Another
    pose is the answer only if its loss is lower than that of `init` in the final comparison, and the picture shows its edges as
    well. `uncertainty` says how exactly the pictures show the pose: a rotation known less exactly than to 5° (of a plain mesh
    2°), or a place than to 5 % of the object's size, is not `converged`, and `reason` names the direction; a continuous one of
    the `symmetries` counts as known. A plain mesh has its contour alone: it always takes other starts, as do meshes with
    colours whose rotation is known less exactly than to 1°. A pose is not `converged` if another one is about as likely.
    KeyboardInterrupt, also from the callback, ends the fit and returns the best so far with `interrupted` set. Works in
    torch.no_grad() and torch.inference_mode() too. Raises TypeError or ValueError that names the argument, also when the object
    leaves no trace in the picture at the start.
    """
    lens = Unknowns(check_flag("fit_scale", fit_scale), check_flag("fit_focal", fit_focal))
    return search_pose(
        mesh, target, camera, mask, init, lens, background, weight, depth, ArgumentNames(), max_size=max_size, steps=steps,
        spp=spp, tolerance=tolerance, seed=seed, search=search, progress=progress, callback=callback, checkpoint=checkpoint,
        checkpoint_every=checkpoint_every, resume=resume, symmetries=symmetries_of(symmetries, mesh),
        starts=starts,
    )  # fmt: skip


@torch.inference_mode(False)
@torch.enable_grad()
def search_pose(
    mesh: Mesh | Scene, target: object, camera: object, mask: object, init: object, lens: Unknowns,
    background: Tensor | float | None, weight: object, depth: object, names: ArgumentNames, *, max_size: int, steps: int,
    spp: int, tolerance: float, seed: int, search: bool, progress: bool, callback: Callable[[PoseFit], None] | None,
    checkpoint: PathLike | None, checkpoint_every: int, resume: bool, symmetries: Symmetries | None = None,
    starts: int | Literal["global"] = 1,
) -> PoseFit:  # fmt: skip
    """Run fit_pose() with any set of sought numbers of the lens."""
    began = time.perf_counter()
    check_settings(max_size, steps, spp, seed, tolerance)
    check_callback(callback, "a PoseFit")
    check_checkpoint(checkpoint, checkpoint_every, check_flag("resume", resume))
    _check_starts(starts, init, camera, names.init)
    given = pose_from_matrix("init", torch.eye(4) if init is None else getattr(init, "matrix", init))
    task = PoseTask.from_arguments(mesh, target, camera, mask, weight, background, lens, float(given.scale), names)
    if names == ArgumentNames():  # A camera may stand inside of a scene.
        warn_of_scale(names.mesh, task.scene.transformed(given.R, given.t, given.scale), task.shots[0].camera)
    start = initial_pose(task) if init is None else given
    given_cameras: list[Any] = list(camera) if isinstance(camera, Sequence) else [camera]
    file = Checkpoint(checkpoint, resume, {
        names.init: None if init is None else given.matrix, names.mesh: mesh, names.target: target, "mask": mask,
        "weight": weight, "camera": [traits(one) for one in given_cameras], "background": background,
        **dict(zip(names.lens, lens, strict=False)), "max_size": max_size, "steps": steps, "spp": spp,
        "tolerance": tolerance, "seed": seed, "depth": depth, "search": check_flag("search", search), "starts": starts,
    })  # fmt: skip
    saved = file.read()
    log, earlier = (ReplayLog(), 0.0) if saved is None else (ReplayLog(saved["replay_log"]), saved["seconds"])
    depths = depth_images(depth, task)
    seen = [shot.camera for shot in task.shots]
    if starts != "global":
        warn_of_units(task.scene.transformed(start.R, start.t, start.scale), seen, depths, "at the start")

    def search_from(start: Pose, log: ReplayLog, further: bool) -> ColorSearch | PhotoSearch:
        if task.aovs == ("alpha",) and depth is None:
            return ColorSearch(task, task.pyramid(start, max_size, spp), start, steps, tolerance, seed, log, further)
        return PhotoSearch(task, start, depths, max_size, spp, steps, tolerance, seed, log, further)

    state: ColorSearch | PhotoSearch | MultiStartSearch
    if starts == 1:
        state = search_from(start, log, search)
    else:

        def made(report: Report) -> list[Pose]:
            if starts == "global":
                return matches(task, seed, report)
            return (around if init is not None else everywhere)(task, start, starts)

        state = MultiStartSearch(task, start, made, depths, max_size, seed, log, partial(search_from, further=False))
    interrupted = False

    def seconds() -> float:
        return earlier + time.perf_counter() - began

    def keep() -> None:
        if checkpoint is not None:
            file.write({"replay_log": log.state(), "seconds": seconds()})

    def result() -> PoseFit:
        best: Pose = state.best if symmetries is None else state.best.closest(symmetries, start)
        history = list(state.history)
        cameras = [task.lens(one, best) for one in given_cameras]
        known = None
        if state.information is not None:
            known = Uncertainty.from_information(task, best, state.information, task.dofs, symmetries)
        conflict = ambiguity(best, state.ambiguous, symmetries, task)
        sure = state.converged and not interrupted and not conflict and (known is None or not known.unknown)
        return PoseFit(
            best.R, best.t, float(best.scale), cameras[0], state.loss, len(history), seconds(), sure, interrupted,
            state.edge_support, history, task, cameras, known, conflict=conflict, enough=state.enough,
        )  # fmt: skip

    total = max(state.planned, log.steps)
    bar = tqdm(total=total, initial=log.steps, desc="fit", unit="step", disable=not progress, leave=False)

    def after_step() -> None:
        last = state.history[-1]
        bar.set_postfix_str(f"{last.size[1]} × {last.size[0]} px, loss {last.loss:.2e}", refresh=False)
        if bar.total is not None and bar.n + 1 >= bar.total:
            bar.total = None  # The number of later steps is not known.
        bar.update()
        if callback is not None:
            callback(result())
        if log.steps % checkpoint_every == 0:
            keep()

    state.after_step = after_step
    if isinstance(state, MultiStartSearch):
        state.report = bar.set_postfix_str
    try:
        state.run()
        if starts == "global":
            warn_of_units(task.scene.transformed(state.best.R, state.best.t, state.best.scale), seen, depths, "found")
        if (
            search
            and not isinstance(state, MultiStartSearch)
            and not state.converged
            and state.edge_support < state.enough
        ):
            _warn_of_flipped_pictures(task, state, init is None, max_size, spp)
    except KeyboardInterrupt:
        interrupted = True
    finally:
        bar.close()
    keep()
    return result()


def ambiguity(pose: Pose, others: Sequence[Pose], symmetries: Symmetries | None, task: PoseTask) -> str:
    """Return in words that another pose, which is not known to be equivalent, may be the right one; else an empty string."""
    same = others if symmetries is None else [other.closest(symmetries, pose) for other in others]
    apart = max((angle(pose.R, other.R) for other in same), default=0.0)
    away = max((task.between(pose, other) for other in same), default=0.0)
    if apart < SAME_POSE_ANGLE and away < MAX_SHIFT:
        return ""
    other = f"turned by {math.degrees(apart):.0f}°" if apart >= SAME_POSE_ANGLE else f"{away:.0%} of the size away"
    colors = "the mesh's colours, " if task.colorless else ""
    return (
        f"ambiguous: the pictures hardly separate it from a pose that is {other}; give {colors}"
        "symmetries of the mesh, depth, or another picture"
    )


def check_callback(callback: object, of: str) -> None:
    """Raise TypeError for a callback that cannot be called."""
    if callback is not None and not callable(callback):
        raise TypeError(f"callback: expected a function of {of}, got {type(callback).__name__}")


def depth_images(depth: object, task: PoseTask) -> list[Tensor | None]:
    """Return the depth (H, W) of each picture, NaN where it was not measured. Raises TypeError or ValueError."""
    count = len(task.shots)
    if depth is None:
        return [None] * count
    several = isinstance(depth, (list, tuple))
    given = list(depth) if isinstance(depth, (list, tuple)) else [depth]
    if len(given) != count:
        raise ValueError(f"depth: expected {count}, one for each camera, got {len(given)}")
    found = []
    for k, (one, shot) in enumerate(zip(given, task.shots, strict=True)):
        name = f"depth[{k}]" if several else "depth"
        found.append(depth_image(name, one, shot.camera.size))
    if not any(bool(one.isfinite().any()) for one in found):
        raise ValueError("depth: expected distances somewhere, got none in any pixel; 0 and NaN say that there is none")
    return found


def depth_image(name: str, given: object, size: tuple[int, int]) -> Tensor:
    """Return the depth (H, W), NaN where it was not measured. Raises TypeError or ValueError."""
    value = as_tensor(name, given).detach().cpu()
    if not value.is_floating_point():
        raise TypeError(
            f"{name}: expected floating-point numbers in world units, got whole ones; of millimetres, for metres, take "
            "depth / 1000"
        )
    check_float(name, value)
    check_shape(name, value, size, (*size, 1), fix="it needs the picture's size")
    value = value.reshape(size).float()
    if bool((value < 0.0).any()):
        least = float(value.nan_to_num().min())
        raise ValueError(
            f"{name}: expected distances along the camera's axis, 0 or NaN where there is none, got {least:g}"
        )
    return torch.where(value.isfinite() & (value > 0.0), value, torch.nan)


def _check_starts(starts: object, init: object, camera: object, name: str) -> None:
    """Raise TypeError or ValueError for starts that do not go with the other arguments."""
    if isinstance(starts, str):
        if starts != "global":
            raise ValueError(f'starts: expected a number of starts or "global", got {starts!r}')
        if init is not None:
            raise ValueError(
                f'starts: expected a number with {name}, got "global", which searches for the object in the whole picture; '
                f"leave {name} out, or give a number of starts around it"
            )
        first = camera[0] if isinstance(camera, Sequence) and len(camera) else camera
        if isinstance(first, Camera) and first.projection not in ("perspective", "orthographic"):
            raise ValueError(
                f'starts: expected a perspective or orthographic camera for "global", got a {first.projection}; give {name}'
            )
    else:
        check_int("starts", starts, 1, MOST_STARTS)


def symmetries_of(given: object, mesh: Mesh | Scene, name: str = "symmetries") -> Symmetries | None:
    """Return the given or found symmetries. Raises TypeError or ValueError, or what Symmetries.find() raises."""
    if given is None or isinstance(given, Symmetries):
        return given
    if given == "find":
        return Symmetries.find(mesh)
    if isinstance(given, str):
        raise ValueError(f'{name}: expected Symmetries, "find" or None, got {given!r}')
    raise TypeError(f'{name}: expected Symmetries, "find" or None, got {type(given).__name__}')


def _warn_of_flipped_pictures(
    task: PoseTask, search: ColorSearch | PhotoSearch, place: bool, max_size: int, spp: int
) -> None:
    """Warn where a fit to the pictures turned over finds in them what it did not find as they are."""
    turned = task.turned_over()
    start = initial_pose(turned) if place else search.start
    settings = search.steps, search.tolerance, search.seed
    again: ColorSearch | PhotoSearch
    if task.clutter:
        again = PhotoSearch(turned, start, [None] * len(task.shots), max_size, spp, *settings)
    else:
        again = ColorSearch(turned, turned.pyramid(start, max_size, spp), start, *settings)
    found = again.first_end()
    if found >= max(again.enough, search.edge_support + MIN_IOU_GAIN):
        warn_of_flipped_rows(
            search.task.names.target, f"it shows {found:.0%} of the render's edges, as given {search.edge_support:.0%}"
        )
