"""track(): the pose of a known mesh in each picture of a film.

A picture's likelihood is that of fit_pose. Its prior is the motion so far: the position in the last picture and the velocity
predict the pose with a normal distribution, whose variance the film teaches. The posterior's maximum is sought from the
prediction, on two levels of resolution around the object alone. Where it does not lie at edges of the picture, the object moved
otherwise, and the search of fit_pose begins at the prediction and where the object was seen last. After some such pictures the
object is lost, and is searched for in the whole picture.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from os import PathLike as OsPath
from typing import NamedTuple

import torch
from torch import Tensor

from ...camera.camera import Camera
from ...camera.poses import rigid, rotation
from ...files.image import read_image
from ...files.paths import PathLike
from ...optim.levenberg_marquardt import Descent, LevenbergMarquardtSettings, Model, Problem, minimise
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..measured import measured_image
from ..modes import in_full_precision
from ..options import FitOptions, Settings
from ..placement import Pose, pose_from_matrix, rotation_vector
from ..region import Palette
from ..views import check_image
from .hypotheses import HypothesisSearch
from .inputs import ArgumentNames, check_in_front, check_seen, depth_of, warn_of_units
from .likelihood.contour import ContourNoise
from .likelihood.objective import PoseLevel, pose_levels
from .likelihood.support import enough_support, evidence_of
from .photo.match import places
from .photo.template_views import TemplateViews, across, ball
from .result import PoseFit
from .settings import POSE, TEMPLATES
from .task import PoseTask, Unknowns

FrameLike = Tensor | PathLike


@dataclass(frozen=True)
class TrackSettings:
    """Numbers of the tracker. Deviations from the predicted pose are in radians and sizes of the object."""

    steps: int = 5  # Most steps on a level: half as many leave errors to the next picture, twice as many take longer.
    short_step: float = 1e-3  # A shorter one ends a descent. Twice as much saves a step, and adds as much noise.
    # A step ends it, too, that is predicted to gain less, in nats of independent pixels. A fourth takes a third more evaluations
    # for the same errors.
    least_gain: float = 4.0
    # The standard deviation of the prediction, before the film teaches it: half as much holds back objects that accelerate.
    deviation: float = 0.03
    # Its least value: a lower one holds back objects that were at rest, a higher one lets poses tremble.
    least_deviation: float = 0.005
    learning_rate: float = 0.1  # weight of a picture in that deviation: twice as much follows changes of motion sooner
    velocity_rate: float = 0.5  # weight of a picture in the velocity, which has the errors of two poses
    # Share of edges below which a picture hardly shows the object. Poses in clutter show up to 0.57.
    hardly_seen: float = 0.45
    mostly_covered: float = 0.6  # covered share of the object above which `reason` says so
    patience: int = 4  # successive pictures that hardly show the object until it is lost: more wait longer for it
    search_interval: int = 5  # pictures from one search in the whole picture to the next: fewer take longer
    # That search renders so many views, up to so many radians from where the object was seen last, and this much larger or
    # smaller. Half as many miss objects that have turned; twice as many take as much longer.
    views: int = 160
    view_radius: float = 1.1
    size_factor: float = 1.2
    matches: int = 12  # best places of views that are refined


TRACK = TrackSettings()


@dataclass(frozen=True, eq=False)
class TrackedPose:
    """The mesh's pose in one picture: `world = scale · R v + t`."""

    index: int  # number of the picture, from 0
    R: Tensor  # (3, 3) float64
    t: Tensor  # (3,) float64, world units
    scale: float  # as of `init`
    explained: float  # share of the render's visible edges that the picture shows, 0 … 1
    lost: bool  # The pose is the last one at which the object was seen.
    covered: float = 0.0  # share of the object that something else seems to cover, 0 … 1

    @property
    def reason(self) -> str:
        """How well the pose is known, in words: "seen", or "lost: …", "hardly seen: …" or "covered: …"."""
        if self.lost:
            return "lost: where the object was seen last, since pictures one after the other hardly show it"
        if self.explained < TRACK.hardly_seen:
            return (
                f"hardly seen: where its motion leads, for the picture shows {self.explained:.0%} of the render's edges"
            )
        if self.covered > TRACK.mostly_covered:
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
    check_one_by_one("frames", frames, 4, "pictures or paths one after the other")
    if depths is not None:
        check_one_by_one("depths", depths, 3, "one for each frame or None")
    settings = Settings.from_options(options, "track", ("max_size", "spp"), spp=8)
    start = pose_from_matrix("init", getattr(init, "matrix", init))
    scene = (Scene([mesh]) if isinstance(mesh, Mesh) else mesh).to("cpu").detach()
    low, high = torch.cat([part.verts.double() for part in scene.meshes]).aminmax(dim=0)
    check_in_front("init", camera.to("cpu"), start, (low + high) / 2)
    check_seen("init", scene, [camera.to("cpu")], start)
    return _poses(Tracker(mesh, camera, start, settings), frames, depths)


def check_one_by_one(name: str, given: object, dims: int, expected: str) -> None:
    """Raise TypeError or ValueError for what has no pictures one after the other; a tensor has so many dimensions, or one more
    for a single channel."""
    if isinstance(given, (str, OsPath)) or not isinstance(given, (Iterable, Tensor)):
        got = type(given).__name__
        raise TypeError(f"{name}: expected {expected}, got {got}; of a folder, give sorted(folder.glob('*.png'))")
    if isinstance(given, Tensor) and given.dim() not in (dims, 4):
        shape = "(T, H, W, C)" if dims == 4 else "(T, H, W)"
        raise ValueError(f"{name}: expected {shape}, got {tuple(given.shape)}; give a list of pictures")


def _poses(
    tracker: Tracker, frames: Iterable[FrameLike], depths: Iterable[Tensor | None] | None
) -> Iterator[TrackedPose]:
    measured = itertools.repeat(None) if depths is None else iter(depths)
    for index, frame in enumerate(frames):
        try:
            depth = next(measured)
        except StopIteration:
            raise ValueError(f"depths: expected one for each frame, got {index}, and more frames") from None
        yield tracker.follow(index, frame, depth)


class FrameCandidate(NamedTuple):
    """A pose in one picture."""

    pose: Pose
    share: float = 0.0  # edges of the render that the picture shows
    visible: float = 0.0  # share of the object


@dataclass(frozen=True)
class PredictedLevel(Problem[Pose]):
    """A picture at one resolution, with a prior of the pose: the objective of fit_pose, and that of a normal deviation."""

    level: PoseLevel
    predicted: Pose
    deviation: float  # standard deviation of each entry of a step from the predicted pose

    def model(self, points: Sequence[Pose]) -> Model:
        found = self.level.model(points)
        assert isinstance(found.gradient, Tensor) and isinstance(found.curvature, Tensor)
        offset = torch.stack([self.offset(pose) for pose in points])
        # Errors that neighbouring pixels have in common, successive pictures have, too. The prediction does not correct them,
        # so costs count as they are, without the temperature of Mode.log_mass.
        known = self.deviation**-2
        return Model(
            found.cost + 0.5 * known * offset.square().sum(1, keepdim=True), found.gradient + known * offset,
            found.curvature + known * torch.eye(offset.shape[1], dtype=torch.float64),
        )  # fmt: skip

    def moved(self, points: Sequence[Pose], steps: Tensor) -> list[Pose]:
        return self.level.moved(points, steps)

    def offset(self, pose: Pose) -> Tensor:
        """Return the step (n,) from the predicted pose to this one."""
        task, V = self.level.task, self.level.task.shots[0].camera.world_to_camera[:3, :3].double()
        turn = V @ rotation_vector(pose.R @ self.predicted.R.T)
        shift = V @ (task.center_at(pose) - task.center_at(self.predicted)) / task.size
        return torch.cat([turn, shift])[list(self.level.dofs)]


def _rested(problem: PredictedLevel, start: Pose) -> Descent[Pose]:
    """Return the descent from a pose when it rests."""
    settings = LevenbergMarquardtSettings(
        steps=TRACK.steps + 1, start_damping=POSE.fine_damping, least_damping=0.1 * POSE.fine_damping, unseen_damping=1e-5,
        trust_radius=POSE.longest_step, least_gain=TRACK.least_gain,
        shortest_step=TRACK.short_step * problem.level.coarseness,
    )  # fmt: skip
    return minimise(problem, [start], settings).descents[0]


def matches(task: PoseTask, last: Pose, seed: int) -> list[Pose]:
    """Return where in the whole picture the object might be, about as large as it was, and rotated by up to some 60°."""
    camera, scale = task.shots[0].camera, last.scale
    if camera.projection not in ("perspective", "orthographic"):
        return []
    unit = replace(task, scene=task.scene.transformed(torch.eye(3), torch.zeros(3), scale), center=scale * task.center)
    rotations = ball(TRACK.views, TRACK.view_radius) @ (camera.world_to_camera[:3, :3] @ last.R)
    far = float(depth_of(camera, last, task.center))
    size = across(unit, camera, far) / min(camera.size)
    views = TemplateViews.from_rotations(unit, rotations, TEMPLATES.view_pixels, seed)
    found = places(unit, views, (size / TRACK.size_factor, size * TRACK.size_factor))
    poses = [pose._replace(scale=scale) for pose in found[: TRACK.matches]]
    if camera.projection == "orthographic":  # The match does not show depth.
        axis = camera.world_to_camera[2, :3]
        off = [far - float(depth_of(camera, pose, task.center)) for pose in poses]
        poses = [pose._replace(t=pose.t + shift * axis) for pose, shift in zip(poses, off, strict=True)]
    return poses


class Tracker:
    """The state of tracking through a film."""

    def __init__(self, mesh: Mesh | Scene, camera: Camera, start: Pose, settings: Settings) -> None:
        self.mesh, self.camera, self.settings = mesh, camera, settings
        self.pose = self.good = start  # last pose, and last one at which the object was seen
        self.velocity: tuple[Tensor, Tensor] | None = None  # rotation and shift a picture, where they are known
        self.poor = 0  # successive pictures that hardly show the object
        self.task: PoseTask | None = None
        self.contours: tuple[ContourNoise, ...] | None = None  # of the film
        self.palettes: list[Palette] | None = None  # of the pictures that were last searched
        self.variance = TRACK.deviation**2  # of the prediction

    @in_full_precision
    def follow(self, index: int, frame: object, measured: object) -> TrackedPose:
        """Return the pose in the next picture. Raises TypeError, ValueError or OSError."""
        name = f"frames[{index}]"
        picture, first = self._picture(name, frame), self.task is None
        if self.task is None:
            self.task = self._task(name, picture)
        task = replace(self.task, shots=[self.task.shots[0]._replace(target=picture / self.task.white)])
        depth = None if measured is None else measured_image(f"depths[{index}]", measured, self.camera.size)[..., 0]
        if first:
            there = task.scene.transformed(self.pose.R, self.pose.t, self.pose.scale)
            warn_of_units(there, [task.shots[0].camera], [depth], "at the start")
        predicted, lost, enough = self._predicted(task), self.poor >= TRACK.patience, enough_support(task)
        found = FrameCandidate(predicted) if first or lost else self._followed(task, depth, predicted)
        seen, jumped = found.share >= TRACK.hardly_seen, False
        if found.share < enough:
            groups = [(predicted, [predicted, self.good][: 1 if predicted is self.good else 2])]
            if lost and (self.poor - TRACK.patience) % TRACK.search_interval == 0:
                groups += [(pose, [pose]) for pose in matches(task, self.good, self.settings.seed)]
            again = self._searched(task, depth, groups)
            if first or again.share >= enough:
                found, seen, jumped = again, True, True
        self.poor = 0 if seen else self.poor + 1
        lost = self.poor >= TRACK.patience
        pose = self.good if lost else found.pose if seen else predicted
        self._move(task, pose, unknown=lost or jumped)
        if found.share >= enough:
            self.good = pose
        return TrackedPose(index, pose.R, pose.t, float(pose.scale), found.share, lost, 1.0 - found.visible)

    def _followed(self, task: PoseTask, depth: Tensor | None, predicted: Pose) -> FrameCandidate:
        """Return the posterior's maximum near the predicted pose."""
        coarse, fine = pose_levels(task, predicted, [depth], self.settings, self.palettes)[-2:]
        deviation = TRACK.deviation if self.velocity is None else self.variance**0.5
        start = _rested(PredictedLevel(coarse, predicted, deviation), predicted).point
        fine = fine.focused(start) if self.contours is None else replace(fine, contour_noises=self.contours)
        self.contours, problem = fine.contour_noises, PredictedLevel(fine, predicted, deviation)
        found = _rested(problem, start)
        share, visible, *_ = evidence_of(fine, found.point)
        if self.velocity is not None and share >= enough_support(task):
            square = float(problem.offset(found.point).square().mean())
            variance = self.variance + TRACK.learning_rate * (square - self.variance)
            self.variance = max(variance, TRACK.least_deviation**2)
        return FrameCandidate(found.point, share, visible)

    def _searched(
        self, task: PoseTask, depth: Tensor | None, groups: Sequence[tuple[Pose, Sequence[Pose]]]
    ) -> FrameCandidate:  # fmt: skip
        """Return where the search of fit_pose ends, which knows no motion."""
        modes = HypothesisSearch(task, groups, [depth], self.settings, further=False).run()
        if not modes:
            return FrameCandidate(self.good)
        pose = modes[0].pose
        level = pose_levels(task, pose, [depth], self.settings)[-1]
        self.palettes = [picture.palette for picture in level.pictures]
        return FrameCandidate(pose, *evidence_of(level, pose)[:2])

    def _predicted(self, task: PoseTask) -> Pose:
        """Predict the pose by constant velocity."""
        if self.velocity is None:
            return self.pose
        turn, shift = self.velocity
        R = turn @ self.pose.R
        return self.pose._replace(R=R, t=task.center_at(self.pose) + shift - self.pose.scale * (R @ task.center))

    def _move(self, task: PoseTask, pose: Pose, unknown: bool) -> None:
        """Update position and velocity."""
        turn, shift = pose.R @ self.pose.R.T, task.center_at(pose) - task.center_at(self.pose)
        if unknown:
            self.velocity = None
        elif self.velocity is None:
            self.velocity = turn, shift
        else:
            before, way = self.velocity
            turn = rotation(TRACK.velocity_rate * rotation_vector(turn @ before.T)) @ before
            self.velocity = turn, way + TRACK.velocity_rate * (shift - way)
        self.pose = pose

    def _task(self, name: str, picture: Tensor) -> PoseTask:
        scale, names = float(self.pose.scale), ArgumentNames(images=name)
        task = PoseTask.from_arguments(self.mesh, picture, self.camera, None, None, Unknowns(), scale, names)
        # The background counts as unknown, since a film shows more than one.
        return replace(task, clutter=True, shots=[task.shots[0]._replace(background=None)])

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
