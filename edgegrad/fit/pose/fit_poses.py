"""fit_poses(): poses of several known meshes in a photograph in which they may cover one another.

Each object is sought in turn, where the others leave it to be seen: what covers it at the present poses counts for nothing. Poses
of all objects are sought anew until they stay, since each pose decides what the others show.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from ...camera.camera import Camera
from ...check import as_tensor, check_flag, check_shape
from ...render import render
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ...scene.symmetries import Symmetries
from ..by_camera import numbered, one_for_each
from ..measured import depth_images
from ..modes import in_full_precision
from ..options import POSE_OPTIONS, FitOptions, Settings
from ..placement import Pose, angle, pose_from_matrix
from ..views import Images, cameras_of
from .fit_pose import fit_of, symmetries_of
from .hypotheses import HypothesisSearch, turned
from .inputs import ArgumentNames, check_in_front, check_seen, warn_of_units
from .likelihood.objective import pose_levels
from .likelihood.support import evidence_of
from .pose_search import PoseSearch
from .result import PoseFit, Step
from .settings import CAMERA, POSE
from .task import PoseTask, Unknowns

INSIDE = 64  # Number of vertices of a mesh that are tested for lying in another.
INNER_SCALE = 0.9  # At the end, they are tested at this share of their distance from their mean.


@in_full_precision
def fit_poses(
    meshes: Sequence[Mesh | Scene],
    images: Images,
    cameras: Camera | Sequence[Camera],
    masks: Tensor | Sequence[Any] | None = None,
    init: Sequence[PoseFit | Tensor] | None = None,
    *,
    weights: Images | None = None,
    depths: Images | None = None,
    search: bool = True,
    symmetries: Sequence[Symmetries | Literal["find"] | None] | None = None,
    options: FitOptions | None = None,
) -> list[PoseFit]:
    """Find rotation and translation of several known meshes in a picture, or in several, in one fit.

    Parameters
    ----------
    meshes : sequence of Mesh or Scene
        The objects, with colours or without; the meshes of a Scene move together.
    images, cameras, weights, depths
        As of fit_pose().
    masks : Tensor or sequence, optional
        Where each object is seen, without what covers it: an image of labels (H, W) of integers, k + 1 where meshes[k] is seen
        and 0 elsewhere; or a list with a mask (H, W) for each mesh. Of several pictures each of these is a list with one for
        each.
    init : sequence of PoseFit or Tensor, optional
        Of each mesh an earlier fit, or mesh to world (4, 4), within some 15° and 5 % of its size. By default where the mesh
        files put them.
    search : bool, default True
        Whether an object whose edges the pictures do not show at its end starts again from other poses.
    symmetries : sequence of Symmetries, "find" or None, optional
        Of each mesh, as of fit_pose().
    options : FitOptions, optional
        Of its defaults, `steps` is 40, `step_tolerance` 3e-4, `spp` 16 and `max_size` 256.

    Returns
    -------
    list of PoseFit
        One for each mesh, with `visible`, the share of it that the others do not hide. `reason` says so where less than a
        tenth is visible, or where it ends inside another one.

    Raises
    ------
    TypeError, ValueError
        An argument is wrong, or an object is out of the picture, or inside another one, at the start; the message names it.
    """
    settings = Settings.from_options(options, "fit_poses", POSE_OPTIONS, steps=40)
    progress = settings.progress_of("fit", lambda: results())
    count, views = _counted(meshes), cameras_of(cameras)
    starts = _starts(init, count)
    own_masks = _masks(masks, count, views)
    known = _each("symmetries", symmetries, count)
    known_symmetries = [
        symmetries_of(one, mesh, f"symmetries[{k}]") for k, (one, mesh) in enumerate(zip(known, meshes, strict=True))
    ]
    tasks = [
        PoseTask.from_arguments(
            mesh, images, views, own, weights, Unknowns(), float(start.scale),
            ArgumentNames(f"meshes[{k}]", init=f"init[{k}]", masks=f"masks[{k}]"),
        )
        for k, (mesh, own, start) in enumerate(zip(meshes, own_masks, starts, strict=True))
    ]  # fmt: skip
    measured = depth_images(depths, views)
    for task, start in zip(tasks, starts, strict=True):
        for shot in task.shots:
            check_in_front(task.names.init, shot.camera, start, task.center)
    _check_apart(tasks, starts)
    for task, start in zip(tasks, starts, strict=True):
        check_seen(task.names.init, task.scene, [shot.camera for shot in task.shots], start)
    moved = [mesh for task, start in zip(tasks, starts, strict=True) for mesh in _moved(task, start)]
    warn_of_units(Scene(moved), [shot.camera for shot in tasks[0].shots], measured, "at the start")
    searches = [
        ObjectSearch(task, start, measured, settings, further=check_flag("search", search), symmetries=own)
        for task, start, own in zip(tasks, starts, known_symmetries, strict=True)
    ]

    def results() -> list[PoseFit]:
        poses = [one.best for one in searches]
        conflicts = ["" if one.information is None else _conflict(tasks, poses, k) for k, one in enumerate(searches)]
        return [fit_of(one, progress, views, said, one.visible) for one, said in zip(searches, conflicts, strict=True)]

    for k, one in enumerate(searches):
        one.after_step = lambda k=k, one=one: progress.step(f"meshes[{k}], loss {one.loss:.2e}")
    with progress:
        search_objects(searches)
    return results()


class ObjectSearch(PoseSearch):
    """The search for one object among others."""

    visible = math.nan  # share of it that the others do not hide

    def seek(self, task: PoseTask, first: bool) -> None:
        """Find the pose while the others stay. After the `first` time it is refined on the last level alone."""
        poses = turned(task, self.best) if first and self.further else [self.best]
        groups, further = [(self.best, poses)], first and self.further
        search = HypothesisSearch(task, groups, self.depths, self.settings, self.symmetries, further, coarse=first)
        earlier = [step._replace(best=False) for step in self.history]

        def after_step() -> None:
            self.history, self.best, self.loss = [*earlier, *search.history], search.likeliest, search.cost
            self.after_step()

        search.after_step = after_step
        self.modes = search.run() or self.modes
        if self.modes:
            self.best, self.loss = self.modes[0].pose, self.modes[0].cost

    def judge(self, task: PoseTask, visible: float) -> None:
        """Say what speaks for the answer, with the others at theirs. The visible part of a covered object is more ambiguous."""
        level = pose_levels(task, self.best, self.depths, self.settings)[-1].informed([self.best])
        found = evidence_of(level.focused(self.best), self.best)
        self.visible, self.edge_support, self.evidence = visible, found.edges, found if self.modes else None
        if visible < POSE.unoccluded:
            self.enough = max(self.enough, POSE.covered_support)
        self.history.append(Step(level.size, self.loss, self.best, True, {}))


def search_objects(objects: Sequence[ObjectSearch]) -> None:
    """Search for all; raise ValueError when nothing in the pictures depends on the poses."""
    for count in range(POSE.rounds_of_objects):
        before = [one.best for one in objects]
        for k, one in enumerate(objects):
            task, visible = _uncovered(objects, k)
            if visible >= CAMERA.least_visible:
                one.seek(task, first=count == 0)
        if all(_near(one, pose) for one, pose in zip(objects, before, strict=True)):
            break
    if not any(one.modes for one in objects):
        raise ValueError("init: expected poses at which the picture changes when the objects move, got none")
    for one, seen in zip(objects, [_uncovered(objects, k) for k in range(len(objects))], strict=True):
        one.judge(*seen)


def _uncovered(objects: Sequence[ObjectSearch], k: int) -> tuple[PoseTask, float]:
    """Return the task of one object, with a weight of 0 where others that cover a part of it are seen, with a margin; and
    the share of its pixels that they leave."""
    moved = [one.task.scene.transformed(*one.best[:3]) for one in objects]
    task, settings = objects[k].task, objects[k].settings
    spp, seed = settings.spp, settings.seed
    shots, own, whole = [], 0.0, 0.0
    for shot in task.shots:
        with torch.no_grad():
            seen = render(_labelled(moved), shot.camera, spp, seed)
            alone = render(_labelled(moved[k : k + 1]), shot.camera, spp, seed)[..., 0]
        own, whole = own + float(seen[..., k].sum()), whole + float(alone.sum())
        hidden = alone - seen[..., k] > 0.5
        fronts = [j for j in range(len(moved)) if j != k and float(seen[hidden][:, j].sum()) > 1.0]
        before = seen[..., fronts].sum(-1)[None, None]
        margin = POSE.cover_margin
        before = F.max_pool2d(before, 2 * margin + 1, 1, margin)[0, 0, ..., None].float()
        weight = 1.0 - before if shot.weight is None else shot.weight * (1.0 - before)
        shots.append(shot._replace(weight=weight.clamp(min=0.0)))
    return replace(task, shots=shots), min(1.0, own / whole) if whole > 0.0 else 0.0


def _near(search: ObjectSearch, pose: Pose) -> bool:
    return max(angle(search.best.R, pose.R), search.task.between(search.best, pose)) < POSE.distinct


def _labelled(scenes: Sequence[Scene]) -> Scene:
    """Return all objects in one scene, each with a channel of its own, which is 1 on it."""
    labels = torch.eye(len(scenes), dtype=torch.float64)
    return Scene([
        Mesh(mesh.verts, mesh.faces, colors=label.expand(len(mesh.verts), -1))
        for scene, label in zip(scenes, labels, strict=True) for mesh in scene.meshes
    ])  # fmt: skip


def _counted(meshes: object) -> int:
    """Return the number of meshes. Raises TypeError or ValueError."""
    if not isinstance(meshes, Sequence) or isinstance(meshes, str):
        raise TypeError(f"meshes: expected a list of meshes, got {type(meshes).__name__}; for one, call fit_pose")
    if not meshes:
        raise ValueError("meshes: expected at least one, got none")
    return len(meshes)


def _each(name: str, given: object, count: int) -> list[Any]:
    """Return one for each mesh, None where none is given. Raises TypeError or ValueError."""
    if given is None:
        return [None] * count
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise TypeError(
            f"{name}: expected a list with one for each mesh, got {type(given).__name__}; give [{name}] for one mesh"
        )
    if len(given) != count:
        raise ValueError(f"{name}: expected {count}, one for each mesh, got {len(given)}")
    return list(given)


def _starts(init: object, count: int) -> list[Pose]:
    if getattr(init, "ndim", 0) == 3:  # (N, 4, 4)
        init = list(init)  # type: ignore[call-overload]
    given = _each("init", init, count)
    return [
        pose_from_matrix(f"init[{k}]", torch.eye(4) if one is None else getattr(one, "matrix", one))
        for k, one in enumerate(given)
    ]


def _masks(masks: Any, count: int, cameras: Sequence[Camera]) -> list[Any]:
    """Return, for each mesh, what fit_pose calls the masks. Raises TypeError or ValueError."""
    n = len(cameras)
    labelled = isinstance(masks, Sequence) and len(masks) == n and all(map(_is_labels, masks))
    if not hasattr(masks, "ndim") and not labelled:
        found = _each("masks", masks, count)
        if 0 < (missing := sum(one is None for one in found)) < count:
            raise ValueError(f"masks: expected a mask for each mesh or for none, got {count - missing} of {count}")
        return found
    columns = [
        _of_labels(numbered("masks", k, n), one, count, camera.size)
        for k, (one, camera) in enumerate(zip(one_for_each("masks", masks, n, 2), cameras, strict=True))
    ]
    return [list(row) for row in zip(*columns, strict=True)]


def _is_labels(given: object) -> bool:
    if not hasattr(given, "ndim"):
        return False
    value = as_tensor("masks", given)
    return not value.is_floating_point() and value.dtype != torch.bool


def _of_labels(name: str, labels: object, count: int, size: tuple[int, int]) -> list[Tensor]:
    """Return a mask for each mesh, for a camera of that size."""
    value = as_tensor(name, labels).detach().cpu()
    if not _is_labels(value):
        raise TypeError(
            f"{name}: expected an image of labels, of integers, or a list with a mask for each mesh, got {value.dtype}"
        )
    check_shape(name, value, size, (*size, 1), fix="an image of labels needs the picture's size")
    found = [(value == k + 1).float() for k in range(count)]
    for k, one in enumerate(found):
        if not bool(one.any()):
            there = sorted(int(label) for label in value.unique().tolist())[:10]
            raise ValueError(
                f"{name}: expected the label {k + 1} where meshes[{k}] is seen, got only {there}; give a list of masks "
                "instead, or leave out a mesh that is not seen"
            )
    return found


def _moved(task: PoseTask, pose: Pose) -> list[Mesh]:
    return list(task.scene.transformed(pose.R, pose.t, pose.scale).meshes)


def _share_inside(one: Sequence[Mesh], other: Sequence[Mesh], scale: float) -> float:
    """Return the share of an object's vertices that lie inside another one; of at most INSIDE of them, with their distances from
    their mean multiplied. It is 1 of two objects that coincide vertex by vertex."""
    points, others = (torch.cat([mesh.verts for mesh in body]).double() for body in (one, other))
    if points.shape == others.shape and torch.allclose(points, others, atol=1e-6 * float(points.abs().max())):
        return 1.0
    some = points[:: max(1, len(points) // INSIDE)]
    some = some.mean(0) + scale * (some - some.mean(0))
    return float(torch.stack([_inside(some, mesh) for mesh in other]).any(0).double().mean())


def _inside(points: Tensor, mesh: Mesh) -> Tensor:
    """Return which points (n, 3) lie inside a closed mesh (n,); none lies inside an open one."""
    import trimesh  # This import takes longer than a step of a fit.

    solid = trimesh.Trimesh(mesh.verts.numpy(), mesh.faces.numpy(), process=False)
    inside = solid.contains(points.numpy()) if solid.is_watertight else [False] * len(points)
    return torch.as_tensor(inside)


def _conflict(tasks: Sequence[PoseTask], poses: Sequence[Pose], k: int) -> str:
    """Return in words whether an object ends where another one is: at least half of its vertices, or of the other's, lie
    inside."""
    bodies = [_moved(task, pose) for task, pose in zip(tasks, poses, strict=True)]
    for other, body in enumerate(bodies):
        # A little smaller, two coinciding objects are inside one another.
        pairs = [] if other == k else [(bodies[k], body), (body, bodies[k])]
        if any(_share_inside(a, b, INNER_SCALE) >= 0.5 for a, b in pairs):
            return f"in one place: meshes[{k}] ends where meshes[{other}] does; leave one out, or start them elsewhere"
    return ""


def _check_apart(tasks: Sequence[PoseTask], starts: Sequence[Pose]) -> None:
    """Raise ValueError where an object lies inside another one, or two coincide."""
    bodies = [_moved(task, start) for task, start in zip(tasks, starts, strict=True)]
    for k, other in itertools.permutations(range(len(bodies)), 2):
        if _share_inside(bodies[k], bodies[other], 1.0) == 1.0:
            raise ValueError(
                f"init[{k}]: expected the objects next to one another, got meshes[{k}] inside meshes[{other}], or where it is; "
                "move one of them, or leave it out"
            )
