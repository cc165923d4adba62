"""fit_pose(): where a known mesh stands in a picture, or in several.

The loss is the squared difference between pictures and renders, both blurred, on an image pyramid from coarse to fine, in which
what covers the object hardly counts. Each step of a Gauss-Newton search moves the pose by a rotation about the object's centre, a
shift in units of the object's size, and logarithms of scale and focal length, and starts anew from the pose that it reached.
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
from ...check import as_tensor, check_flag, check_float, check_int, check_positive_int, check_shape
from ...files.paths import PathLike
from ...scene.find_symmetries import find_symmetries
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ...scene.symmetries import Symmetries
from ..checkpoints import Checkpoint, traits
from ..options import check_checkpoint
from ..row_order import MIN_IOU_GAIN, warn_of_flipped_rows
from .given import Names, check_max_size, warn_of_scale
from .journal import Journal
from .photo.depth import warn_of_units
from .photo.match import matches
from .photo.search import NEAR, PhotoSearch
from .photo.starts import Starts, Tell, around, everywhere
from .place import placed
from .pose import Pose, angle, pose_from_matrix
from .result import PoseFit
from .search import Search
from .task import Lens, PoseTask
from .uncertainty import SHARE, Uncertainty

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
    """Rotation and translation (and scale, and focal length) of a known mesh in a picture, or in several.

    mesh        what the picture shows, with its colours; the meshes of a Scene move together
    target      (H, W, C) linear radiance in any unit, as read_image gives it, with the mesh's channels; or a list of pictures.
                The object's gain in each of them is found together with the pose, and so is that of a background that is given
    camera      the camera of the picture, of size (H, W), or a list of them; with fit_focal, its focal length is where the fit
                starts
    mask        (H, W) or (H, W, 1), 1 on the object and 0 elsewhere, as read_mask gives it. Then the colours inside the mask
                and the mask itself are compared; a plain mesh, which has no colours to compare, is fitted to the mask alone.
                At the border of a soft mask the colour beside it counts, times the mask: what the picture has there, before
                black, a photograph's background or straight alpha, makes no difference. A mask that nowhere reaches 0.5 is
                warned of
    init        the pose to start from, within about 30° and 15 % of the object's size of the true one: an earlier fit, or
                mesh to world as a matrix (4, 4) for column vectors. When None, where the mesh file puts the object, if the
                camera sees it there (and the mask agrees); else in the middle of the mask, or of the picture
    fit_scale   also find the mesh's scale. One picture shows size over distance only, so the centre then keeps its depth
    fit_focal   also find the focal length: one factor for both of K
    background  without a mask, what stands behind the object: a number, (C,) or (H, W, C); when None, the scene's own, or
                else the median colour of the picture's border. If the border has many colours, the background counts as
                unknown: then only what the object covers is compared
    weight      (H, W) or (H, W, 1), from 0: how much a pixel counts, beside the one that counts most
    depth       (H, W) or (H, W, 1), as a depth camera measures it from where the picture was taken: distances along +Z of the
                camera in world units, 0 or NaN where there is none; or a list of them
    max_size    a larger picture is reduced to so many pixels on its longer side
    steps       at most so many on each level of the pyramid; in photographs 8, 12 or 20 of 40, and as much more of more
    spp         samples a pixel of each render on the finest level; the others take as many in all
    tolerance   a step on the finest level is short when it is below this: in radians, object sizes (the diagonal of the bounding
                box), and logarithms of scale and focal length
    seed        the same seed gives the same fit
    search      False for a start near the answer: one way down from there, whatever it ends at
    starts      how many poses to start from; the best after a few steps are followed down, until an end shows 85 % of the
                render's edges. Around `init` they are turned by up to 45°; without it they are turned in all ways, at the place
                that `init` says for None. "global" looks for the object in the whole first picture, seen by a perspective or
                orthographic camera, from all sides and at sizes from 0.25 to 1.25 of the picture's shorter side, or in the
                mask, in 5 … 40 s of processor time; `init` is None then. 1: the start alone, and what `search` does further;
                with more, `search` has no say
    progress    show a bar with the loss on standard error
    callback    called after each step with the best fit so far
    checkpoint  a file that holds the fit's state, written every `checkpoint_every` steps and at the end, never in part
    resume      go on from the checkpoint, if there is one: the fit ends as if it had never stopped. One of a fit that
                was given something else is refused
    symmetries  of the mesh: of the poses that they make the same, the one nearest to the start is reported, by its rotation.
                "find" looks for them with find_symmetries(). They change nothing of the search itself

    About a quarter of the object may be covered by something that is not known; meshes that cover one another are for
    fit_poses. The picture may be blurred by up to 1.4 pixels, and compressed: renders are made
    as soft. The start is followed first. The fit is `converged` if its last step was short and the pictures show at least 60 % of
    the render's edges (`explained`); where they do not, it looks for better poses further off, which takes a few times as long,
    less where nothing in the picture looks like the object; where they do, but something covers the object or it is of another
    colour, nearby, in about the same time again. Another pose is the answer only if its loss is lower than that of `init` in the
    final comparison, and its edges are as well in the picture. `uncertainty` says how exactly the pictures show the pose: a
    rotation that is known less exactly than to 5° (of a plain mesh 2°), or a place than to 5 % of the object's size, is not
    `converged`, and `reason` names the direction, which a continuous one of the `symmetries` makes known. A plain mesh has its
    contour alone: there other starts follow in any case, as they do of a mesh with colours whose rotation is known less exactly
    than to 1°, and a pose is not `converged` if another one is about as likely.
    KeyboardInterrupt, also from the callback, ends the fit and returns the best so far with `interrupted` set.
    Works in torch.no_grad() and torch.inference_mode() too. Raises TypeError or ValueError that names the argument, also when
    the object leaves no trace in the picture at the start.
    """
    lens = Lens(check_flag("fit_scale", fit_scale), check_flag("fit_focal", fit_focal))
    return search_pose(
        mesh, target, camera, mask, init, lens, background, weight, depth, Names(), max_size=max_size, steps=steps, spp=spp,
        tolerance=tolerance, seed=seed, search=search, progress=progress, callback=callback, checkpoint=checkpoint,
        checkpoint_every=checkpoint_every, resume=resume, symmetries=symmetries_of(symmetries, mesh),
        starts=starts,
    )  # fmt: skip


@torch.inference_mode(False)
@torch.enable_grad()
def search_pose(
    mesh: Mesh | Scene, target: object, camera: object, mask: object, init: object, lens: Lens,
    background: Tensor | float | None, weight: object, depth: object, names: Names, *, max_size: int, steps: int, spp: int,
    tolerance: float, seed: int, search: bool, progress: bool, callback: Callable[[PoseFit], None] | None,
    checkpoint: PathLike | None, checkpoint_every: int, resume: bool, symmetries: Symmetries | None = None,
    starts: int | Literal["global"] = 1,
) -> PoseFit:  # fmt: skip
    """fit_pose(), with whatever is sought of the lens."""
    began = time.perf_counter()
    check_max_size(max_size)
    for name, count in (("steps", steps), ("spp", spp)):
        check_positive_int(name, count)
    check_int("seed", seed, 0, 2**32 - 1)
    check_tolerance(tolerance)
    check_callback(callback, "a PoseFit")
    check_checkpoint(checkpoint, checkpoint_every, check_flag("resume", resume))
    _check_starts(starts, init, camera, names.init)
    given = pose_from_matrix("init", torch.eye(4) if init is None else getattr(init, "matrix", init))
    task = PoseTask.of(mesh, target, camera, mask, weight, background, lens, float(given.scale), names)
    if names == Names():  # of scenes a camera may stand inside
        warn_of_scale(names.mesh, task.scene.transformed(given.R, given.t, given.scale), task.shots[0].camera)
    start = placed(task) if init is None else given
    given_cameras: list[Any] = list(camera) if isinstance(camera, Sequence) else [camera]
    file = Checkpoint(checkpoint, resume, {
        names.init: None if init is None else given.matrix, names.mesh: mesh, names.target: target, "mask": mask,
        "weight": weight, "camera": [traits(one) for one in given_cameras], "background": background,
        **dict(zip(names.lens, lens, strict=False)), "max_size": max_size, "steps": steps, "spp": spp,
        "tolerance": tolerance, "seed": seed, "depth": depth, "search": check_flag("search", search), "starts": starts,
    })  # fmt: skip
    saved = file.read()
    journal, earlier = (Journal(), 0.0) if saved is None else (Journal(saved["journal"]), saved["seconds"])
    depths = depth_images(depth, task)
    seen = [shot.camera for shot in task.shots]
    if starts != "global":
        warn_of_units(task.scene.transformed(start.R, start.t, start.scale), seen, depths, "at the start")

    def way(start: Pose, journal: Journal, further: bool) -> Search | PhotoSearch:
        if task.aovs == ("alpha",) and depth is None:
            return Search(task, task.pyramid(start, max_size, spp), start, steps, tolerance, seed, journal, further)
        return PhotoSearch(task, start, depths, max_size, spp, steps, tolerance, seed, journal, further)

    ways: Search | PhotoSearch | Starts
    if starts == 1:
        ways = way(start, journal, search)
    else:

        def made(tell: Tell) -> list[Pose]:
            if starts == "global":
                return matches(task, seed, tell)
            return (around if init is not None else everywhere)(task, start, starts)

        ways = Starts(task, start, made, depths, max_size, seed, journal, partial(way, further=False))
    interrupted = False

    def seconds() -> float:
        return earlier + time.perf_counter() - began

    def keep() -> None:
        if checkpoint is not None:
            file.write({"journal": journal.state(), "seconds": seconds()})

    def result() -> PoseFit:
        best: Pose = ways.best if symmetries is None else ways.best.closest(symmetries, start)
        history = list(ways.history)
        cameras = [task.lens(one, best) for one in given_cameras]
        known = None
        if ways.curvature is not None:
            known = Uncertainty.of(task, best, ways.curvature, task.free, symmetries)
        conflict = looks_alike(best, ways.alike, symmetries, task)
        sure = ways.converged and not interrupted and not conflict and (known is None or not known.unknown)
        return PoseFit(
            best.R, best.t, float(best.scale), cameras[0], ways.loss, len(history), seconds(), sure, interrupted,
            ways.explained, history, task, cameras, known, conflict=conflict, enough=ways.enough,
        )  # fmt: skip

    total = max(ways.planned, journal.steps)
    bar = tqdm(total=total, initial=journal.steps, desc="fit", unit="step", disable=not progress, leave=False)

    def after_step() -> None:
        last = ways.history[-1]
        bar.set_postfix_str(f"{last.size[1]} × {last.size[0]} px, loss {last.loss:.2e}", refresh=False)
        if bar.total is not None and bar.n + 1 >= bar.total:
            bar.total = None  # how many steps the later passes take is not known
        bar.update()
        if callback is not None:
            callback(result())
        if journal.steps % checkpoint_every == 0:
            keep()

    ways.after_step = after_step
    if isinstance(ways, Starts):
        ways.tell = bar.set_postfix_str
    try:
        ways.run()
        if starts == "global":
            warn_of_units(task.scene.transformed(ways.best.R, ways.best.t, ways.best.scale), seen, depths, "found")
        if search and not isinstance(ways, Starts) and not ways.converged and ways.explained < ways.enough:
            _warn_if_upside_down(task, ways, init is None, max_size, spp)
    except KeyboardInterrupt:
        interrupted = True
    finally:
        bar.close()
    keep()
    return result()


def looks_alike(pose: Pose, others: Sequence[Pose], symmetries: Symmetries | None, task: PoseTask) -> str:
    """In words, that another pose may be the right one, if it is not known to be the same; else empty."""
    same = others if symmetries is None else [other.closest(symmetries, pose) for other in others]
    apart = max((angle(pose.R, other.R) for other in same), default=0.0)
    away = max((task.between(pose, other) for other in same), default=0.0)
    if apart < NEAR and away < SHARE:
        return ""
    other = f"turned by {math.degrees(apart):.0f}°" if apart >= NEAR else f"{away:.0%} of the size away"
    colours = "the mesh's colours, " if task.colourless else ""
    return (
        f"looks alike: the pictures hardly tell it from a pose that is {other}; give {colours}"
        "symmetries of the mesh, depth, or another picture"
    )


def check_tolerance(tolerance: object) -> None:
    """Raises TypeError or ValueError."""
    if not isinstance(tolerance, (int, float)) or isinstance(tolerance, bool):
        raise TypeError(f"tolerance: expected a number, got {type(tolerance).__name__} ({tolerance!r})")
    if not 0.0 < tolerance < 1.0:
        raise ValueError(f"tolerance: expected a number above 0 and below 1, got {tolerance:g}")


def check_callback(callback: object, of: str) -> None:
    """Raises TypeError."""
    if callback is not None and not callable(callback):
        raise TypeError(f"callback: expected a function of {of}, got {type(callback).__name__}")


def depth_images(depth: object, task: PoseTask) -> list[Tensor | None]:
    """Of each picture (H, W), NaN where it was not measured. Raises TypeError or ValueError."""
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
    """(H, W), NaN where it was not measured. Raises TypeError or ValueError."""
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
    """Raises TypeError or ValueError."""
    if isinstance(starts, str):
        if starts != "global":
            raise ValueError(f'starts: expected a number of starts or "global", got {starts!r}')
        if init is not None:
            raise ValueError(
                f'starts: expected a number with {name}, got "global", which looks for the object in the whole picture; '
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
    """Raises TypeError or ValueError, or what find_symmetries() raises."""
    if given is None or isinstance(given, Symmetries):
        return given
    if given == "find":
        return find_symmetries(mesh)
    if isinstance(given, str):
        raise ValueError(f'{name}: expected Symmetries, "find" or None, got {given!r}')
    raise TypeError(f'{name}: expected Symmetries, "find" or None, got {type(given).__name__}')


def _warn_if_upside_down(task: PoseTask, search: Search | PhotoSearch, place: bool, max_size: int, spp: int) -> None:
    """Where a fit to the pictures turned over finds in them what it did not find as they are."""
    turned = task.turned_over()
    start = placed(turned) if place else search.start
    way = search.steps, search.tolerance, search.seed
    again: Search | PhotoSearch
    if task.clutter:
        again = PhotoSearch(turned, start, [None] * len(task.shots), max_size, spp, *way)
    else:
        again = Search(turned, turned.pyramid(start, max_size, spp), start, *way)
    found = again.first_end()
    if found >= max(again.enough, search.explained + MIN_IOU_GAIN):
        warn_of_flipped_rows(
            search.task.names.target, f"it shows {found:.0%} of the render's edges, as given {search.explained:.0%}"
        )
