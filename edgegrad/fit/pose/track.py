"""track(): the pose of a known mesh in each picture of a film.

Position and motion in the last pictures predict the pose. From there a few Gauss-Newton steps over the terms of photographs
(region, contour, light and depth) refine it, on two levels of resolution around the object alone. Where they do not end at
edges of the picture, more steps begin on the coarsest level, also from the last good pose. Where that fails for some
pictures, the object is lost, and is searched for in the whole picture, in the light in which it was seen.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from os import PathLike as OsPath
from typing import NamedTuple

import torch
from torch import Tensor

from ...camera.camera import Camera
from ...camera.poses import rigid
from ...files.image import read_image
from ...files.paths import PathLike
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..modes import in_full_precision
from ..options import FitOptions, Settings
from ..region import Palette, palette
from ..views import check_image
from .fit_pose import depth_image
from .gauss_newton import NormalEquations
from .inputs import ArgumentNames, check_in_front, check_seen, depth_of
from .photo.depth import warn_of_units
from .photo.level import PhotoLevel, PictureComparison, photo_levels
from .photo.light_history import LightHistory
from .photo.match import VIEW_PIXELS, places
from .photo.photo_descent import PHOTO_SUPPORT, enough_support
from .photo.picture import Picture
from .photo.template_views import TemplateViews, across, ball
from .pose import Pose, angle, pose_from_matrix
from .result import PoseFit
from .task import PoseTask, Unknowns

FrameLike = Tensor | PathLike
TRACK_STEPS = 4  # steps on each of the last two levels, where the prediction is good
RETRY_STEPS = 8  # steps on each level, where it is not
# The standard deviation from constant velocity, in radians and object sizes, has this first and this least value.
STEADY, STEADIEST = 0.03, 0.005
SHORT_STEP = 1e-3  # length of a short step on the last level, radians and object sizes
MIN_SHOWN_SUPPORT = 0.45  # share of edges below which a picture hardly shows the object
PATIENCE = 4  # successive poor pictures after which the object is lost
SEARCH_INTERVAL = 5  # pictures from one search for a lost object to the next
STEADINESS_RATE = 0.1  # weight of a picture in `steady`
LEARNING_SUPPORT = 0.8  # share of edges in pictures that light is learnt from
MAX_COVERED_INCREASE = 0.3  # increase of the covered share that is not believed
HARDLY, MOSTLY = 0.2, 0.6  # covered shares of the object
# A search for a lost object renders views up to so many radians from the last good pose and this much larger or smaller,
# takes a few steps from some matches, and refines the best.
SEARCH_VIEWS, SEARCH_RADIUS, SIZE_FACTOR = 160, 1.1, 1.2
CANDIDATES, REFINED_CANDIDATES = 20, 4
MAX_DRIFT = 0.25  # longest path of the steps from their start, radians and object sizes


@dataclass(frozen=True, eq=False)
class TrackedPose:
    """The mesh's pose in one picture: `world = scale · R v + t`."""

    index: int  # number of the picture, from 0
    R: Tensor  # (3, 3) float64
    t: Tensor  # (3,) float64, world units
    scale: float  # as of `init`
    explained: float  # share of the render's visible edges that the picture shows, 0 … 1
    lost: bool  # The pose is the last one at which the object was seen.
    covered: float = 0.0  # share of the object that does not match in the light of earlier pictures, 0 … 1

    @property
    def reason(self) -> str:
        """How well the pose is known, in words: "seen", or "lost: …", "hardly seen: …" or "covered: …"."""
        if self.lost:
            return "lost: where the object was seen last, since pictures one after the other hardly show it"
        if self.explained < MIN_SHOWN_SUPPORT:
            return (
                f"hardly seen: where its motion leads, for the picture shows {self.explained:.0%} of the render's edges"
            )
        if self.covered > MOSTLY:
            return f"covered: {self.covered:.0%} of the object is not what it looked like before"
        return "seen"

    @property
    def matrix(self) -> Tensor:
        """Mesh to world, (4, 4) float64, for column vectors: `scale · R` and `t`."""
        return rigid(self.scale * self.R, self.t)


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
        Pictures (H, W, C) of linear radiance with the mesh's channels, or image files; a list, a tensor (T, H, W, C), or any
        iterable, which is read only as far as poses are asked for.
    camera : Camera
        The camera of all pictures, of their size.
    init : PoseFit or Tensor
        The pose in the first picture, within about 10° and 5 % of the object's size: an earlier fit, or mesh to world (4, 4).
    depths : iterable of Tensor or None, optional
        Of each picture, as of fit_pose().
    options : FitOptions, optional
        `max_size`, by default 256, of the part around the object, `spp`, by default 8, and `seed`.

    Yields
    ------
    TrackedPose
        `R`, `t` and `matrix` in a picture. Where four in a row hardly show the object (`explained` below 0.45), it is `lost`,
        and is searched for until it is found again.

    Raises
    ------
    TypeError, ValueError, OSError
        An argument is wrong, or the camera sees nothing of the object at `init`. A picture that cannot be used is named as
        `frames[k]` when it is asked for.

    Notes
    -----
    The light and the background need not be known. The mesh may move by some 10° and a fifth of its size from a picture to the
    next, more where it moves evenly; something may pass before it.
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
    if depths is not None and not isinstance(depths, (Iterable, Tensor)):
        raise TypeError(f"depths: expected one for each frame or None, got {type(depths).__name__}")
    if isinstance(depths, Tensor) and depths.dim() not in (3, 4):
        raise ValueError(f"depths: expected (T, H, W), got {tuple(depths.shape)}; give a list of depth images")
    settings = Settings.from_options(options, "track", ("max_size", "spp"), spp=8)
    start = pose_from_matrix("init", getattr(init, "matrix", init))
    scene = (Scene([mesh]) if isinstance(mesh, Mesh) else mesh).to("cpu").detach()
    low, high = torch.cat([part.verts.double() for part in scene.meshes]).aminmax(dim=0)
    check_in_front("init", camera.to("cpu"), start, (low + high) / 2)
    check_seen("init", scene, [camera.to("cpu")], start)
    return _poses(Tracker(mesh, camera, start, settings), frames, depths)


def _poses(
    tracker: Tracker, frames: Iterable[FrameLike], depths: Iterable[Tensor | None] | None
) -> Iterator[TrackedPose]:
    depths = None if depths is None else iter(depths)
    for index, frame in enumerate(frames):
        measured = None
        if depths is not None:
            try:
                measured = next(depths)
            except StopIteration:
                raise ValueError(f"depths: expected one for each frame, got {index}, and more frames") from None
        yield tracker.follow(index, frame, measured)


class FrameCandidate(NamedTuple):
    """A refined pose in one picture."""

    pose: Pose
    share: float  # visible edges of the render that the picture shows
    covered: float  # share of the object
    views: list[PictureComparison]

    @property
    def shown(self) -> float:
        """How much of the object the picture shows there."""
        return self.share * (1.0 - self.covered)


class Tracker:
    """The state of tracking through a film."""

    def __init__(self, mesh: Mesh | Scene, camera: Camera, start: Pose, settings: Settings) -> None:
        self.mesh, self.camera = mesh, camera
        self.settings, self.seed = settings, settings.seed
        self.pose = self.good = start  # last pose, and last one at which the object was seen
        self.turn, self.shift = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
        self.poor = self.lost = 0  # successive pictures that hardly show the object, and in which it is lost
        self.first, self.moves = True, False  # `moves`: the velocity is known.
        self.task: PoseTask | None = None
        self.palettes: list[Palette] = []
        self.steady = STEADY
        self.covered = 0.0  # share in the last picture
        self.light = LightHistory()

    @in_full_precision
    def follow(self, index: int, frame: object, measured: object) -> TrackedPose:
        """Return the pose in the next picture. Raises TypeError, ValueError or OSError."""
        name = f"frames[{index}]"
        picture = self._picture(name, frame)
        if self.task is None:
            self.task = self._task(name, picture)
        task = replace(self.task, shots=[self.task.shots[0]._replace(target=picture / self.task.white)])
        near = None if measured is None else depth_image(f"depths[{index}]", measured, self.camera.size)
        if self.first:
            there = task.scene.transformed(self.pose.R, self.pose.t, self.pose.scale)
            warn_of_units(there, [task.shots[0].camera], [near], "at the start")
        predicted = self._predicted()
        pose, share, self.covered, _ = self._found(task, near, predicted)
        if self.first or share >= MIN_SHOWN_SUPPORT:
            self.poor = self.lost = 0
        else:
            self.poor += 1
        lost = self.poor >= PATIENCE
        self.lost = self.lost + 1 if lost else 0
        if lost and self.lost % SEARCH_INTERVAL == 0:
            again = self._searched(task, near)
            if again.share >= enough_support(task) and again.covered < MOSTLY:
                pose, share, self.covered, _ = again
                lost, self.poor, self.lost = False, 0, 0
        self._move(pose, share, lost)
        where = self.pose.R, self.pose.t, float(self.pose.scale)
        return TrackedPose(index, *where, share, lost, self.covered)

    def _found(self, task: PoseTask, depth: Tensor | None, predicted: Pose) -> FrameCandidate:
        """Find the object near the predicted or the last good pose."""
        best = FrameCandidate(predicted, 0.0, 1.0, [])
        if not self.first and not self.lost:
            levels = self._levels(task, depth, predicted)
            offset = torch.zeros(len(levels[-1].pyramid_level.dofs), dtype=torch.float64) if self.moves else None
            best = self._believed(self._down(levels[-2:], predicted, TRACK_STEPS, offset), predicted)
            if offset is not None and best.share >= LEARNING_SUPPORT and best.covered < HARDLY:
                variance = (1.0 - STEADINESS_RATE) * self.steady**2 + STEADINESS_RATE * float(offset.square().mean())
                self.steady = max(variance**0.5, STEADIEST)
        if (
            best.share < PHOTO_SUPPORT or best.covered > self.covered + MAX_COVERED_INCREASE
        ):  # Occlusion grows gradually.
            for start in [predicted] if self.first or predicted is self.good else [predicted, self.good]:
                again = self._believed(self._down(self._levels(task, depth, start), start, RETRY_STEPS), start)
                if again.shown > best.shown:
                    best = again
                if best.share >= PHOTO_SUPPORT and best.covered < MOSTLY:
                    break
        if self.first and best.share < PHOTO_SUPPORT:  # The coarsest level spoils some near starts.
            again = self._down(self._levels(task, depth, predicted)[-2:], predicted, RETRY_STEPS)
            best = max(best, again, key=lambda end: end.shown)
        if best.share >= LEARNING_SUPPORT and best.covered < MOSTLY:
            self.light.learn(best.views)
        return best if best.share >= MIN_SHOWN_SUPPORT else best._replace(pose=predicted)

    def _down(self, levels: list[PhotoLevel], start: Pose, most: int, offset: Tensor | None = None) -> FrameCandidate:
        """Refine through the levels, with at most so many steps on each; `offset` as of _stepped()."""
        occluder = self.light.occluder(levels[-2].comparisons(start, self.seed)) if offset is not None else None
        pose, views = start, []
        for level in levels:
            pose, views = self._stepped(level if occluder is None else occluder.left_out(level), pose, most, offset)
            occluder = self.light.occluder(views) or occluder
        share = levels[-1].edge_support(pose, self.seed, views)
        return FrameCandidate(pose, share, 0.0 if occluder is None else occluder.share, views)

    def _believed(self, end: FrameCandidate, start: Pose) -> FrameCandidate:
        """Reject a candidate far from its start: such steps follow something other than the object, whatever they match
        there."""
        assert self.task is not None
        moved = float((self._center(start) - self._center(end.pose)).norm())
        near = angle(start.R, end.pose.R) < MAX_DRIFT and moved < MAX_DRIFT * self.task.size
        return end if near or self.first else FrameCandidate(start, 0.0, 1.0, [])

    def _center(self, pose: Pose) -> Tensor:
        assert self.task is not None
        return self.task.center_at(pose)

    def _stepped(
        self, level: PhotoLevel, pose: Pose, most: int, offset: Tensor | None = None
    ) -> tuple[Pose, list[PictureComparison]]:  # fmt: skip
        """Take at most so many Gauss-Newton steps, until a short one; return the pose and the comparisons before the last
        step. `offset` (n,) is how far the steps have led from the prediction, which they add to. Where the picture shows
        little, the pose is pulled to the prediction."""
        views: list[PictureComparison] = []
        for step in range(most):
            views = level.comparisons(pose, self.seed)
            if level.last and step == 0:
                level = level.focused(views)
            normal, _loss = level.equations(pose, self.seed, views)
            if not float(normal.curvature.trace()) > 0.0:
                break  # The prior below would hide that.
            if offset is not None:
                known = torch.eye(len(offset), dtype=torch.float64) / self.steady**2
                normal = NormalEquations(normal.curvature + known, normal.gradient + known @ offset)
            move = level.step(normal)
            assert move is not None
            pose = level.task.moved(pose, level.pyramid_level.dofs, move)
            if offset is not None:
                offset += move
            if float(move.abs().max()) < SHORT_STEP * level.pyramid_level.coarseness:
                break
        return pose, views

    def _levels(self, task: PoseTask, depth: Tensor | None, pose: Pose) -> list[PhotoLevel]:
        return photo_levels(task, pose, [depth], self.settings, self.palettes)

    def _searched(self, task: PoseTask, depth: Tensor | None) -> FrameCandidate:
        """Search the whole picture for the object, about as large as it was, and rotated by up to some 60°."""
        camera, scale, best = task.shots[0].camera, self.good.scale, FrameCandidate(self.good, 0.0, 1.0, [])
        if camera.projection not in ("perspective", "orthographic"):
            return best
        unit = replace(
            task, scene=task.scene.transformed(torch.eye(3), torch.zeros(3), scale), center=scale * task.center
        )
        rotations = ball(SEARCH_VIEWS, SEARCH_RADIUS) @ (camera.world_to_camera[:3, :3] @ self.good.R)
        far = self._distance(self.good)
        size = across(unit, camera, far) / min(camera.size)
        views = self.light.illuminated(TemplateViews.from_rotations(unit, rotations, VIEW_PIXELS, self.seed), camera)
        lit = self.light.light is not None
        poses = [
            pose._replace(scale=scale) for pose in places(unit, views, (size / SIZE_FACTOR, size * SIZE_FACTOR), lit)
        ]
        if camera.projection == "orthographic":  # The match does not show depth.
            axis = camera.world_to_camera[2, :3]
            poses = [pose._replace(t=pose.t + (far - self._distance(pose)) * axis) for pose in poses]
        found = []
        for pose in poses[:CANDIDATES]:
            level = self._levels(task, depth, pose)[0]
            pose, views = self._stepped(level, pose, TRACK_STEPS)
            found.append((level.edge_support(pose, self.seed, views), pose))
        found.sort(key=lambda one: -one[0])
        for _, pose in found[:REFINED_CANDIDATES]:
            again = self._down(self._levels(task, depth, pose), pose, RETRY_STEPS)
            best = max(best, again, key=lambda end: end.shown)
            if best.share >= LEARNING_SUPPORT and best.covered < HARDLY:
                break
        return best

    def _distance(self, pose: Pose) -> float:
        """Return the distance of the object's centre from the camera along its axis, world units."""
        assert self.task is not None
        return float(depth_of(self.camera.to(torch.float64), pose, self.task.center))

    def _predicted(self) -> Pose:
        """Predict the pose by constant velocity."""
        assert self.task is not None
        if self.lost:
            return self.good
        R = self.turn @ self.pose.R
        where = self._center(self.pose) + self.shift
        return self.pose._replace(R=R, t=where - self.pose.scale * (R @ self.task.center))

    def _move(self, pose: Pose, share: float, lost: bool) -> None:
        """Update position and velocity."""
        if not (self.first or lost) and (share < MIN_SHOWN_SUPPORT or self.covered > MOSTLY):
            self.pose = pose  # The velocity stays.
            return
        moved, self.moves = self.moves, not (self.first or lost)
        if lost:  # The velocity is not known.
            self.turn, self.shift = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
        elif not self.first:
            far = angle(self.pose.R, pose.R) > MAX_DRIFT  # It was found again.
            turn = torch.eye(3, dtype=torch.float64) if far else pose.R @ self.pose.R.T
            shift = torch.zeros(3, dtype=torch.float64) if far else self._center(pose) - self._center(self.pose)
            # A difference of two poses has the errors of both, so velocities are averaged.
            known = moved and not far
            self.turn, self.shift = (_between(self.turn, turn), 0.5 * (self.shift + shift)) if known else (turn, shift)
        self.pose, self.first = self.good if lost else pose, False
        if share >= PHOTO_SUPPORT and not lost:
            self.good = pose

    def _task(self, name: str, picture: Tensor) -> PoseTask:
        task = PoseTask.from_arguments(
            self.mesh, picture, self.camera, None, None, Unknowns(), float(self.pose.scale), ArgumentNames(images=name)
        )  # fmt: skip
        # The background counts as unknown, since a film shows more than one.
        task = replace(task, clutter=True, shots=[task.shots[0]._replace(background=None)])
        whole = Picture.from_shot(task.shots[0], False, None, self.camera.size)
        self.palettes = [palette(whole.outlined, self.seed)]
        return task

    def _picture(self, name: str, frame: object) -> Tensor:
        """Return the frame (H, W, C). Raises TypeError, ValueError or OSError."""
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
    """Return the rotation midway between two (3, 3)."""
    U, _, Vh = torch.linalg.svd(A + B)
    return U @ Vh
