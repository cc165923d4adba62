"""track(): the pose of a known mesh in each picture of a film."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

from torch import Tensor

from ..camera.camera import Camera
from ..fit.options import FitOptions
from ..fit.pose.result import PoseFit
from ..fit.pose.track import check_one_by_one
from ..scene.mesh import Mesh
from ..scene.scene import Scene
from .result import TrackedPose
from .tracker import FrameLike, Tracker


def track(
    mesh: Mesh | Scene,
    frames: Iterable[FrameLike],
    camera: Camera,
    init: PoseFit | Tensor,
    *,
    depths: Iterable[Tensor | None] | None = None,
    options: FitOptions | None = None,
) -> Iterator[TrackedPose]:
    """Yield the pose of a known mesh in each picture of a film, one after the other.

    Parameters
    ----------
    mesh : Mesh or Scene
        What the pictures show, with its colours or without; the meshes of a Scene move together.
    frames : iterable of Tensor or path
        Pictures as Tracker.update() takes them, or image files; a list, a tensor (T, H, W, C), or any iterable, which is read
        only as far as poses are asked for.
    camera : Camera
        The camera of all pictures, of their size.
    init : PoseFit or Tensor
        The pose in the first picture, within about 10° and 5 % of the object's size: an earlier fit, or mesh to world (4, 4).
    depths : iterable of Tensor or None, optional
        Of each picture, as Tracker.update() takes them.
    options : FitOptions, optional
        Of the search for a lost object, as Tracker() takes them.

    Yields
    ------
    TrackedPose
        `R`, `t` and `matrix` in a picture, and how sure they are. Where `confidence` is below one half, the object is `lost`,
        and is searched for until it is found again.

    Raises
    ------
    TypeError, ValueError, OSError
        An argument is wrong, or the camera sees nothing of the object at `init`. A picture that cannot be used is named as
        `frames[k]` when it is asked for.

    Notes
    -----
    The light and the background need not be known. The mesh may move by some 10° and a fifth of its size from a picture to the
    next, more where it moves evenly; something may pass before it. Poses do not depend on time: a search for a lost object ends
    before the next pose.
    """
    if not isinstance(mesh, Mesh | Scene):
        raise TypeError(f"mesh: expected a Mesh or a Scene, got {type(mesh).__name__}; load one with load_mesh(path)")
    check_one_by_one("frames", frames, 4, "pictures or paths one after the other")
    if depths is not None:
        check_one_by_one("depths", depths, 3, "one for each frame or None")
    return _poses(Tracker(mesh, camera, init, options=options, wait=True), frames, depths)


def _poses(
    tracker: Tracker, frames: Iterable[FrameLike], depths: Iterable[Tensor | None] | None
) -> Iterator[TrackedPose]:
    measured = itertools.repeat(None) if depths is None else iter(depths)
    for index, frame in enumerate(frames):
        try:
            depth = next(measured)
        except StopIteration:
            raise ValueError(f"depths: expected one for each frame, got {index}, and more frames") from None
        yield tracker.update(frame, depth)
