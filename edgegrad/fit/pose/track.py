"""track(): where a known mesh stands in each picture of a film.

Where the object was and how it moved says about where it is. From there a few Gauss-Newton steps over the terms of photographs
(region, contour, light and depth) find it, on two levels of resolution around the object alone. Where they do not end at edges
of the picture, more steps begin on the coarsest level, from where the object was as well; where that fails for some pictures
the object is lost, and is searched for around its last good pose.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from os import PathLike as OsPath

import torch
from torch import Tensor

from ...camera.camera import Camera
from ...check import check_int, check_positive_int
from ...files.image import read_image
from ...files.paths import PathLike
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..views import check_image
from .fit_pose import depth_image
from .gauss_newton import Normal
from .photo.cover import uncovered, weighted
from .photo.level import PhotoLevel, Seen, photo_levels
from .photo.picture import Picture, palette
from .photo.search import DAMPING, ENOUGH, FLOOR, LAST_DAMPING, LONGEST, PhotoSearch
from .pose import Pose, angle, pose_from_matrix
from .result import PoseFit
from .task import Lens, Names, PoseTask

Frame = Tensor | PathLike
STEPS, LAST_STEPS = 4, 4  # on the last level but one and on the last, where the prediction is good
MORE_STEPS = 8  # on each level, where it is not
STEADY = 0.03  # standard deviation of the motion from that of constant velocity, radians and object sizes
SHORT = 1e-3  # of a step on the last level: radians and object sizes
POOR = 0.45  # of the render's edges: a picture that shows fewer hardly shows the object there
PATIENCE = 4  # such pictures one after the other, and the object is lost
AGAIN = 5  # pictures from one search for a lost object to the next
RATE = 0.1  # of a picture, in the light of all
LEARNT = 0.8  # of the edges, in pictures that light is learnt from
SEARCH_STEPS = 12  # on each level of it
FARTHEST = 0.25  # radians and object sizes that steps lead from where they begin


@dataclass(frozen=True, eq=False)
class TrackedPose:
    """Where the mesh is in one picture: `world = scale · R v + t`."""

    index: int  # of the picture, from 0
    R: Tensor  # (3, 3) float64
    t: Tensor  # (3,) float64, world units
    scale: float  # that of `init`
    explained: float  # the share of the render's edges that the picture shows too, 0 … 1
    lost: bool  # the pose is the last one at which the object was seen

    @property
    def matrix(self) -> Tensor:
        """Mesh to world, (4, 4) float64, for column vectors: `scale · R` and `t`."""
        one = torch.ones((), dtype=torch.float64)
        return Pose(self.R, self.t, self.scale * one, one).matrix


def track(
    mesh: Mesh | Scene,
    frames: Iterable[Frame],
    camera: Camera,
    init: PoseFit | Tensor,
    *,
    depth: Iterable[Tensor | None] | None = None,
    max_size: int = 256,
    spp: int = 8,
    seed: int = 0,
) -> Iterator[TrackedPose]:
    """The pose of a known mesh in each picture of a film, one after the other as they are asked for.

    mesh      what the pictures show, with its colours or without; the meshes of a Scene move together
    frames    pictures (H, W, C) of linear radiance with the mesh's channels, or paths of image files; a list, a tensor
              (T, H, W, C), or any iterable, of which no more is read than what is asked for
    camera    the camera of all pictures, of size (H, W)
    init      the pose in the first picture, within about 10° and 5 % of the object's size: what fit_pose found, or mesh to world
              as a matrix (4, 4) for column vectors
    depth     of each picture (H, W) or (H, W, 1), as a depth camera measures it from where the picture was taken: distances along
              +Z of the camera in world units, 0 or NaN where there is none; None for pictures without
    max_size  what is used of a larger picture, about the object, is reduced to so many pixels on its longer side
    spp       samples a pixel of each render
    seed      the same seed gives the same poses

    The light and what stands behind the object need not be known. The mesh may move by some 10° and a fifth of its size from a
    picture to the next, more where it moves evenly; something may pass before it. Where four pictures in a row hardly show the
    object (`explained` below 0.45), it is `lost`, and is searched for around its last good pose until it is found again.

    Arguments are checked at once. A picture that cannot be used (another size, numbers that are not finite, a file that
    is not there) is an error, ValueError, TypeError or OSError, that names it as `frames[k]`, raised when it is asked
    for; the poses of those before it have been given by then.
    """
    if not isinstance(camera, Camera) or camera.batch is not None:
        got = type(camera).__name__ if not isinstance(camera, Camera) else f"a batch of {camera.batch}"
        raise TypeError(f"camera: expected the one Camera of all frames, got {got}")
    if not isinstance(mesh, Mesh | Scene):
        raise TypeError(f"mesh: expected a Mesh or a Scene, got {type(mesh).__name__}; load one with load_mesh(path)")
    if isinstance(frames, (str, OsPath)) or not isinstance(frames, (Iterable, Tensor)):
        raise TypeError(
            f"frames: expected pictures or paths one after the other, got {type(frames).__name__}; of a folder, give "
            "sorted(folder.glob('*.png'))"
        )
    if isinstance(frames, Tensor) and frames.dim() != 4:
        raise ValueError(f"frames: expected (T, H, W, C), got {tuple(frames.shape)}; give a list of pictures")
    if depth is not None and not isinstance(depth, (Iterable, Tensor)):
        raise TypeError(f"depth: expected one for each frame or None, got {type(depth).__name__}")
    for name, count in (("max_size", max_size), ("spp", spp)):
        check_positive_int(name, count)
    check_int("seed", seed, 0, 2**32 - 1)
    start = pose_from_matrix("init", getattr(init, "matrix", init))
    return _poses(Tracker(mesh, camera, start, max_size, spp, seed), frames, depth)


def _poses(tracker: Tracker, frames: Iterable[Frame], depth: Iterable[Tensor | None] | None) -> Iterator[TrackedPose]:
    depths = None if depth is None else iter(depth)
    for index, frame in enumerate(frames):
        measured = None
        if depths is not None:
            try:
                measured = next(depths)
            except StopIteration:
                raise ValueError(f"depth: expected one for each frame, got {index}, and more frames") from None
        yield tracker.follow(index, frame, measured)


class Tracker:
    """What is known of a film so far."""

    def __init__(self, mesh: Mesh | Scene, camera: Camera, start: Pose, max_size: int, spp: int, seed: int) -> None:
        self.mesh, self.camera = mesh, camera
        self.max_size, self.spp, self.seed = max_size, spp, seed
        self.pose = self.good = start  # the last one, and the last one at which the object was seen
        self.turn, self.shift = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)  # a picture
        self.poor = 0  # pictures one after the other that hardly show the object
        self.first, self.moves = True, False  # whether the velocity is known
        self.task: PoseTask | None = None
        self.palettes: list[Tensor] = []
        self.light: Tensor | None = None  # coefficients (C, n) of the pictures before
        self.deviation = 0.0  # from what they predict, as Lit has it

    @torch.inference_mode(False)
    @torch.enable_grad()
    def follow(self, index: int, frame: object, measured: object) -> TrackedPose:
        """The pose in the next picture. Raises TypeError, ValueError or OSError."""
        name = f"frames[{index}]"
        picture = self._picture(name, frame)
        if self.task is None:
            self.task = self._task(name, picture)
        task = replace(self.task, shots=[self.task.shots[0]._replace(target=picture)])
        near = None if measured is None else depth_image(f"depth[{index}]", measured, self.camera.size)
        predicted = self._predicted()
        pose, share = self._found(task, near, predicted)
        if self.first or share >= POOR:
            self.poor = 0
        else:
            self.poor += 1
        lost = self.poor >= PATIENCE
        if lost and (self.poor - PATIENCE) % AGAIN == AGAIN - 1:
            again, found = self._searched(task, near)
            if found >= ENOUGH:
                pose, share, lost, self.poor = again, found, False, 0
        self._move(pose, share, lost)
        return TrackedPose(index, self.pose.R, self.pose.t, float(self.pose.scale), share, lost)

    def _found(self, task: PoseTask, depth: Tensor | None, predicted: Pose) -> tuple[Pose, float]:
        """The pose, and the share of the edges there."""
        best, share = predicted, 0.0
        if not self.first and self.poor == 0:
            levels = self._uncovered(self._levels(task, depth, predicted), predicted)
            offset = torch.zeros(len(levels[-1].plain.free), dtype=torch.float64) if self.moves else None
            pose, _ = self._stepped(levels[-2], predicted, STEPS, offset)
            best, share = self._believed(*self._stepped(levels[-1], pose, LAST_STEPS, offset), predicted)
        if share < ENOUGH:
            for start in [predicted] if self.first or predicted is self.good else [predicted, self.good]:
                levels = self._uncovered(self._levels(task, depth, start), start)
                pose, again = start, 0.0
                for level in levels:
                    pose, again = self._stepped(level, pose, MORE_STEPS)
                pose, again = self._believed(pose, again, start)
                if again > share:
                    best, share = pose, again
                if share >= ENOUGH:
                    break
        return best, share

    def _uncovered(self, levels: list[PhotoLevel], pose: Pose) -> list[PhotoLevel]:
        """With weights near zero where something covers the object: there the picture is not what the mesh is at that pose in the
        light of the pictures before. The light of this picture alone would follow what covers it."""
        if self.light is None:
            return levels
        (seen,) = levels[-2].see(pose, self.seed)
        if seen.lit is None or seen.lit.coefficients.shape != self.light.shape:
            return levels
        weights = [uncovered(seen.lit, self.light, self.deviation)]
        return [weighted(level, weights) for level in levels]

    def _learn(self, views: list[Seen]) -> None:
        """Takes in the light of a picture that shows the object."""
        for seen in views:
            if seen.lit is not None:
                old = self.light is not None and self.light.shape == seen.lit.coefficients.shape
                rate = RATE if old else 1.0
                light = self.light if old and self.light is not None else seen.lit.coefficients
                self.light = (1.0 - rate) * light + rate * seen.lit.coefficients
                self.deviation = (1.0 - rate) * self.deviation + rate * seen.lit.deviation

    def _believed(self, pose: Pose, share: float, start: Pose) -> tuple[Pose, float]:
        """Steps that lead far from where they began follow something else than the object, whatever they explain there."""
        assert self.task is not None
        near = angle(start.R, pose.R) < FARTHEST and self._way(start, pose) < FARTHEST * self.task.size
        return (pose, share) if near or self.first else (start, 0.0)

    def _way(self, a: Pose, b: Pose) -> float:
        """Between the object's centres."""
        return float((self._center(a) - self._center(b)).norm())

    def _center(self, pose: Pose) -> Tensor:
        assert self.task is not None
        return pose.scale * (pose.R @ self.task.center) + pose.t

    def _stepped(
        self, level: PhotoLevel, pose: Pose, most: int, offset: Tensor | None = None
    ) -> tuple[Pose, float]:  # fmt: skip
        """After so many Gauss-Newton steps at most, or a short one; on the last level also the share of the edges, as it was
        before the last step, which is short where the way ends well. `offset` (n,): how far the steps have led from the
        prediction, which they add to; the object is taken to be near that, as far as the picture shows little of it."""
        views: list[Seen] = []
        at = pose
        for _ in range(most):
            at, views = pose, level.see(pose, self.seed)
            normal, _loss = level.equations(pose, self.seed, views)
            if not float(normal.curvature.trace()) > 0.0:
                break  # the prior below would hide that
            if offset is not None:
                known = torch.eye(len(offset), dtype=torch.float64) / STEADY**2
                normal = Normal(normal.curvature + known, normal.gradient + known @ offset)
            move = normal.damped(LAST_DAMPING if level.last else DAMPING, FLOOR, LONGEST)
            assert move is not None
            pose = level.task.moved(pose, level.plain.free, move)
            if offset is not None:
                offset += move
            if float(move.abs().max()) < SHORT * level.plain.coarseness:
                break
        if not level.last:
            return pose, math.nan
        share = level.explained(at, self.seed, views)
        if share >= LEARNT:
            self._learn(views)
        return pose, share

    def _levels(self, task: PoseTask, depth: Tensor | None, pose: Pose) -> list[PhotoLevel]:
        return photo_levels(task, pose, [depth], self.max_size, self.spp, self.seed, self.palettes)

    def _searched(self, task: PoseTask, depth: Tensor | None) -> tuple[Pose, float]:
        """From the last good pose, and others about it."""
        search = PhotoSearch(task, self.good, [depth], self.max_size, self.spp, SEARCH_STEPS, SHORT, self.seed)
        search.run()
        return search.best, search.explained

    def _predicted(self) -> Pose:
        """By constant velocity."""
        assert self.task is not None
        if self.poor >= PATIENCE:
            return self.good
        R = self.turn @ self.pose.R
        where = self._center(self.pose) + self.shift
        return self.pose._replace(R=R, t=where - self.pose.scale * (R @ self.task.center))

    def _move(self, pose: Pose, share: float, lost: bool) -> None:
        """Takes in where the object is now."""
        moved, self.moves = self.moves, not (self.first or lost or share < POOR)
        if lost or share < POOR:  # where it went is not known
            self.turn, self.shift = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
        elif not self.first:
            far = angle(self.pose.R, pose.R) > FARTHEST  # found again
            turn = torch.eye(3, dtype=torch.float64) if far else pose.R @ self.pose.R.T
            shift = torch.zeros(3, dtype=torch.float64) if far else self._center(pose) - self._center(self.pose)
            # The difference of two poses has the errors of both, and predictions by it alone add them up.
            known = moved and not far
            self.turn, self.shift = (_between(self.turn, turn), 0.5 * (self.shift + shift)) if known else (turn, shift)
        self.pose, self.first = self.good if lost else pose, False
        if share >= ENOUGH and not lost:
            self.good = pose

    def _task(self, name: str, picture: Tensor) -> PoseTask:
        task = PoseTask.of(
            self.mesh, picture, self.camera, None, None, None, Lens(), float(self.pose.scale), Names(target=name)
        )
        # Whatever stands behind the object: a film shows it from more than one side.
        task = replace(task, clutter=True, shots=[task.shots[0]._replace(background=None)])
        whole = Picture.of(task.shots[0], False, None, self.camera.size)
        self.palettes = [palette(whole.outlined, self.seed)]
        return task

    def _picture(self, name: str, frame: object) -> Tensor:
        """(H, W, C). Raises TypeError, ValueError or OSError."""
        if isinstance(frame, (str, OsPath)):
            try:
                frame = read_image(frame, channels=3)
            except (OSError, ValueError) as error:
                raise type(error)(f"{name}: {error}") from error
        picture = check_image(name, frame, self.camera.size)
        if self.task is not None and picture.shape[-1] != (C := self.task.shots[0].target.shape[-1]):
            raise ValueError(f"{name}: expected {C} channels as of the frames before, got {picture.shape[-1]}")
        return picture


def _between(A: Tensor, B: Tensor) -> Tensor:
    """The rotation in the middle of two (3, 3)."""
    U, _, Vh = torch.linalg.svd(A + B)
    return U @ Vh
