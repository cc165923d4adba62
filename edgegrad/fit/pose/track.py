"""track(): where a known mesh stands in each picture of a film.

Where the object was and how it moved says about where it is. From there a few Gauss-Newton steps over the terms of photographs
(region, contour, light and depth) find it, on two levels of resolution around the object alone. Where they do not end at edges
of the picture, more steps begin on the coarsest level, from where the object was as well; where that fails for some pictures
the object is lost, and is searched for in the whole picture, in the light that it was seen in.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from os import PathLike as OsPath
from typing import NamedTuple

import torch
from torch import Tensor

from ...camera.camera import Camera
from ...check import check_int, check_positive_int
from ...files.image import read_image
from ...files.paths import PathLike
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..region import Palette, palette
from ..views import check_image
from .fit_pose import depth_image
from .gauss_newton import Normal
from .given import Names, check_in_front, check_max_size, check_seen, depth_of
from .photo.depth import warn_of_units
from .photo.level import PhotoLevel, Seen, photo_levels
from .photo.match import ACROSS, places
from .photo.picture import Picture
from .photo.remembered import Remembered
from .photo.views import Views, across, ball
from .photo.ways import ALONE_ENOUGH, DAMPING, ENOUGH, FLOOR, LAST_DAMPING, LONGEST
from .pose import Pose, angle, pose_from_matrix
from .result import PoseFit
from .task import Lens, PoseTask

Frame = Tensor | PathLike
STEPS = 4  # on the last level but one and on the last, where the prediction is good
MORE_STEPS = 8  # on each level, where it is not
# Standard deviation of the motion from that of constant velocity, radians and object sizes: at first, and at least.
STEADY, STEADIEST = 0.03, 0.005
SHORT = 1e-3  # of a step on the last level: radians and object sizes
POOR = 0.45  # of the render's edges: a picture that shows fewer hardly shows the object there
PATIENCE = 4  # such pictures one after the other, and the object is lost
AGAIN = 5  # pictures from one search for a lost object to the next
RATE = 0.1  # of a picture, in how steadily the object moves
LEARNT = 0.8  # of the edges, in pictures that light is learnt from
SUDDEN = 0.3  # more of it covered than in the picture before
HARDLY, MOSTLY = 0.2, 0.6  # of the object covered: the rest tells little
# The search for a lost object: views, by so many radians at most from the last good pose, and by such a factor in size;
# matches that are followed for a few steps, and of them to the end.
VIEWS, TURNED, SIZES = 160, 1.1, 1.2
CANDIDATES, FOLLOWED = 20, 4
FARTHEST = 0.25  # radians and object sizes that steps lead from where they begin


@dataclass(frozen=True, eq=False)
class TrackedPose:
    """Where the mesh is in one picture: `world = scale · R v + t`."""

    index: int  # of the picture, from 0
    R: Tensor  # (3, 3) float64
    t: Tensor  # (3,) float64, world units
    scale: float  # that of `init`
    explained: (
        float  # the share of the render's edges that the picture shows too, 0 … 1, where nothing covers the object
    )
    lost: bool  # the pose is the last one at which the object was seen
    covered: float = 0.0  # the share of the object that the light of the pictures before does not explain, 0 … 1

    @property
    def reason(self) -> str:
        """In words, how well the pose is known: "seen", or "lost: …", "hardly seen: …" or "covered: …"."""
        if self.lost:
            return "lost: where the object was seen last, since pictures one after the other hardly show it"
        if self.explained < POOR:
            return (
                f"hardly seen: where its motion leads, for the picture shows {self.explained:.0%} of the render's edges"
            )
        if self.covered > MOSTLY:
            return f"covered: {self.covered:.0%} of the object is not what it looked like before"
        return "seen"

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
    object (`explained` below 0.45), it is `lost`, and is searched for until it is found again: where it was seen last in each
    picture, and in every fifth all over it, turned by up to some 60° and up to a fifth larger or smaller, by perspective and
    orthographic cameras.

    Arguments are checked at once; an `init` at which the camera sees nothing of the object is refused. A picture that cannot be
    used (another size, numbers that are not finite, a file that is not there) is an error, ValueError, TypeError or OSError,
    that names it as `frames[k]`, raised when it is asked for; the poses of those before it have been given by then.
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
    if isinstance(depth, Tensor) and depth.dim() not in (3, 4):
        raise ValueError(f"depth: expected (T, H, W), got {tuple(depth.shape)}; give a list of depth images")
    check_max_size(max_size)
    check_positive_int("spp", spp)
    check_int("seed", seed, 0, 2**32 - 1)
    start = pose_from_matrix("init", getattr(init, "matrix", init))
    scene = (Scene([mesh]) if isinstance(mesh, Mesh) else mesh).to("cpu").detach()
    low, high = torch.cat([part.verts.double() for part in scene.meshes]).aminmax(dim=0)
    check_in_front("init", camera.to("cpu"), start, (low + high) / 2)
    check_seen("init", scene, [camera.to("cpu")], start)
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


class End(NamedTuple):
    """Where a way down ended."""

    pose: Pose
    share: float  # of the render's edges, where nothing covers it
    covered: float  # share of the object
    views: list[Seen]

    @property
    def shown(self) -> float:
        """How much of the object the picture shows there."""
        return self.share * (1.0 - self.covered)


class Tracker:
    """What is known of a film so far."""

    def __init__(self, mesh: Mesh | Scene, camera: Camera, start: Pose, max_size: int, spp: int, seed: int) -> None:
        self.mesh, self.camera = mesh, camera
        self.max_size, self.spp, self.seed = max_size, spp, seed
        self.pose = self.good = start  # the last one, and the last one at which the object was seen
        self.turn, self.shift = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)  # a picture
        self.poor = self.lost = 0  # pictures one after the other that hardly show the object, and in which it is lost
        self.first, self.moves = True, False  # whether the velocity is known
        self.task: PoseTask | None = None
        self.palettes: list[Palette] = []
        self.steady = STEADY
        self.covered = 0.0  # share of the object in the last picture
        self.remembered = Remembered()

    @torch.inference_mode(False)
    @torch.enable_grad()
    def follow(self, index: int, frame: object, measured: object) -> TrackedPose:
        """The pose in the next picture. Raises TypeError, ValueError or OSError."""
        name = f"frames[{index}]"
        picture = self._picture(name, frame)
        if self.task is None:
            self.task = self._task(name, picture)
        task = replace(self.task, shots=[self.task.shots[0]._replace(target=picture / self.task.white)])
        near = None if measured is None else depth_image(f"depth[{index}]", measured, self.camera.size)
        if self.first:
            there = task.scene.transformed(self.pose.R, self.pose.t, self.pose.scale)
            warn_of_units(there, [task.shots[0].camera], [near], "at the start")
        predicted = self._predicted()
        pose, share, self.covered, _ = self._found(task, near, predicted)
        if self.first or share >= POOR:
            self.poor = self.lost = 0
        else:
            self.poor += 1
        lost = self.poor >= PATIENCE
        self.lost = self.lost + 1 if lost else 0
        if lost and self.lost % AGAIN == 0:
            again = self._searched(task, near)
            if again.share >= (ALONE_ENOUGH if task.colourless else ENOUGH) and again.covered < MOSTLY:
                pose, share, self.covered, _ = again
                lost, self.poor, self.lost = False, 0, 0
        self._move(pose, share, lost)
        where = self.pose.R, self.pose.t, float(self.pose.scale)
        return TrackedPose(index, *where, share, lost, self.covered)

    def _found(self, task: PoseTask, depth: Tensor | None, predicted: Pose) -> End:
        """Where the object is."""
        best = End(predicted, 0.0, 1.0, [])
        if not self.first and not self.lost:
            levels = self._levels(task, depth, predicted)
            offset = torch.zeros(len(levels[-1].plain.free), dtype=torch.float64) if self.moves else None
            best = self._believed(self._down(levels[-2:], predicted, STEPS, offset), predicted)
            if offset is not None and best.share >= LEARNT and best.covered < HARDLY:
                variance = (1.0 - RATE) * self.steady**2 + RATE * float(offset.square().mean())
                self.steady = max(variance**0.5, STEADIEST)
        if best.share < ENOUGH or best.covered > self.covered + SUDDEN:  # for what covers an object comes gradually
            for start in [predicted] if self.first or predicted is self.good else [predicted, self.good]:
                again = self._believed(self._down(self._levels(task, depth, start), start, MORE_STEPS), start)
                if again.shown > best.shown:
                    best = again
                if best.share >= ENOUGH and best.covered < MOSTLY:
                    break
        if self.first and best.share < ENOUGH:  # the coarsest level leads aside from some starts that are near
            again = self._down(self._levels(task, depth, predicted)[-2:], predicted, MORE_STEPS)
            best = max(best, again, key=lambda end: end.shown)
        if best.share >= LEARNT and best.covered < MOSTLY:
            self.remembered.learn(best.views)
        return best if best.share >= POOR else best._replace(pose=predicted)

    def _down(self, levels: list[PhotoLevel], start: Pose, most: int, offset: Tensor | None = None) -> End:
        """Through the levels, with so many steps on each at most; `offset` as of _stepped()."""
        cover = self.remembered.cover(levels[-2].see(start, self.seed)) if offset is not None else None
        pose, views = start, []
        for level in levels:
            pose, views = self._stepped(level if cover is None else cover.left_out(level), pose, most, offset)
            cover = self.remembered.cover(views) or cover
        share = levels[-1].explained(pose, self.seed, views)
        return End(pose, share, 0.0 if cover is None else cover.share, views)

    def _believed(self, end: End, start: Pose) -> End:
        """Steps that lead far from where they began follow something else than the object, whatever they explain there."""
        assert self.task is not None
        near = angle(start.R, end.pose.R) < FARTHEST and self._way(start, end.pose) < FARTHEST * self.task.size
        return end if near or self.first else End(start, 0.0, 1.0, [])

    def _way(self, a: Pose, b: Pose) -> float:
        """Between the object's centres."""
        return float((self._center(a) - self._center(b)).norm())

    def _center(self, pose: Pose) -> Tensor:
        assert self.task is not None
        return pose.scale * (pose.R @ self.task.center) + pose.t

    def _stepped(
        self, level: PhotoLevel, pose: Pose, most: int, offset: Tensor | None = None
    ) -> tuple[Pose, list[Seen]]:  # fmt: skip
        """After so many Gauss-Newton steps at most, or a short one, and what was seen before the last, which is short where the
        way ends well. `offset` (n,): how far the steps have led from the prediction, which they add to; the object is taken to
        be near that, as far as the picture shows little of it."""
        views: list[Seen] = []
        for step in range(most):
            views = level.see(pose, self.seed)
            if level.last and step == 0:
                level = level.focused(views)
            normal, _loss = level.equations(pose, self.seed, views)
            if not float(normal.curvature.trace()) > 0.0:
                break  # the prior below would hide that
            if offset is not None:
                known = torch.eye(len(offset), dtype=torch.float64) / self.steady**2
                normal = Normal(normal.curvature + known, normal.gradient + known @ offset)
            move = normal.damped(LAST_DAMPING if level.last else DAMPING, FLOOR, LONGEST)
            assert move is not None
            pose = level.task.moved(pose, level.plain.free, move)
            if offset is not None:
                offset += move
            if float(move.abs().max()) < SHORT * level.plain.coarseness:
                break
        return pose, views

    def _levels(self, task: PoseTask, depth: Tensor | None, pose: Pose) -> list[PhotoLevel]:
        return photo_levels(task, pose, [depth], self.max_size, self.spp, self.seed, self.palettes)

    def _searched(self, task: PoseTask, depth: Tensor | None) -> End:
        """Where the whole picture looks like the object, as large about as it was, and turned by up to some 60°."""
        camera, scale, best = task.shots[0].camera, self.good.scale, End(self.good, 0.0, 1.0, [])
        if camera.projection not in ("perspective", "orthographic"):
            return best
        unit = replace(
            task, scene=task.scene.transformed(torch.eye(3), torch.zeros(3), scale), center=scale * task.center
        )
        rotations = ball(VIEWS, TURNED) @ (camera.world_to_camera[:3, :3] @ self.good.R)
        far = self._distance(self.good)
        size = across(unit, camera, far) / min(camera.size)
        views = self.remembered.shone_on(Views.of(unit, rotations, ACROSS, self.seed), camera)
        lit = self.remembered.light is not None
        poses = [pose._replace(scale=scale) for pose in places(unit, views, (size / SIZES, size * SIZES), lit)]
        if camera.projection == "orthographic":  # which does not show it
            axis = camera.world_to_camera[2, :3]
            poses = [pose._replace(t=pose.t + (far - self._distance(pose)) * axis) for pose in poses]
        found = []
        for pose in poses[:CANDIDATES]:
            level = self._levels(task, depth, pose)[0]
            pose, views = self._stepped(level, pose, STEPS)
            found.append((level.explained(pose, self.seed, views), pose))
        found.sort(key=lambda one: -one[0])
        for _, pose in found[:FOLLOWED]:
            again = self._down(self._levels(task, depth, pose), pose, MORE_STEPS)
            best = max(best, again, key=lambda end: end.shown)
            if best.share >= LEARNT and best.covered < HARDLY:
                break
        return best

    def _distance(self, pose: Pose) -> float:
        """Of the object's centre from the camera, world units; along the view, as sizes in the picture have it."""
        assert self.task is not None
        return float(depth_of(self.camera.to(torch.float64), pose, self.task.center))

    def _predicted(self) -> Pose:
        """By constant velocity."""
        assert self.task is not None
        if self.lost:
            return self.good
        R = self.turn @ self.pose.R
        where = self._center(self.pose) + self.shift
        return self.pose._replace(R=R, t=where - self.pose.scale * (R @ self.task.center))

    def _move(self, pose: Pose, share: float, lost: bool) -> None:
        """Takes in where the object is now."""
        if not (self.first or lost) and (share < POOR or self.covered > MOSTLY):
            self.pose = pose  # and goes on as it went
            return
        moved, self.moves = self.moves, not (self.first or lost)
        if lost:  # where it went is not known
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
