"""fit_poses(): poses of several known meshes in a photograph in which they may cover one another."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from ...camera.camera import Camera
from ...check import as_tensor, check_flag, check_shape
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ...scene.symmetries import Symmetries
from .fit_pose import ambiguity, check_callback, depth_images, symmetries_of
from .inputs import ArgumentNames, check_in_front, check_seen, check_settings, one_for_each
from .photo.depth import warn_of_units
from .photo.poses_search import PosesSearch
from .pose import Pose, pose_from_matrix
from .result import PoseFit
from .task import PoseTask, Unknowns
from .uncertainty import Uncertainty

INSIDE = 64  # Number of vertices of a mesh that are tested for lying in another.
INNER_SCALE = 0.9  # At the end, they are tested at this share of their distance from their mean.


@torch.inference_mode(False)
@torch.enable_grad()
def fit_poses(
    meshes: Sequence[Mesh | Scene],
    target: Tensor | Sequence[Tensor],
    camera: Camera | Sequence[Camera],
    mask: Tensor | Sequence[Any] | None = None,
    init: Sequence[PoseFit | Tensor] | None = None,
    *,
    weight: Tensor | Sequence[Tensor] | None = None,
    depth: Tensor | Sequence[Tensor] | None = None,
    max_size: int = 256,
    steps: int = 40,
    spp: int = 16,
    tolerance: float = 3e-4,
    seed: int = 0,
    search: bool = True,
    progress: bool = True,
    callback: Callable[[list[PoseFit]], None] | None = None,
    symmetries: Sequence[Symmetries | None] | None = None,
) -> list[PoseFit]:
    """Find rotation and translation of several known meshes in a picture, or in several, in one fit; return a PoseFit for
    each.

    meshes      the objects, each a Mesh, or a Scene whose meshes move together, with colours or without
    target      (H, W, C) linear radiance, as read_image gives it; or a list of pictures
    camera      the camera of the picture, of size (H, W), or a list of them
    mask        where each object is seen, without what covers it: an image of labels (H, W) of integers, k + 1 where
                meshes[k] is seen and 0 elsewhere; or a list with a mask (H, W) for each mesh, as read_mask gives it. Of
                several pictures each of these is a list with one for each picture
    init        the pose of each mesh to start from, within some 15° and 5 % of its size: earlier fits, or matrices (4, 4),
                mesh to world, for column vectors; None: where the mesh files put them
    weight, depth, max_size, steps, spp, tolerance, seed, progress      as of fit_pose
    search      whether an object whose edges the pictures do not show at its end starts again from other poses
    callback    called after each step with the best fits so far
    symmetries  of each mesh, or None for one without; poses are reported as of fit_pose

    The fit includes which object stands in front: an object is compared where the others do not hide it, and contours at
    which one covers another move both. The light and the background need not be known, and something that is none of the
    meshes may cover a part of them. Each fit is `converged` and `explained` by itself; a wrong one does not make others
    wrong. `visible` is the share of an object that the others do not hide. Below a tenth, it is not `converged`, and `reason`
    says that it is hidden; its pose is then little more than its start. Neither is an object that ends inside another one, or
    whose pose the pictures do not show exactly, as of fit_pose.

    KeyboardInterrupt, also from the callback, ends the fit and returns the best so far with `interrupted` set. Raises
    TypeError or ValueError that names the argument, also where an object is out of the picture, or inside another one, at the
    start.
    """
    began = time.perf_counter()
    check_settings(max_size, steps, spp, seed, tolerance)
    check_callback(callback, "a list of PoseFits")
    count = _counted(meshes)
    starts = _starts(init, count)
    masks = _masks(mask, count, camera)
    known = _each("symmetries", symmetries, count)
    known_symmetries = [
        symmetries_of(one, mesh, f"symmetries[{k}]") for k, (one, mesh) in enumerate(zip(known, meshes, strict=True))
    ]
    tasks = [
        PoseTask.from_arguments(
            mesh, target, camera, own, weight, None, Unknowns(), float(start.scale),
            ArgumentNames(f"meshes[{k}]", init=f"init[{k}]", mask=f"mask[{k}]"),
        )
        for k, (mesh, own, start) in enumerate(zip(meshes, masks, starts, strict=True))
    ]  # fmt: skip
    depths = depth_images(depth, tasks[0])
    for task, start in zip(tasks, starts, strict=True):
        for shot in task.shots:
            check_in_front(task.names.init, shot.camera, start, task.center)
    _check_apart(tasks, starts)
    for task, start in zip(tasks, starts, strict=True):
        check_seen(task.names.init, task.scene, [shot.camera for shot in task.shots], start)
    moved = [mesh for task, start in zip(tasks, starts, strict=True) for mesh in _moved(task, start)]
    warn_of_units(Scene(moved), [shot.camera for shot in tasks[0].shots], depths, "at the start")
    state = PosesSearch(tasks, starts, depths, max_size, spp, steps, tolerance, seed, check_flag("search", search))
    cameras: list[Camera] = list(camera) if isinstance(camera, Sequence) else [camera]
    interrupted = False

    def results() -> list[PoseFit]:
        found = []
        for k, task in enumerate(tasks):
            own = known_symmetries[k]
            best = state.best[k] if own is None else state.best[k].closest(own, starts[k])
            history, information = list(state.history[k]), state.information(k)
            known = (
                None if information is None else Uncertainty.from_information(task, best, information, task.dofs, own)
            )
            unknown = known is not None and bool(known.unknown)
            conflict = _conflict(tasks, state.best, k) if information is not None else ""
            conflict = conflict or ("" if unknown else ambiguity(best, state.ambiguous[k], own, task))
            sure = state.converged[k] and not interrupted and not conflict and not unknown
            found.append(PoseFit(
                best.R, best.t, float(best.scale), cameras[0], state.loss, len(history), time.perf_counter() - began,
                sure, interrupted, state.edge_support[k], history, task, cameras, known, state.visible[k], conflict,
                state.needed[k],
            ))  # fmt: skip
        return found

    bar = tqdm(total=None, desc="fit", unit="step", disable=not progress, leave=False)

    def after_step() -> None:
        bar.set_postfix_str(
            f"{state.levels[-1].size[1]} × {state.levels[-1].size[0]} px, loss {state.loss:.2e}", refresh=False
        )
        bar.update()
        if callback is not None:
            callback(results())

    state.after_step = after_step
    try:
        state.run()
    except KeyboardInterrupt:
        interrupted = True
    finally:
        bar.close()
    return results()


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


def _masks(mask: object, count: int, camera: object) -> list[Any]:
    """Return, for each mesh, what fit_pose calls the mask. Raises TypeError or ValueError."""
    cameras: list[Any] = list(camera) if isinstance(camera, Sequence) else [camera]
    if hasattr(mask, "ndim"):
        labels = one_for_each("mask", mask, len(cameras), 2) if isinstance(camera, Sequence) else [mask]
    elif isinstance(camera, Sequence) and isinstance(mask, Sequence) and mask and all(map(_is_labels, mask)):
        labels = one_for_each("mask", mask, len(cameras), 2)
    else:
        found = _each("mask", mask, count)
        if 0 < (missing := sum(one is None for one in found)) < count:
            raise ValueError(f"mask: expected a mask for each mesh or for none, got {count - missing} of {count}")
        return found
    names = ["mask"] if not isinstance(camera, Sequence) else [f"mask[{k}]" for k in range(len(labels))]
    columns = [
        _of_labels(name, one, count, getattr(view, "size", None))
        for name, one, view in zip(names, labels, cameras, strict=True)
    ]
    return [list(row) for row in zip(*columns, strict=True)] if isinstance(camera, Sequence) else list(columns[0])


def _is_labels(given: object) -> bool:
    if not hasattr(given, "ndim"):
        return False
    value = as_tensor("mask", given)
    return not value.is_floating_point() and value.dtype != torch.bool


def _of_labels(name: str, labels: object, count: int, size: tuple[int, int] | None) -> list[Tensor]:
    """Return a mask for each mesh, for a camera of that size."""
    value = as_tensor(name, labels).detach().cpu()
    if not _is_labels(value):
        raise TypeError(
            f"{name}: expected an image of labels, of integers, or a list with a mask for each mesh, got {value.dtype}"
        )
    if size is not None:
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


def _inside(points: Tensor, mesh: Mesh) -> Tensor:
    """Return which points (n, 3) lie inside a closed mesh (n,); none lies inside an open one."""
    import trimesh  # This import takes longer than a step of a fit.

    low, high = mesh.verts.double().aminmax(dim=0)
    inside = ((points > low) & (points < high)).all(1)
    solid = trimesh.Trimesh(mesh.verts.numpy(), mesh.faces.numpy(), process=False)
    if not solid.is_watertight:
        return torch.zeros_like(inside)
    if bool(inside.any()):
        inside[inside.clone()] = torch.from_numpy(solid.contains(points[inside].numpy()))
    return inside


def _conflict(tasks: Sequence[PoseTask], poses: Sequence[Pose], k: int) -> str:
    """Return in words whether an object ends where another one is: at least half of its vertices, or of the other's, lie
    inside."""
    bodies = [_moved(task, pose) for task, pose in zip(tasks, poses, strict=True)]
    for other in range(len(bodies)):
        for a, b in ((k, other), (other, k)):
            if a == b:
                continue
            points = torch.cat([mesh.verts for mesh in bodies[a]]).double()
            some = points[:: max(1, len(points) // INSIDE)]
            # A little smaller, two coinciding objects are inside one another.
            some = some.mean(0) + INNER_SCALE * (some - some.mean(0))
            inside = torch.stack([_inside(some, mesh) for mesh in bodies[b]]).any(0)
            if float(inside.double().mean()) >= 0.5:
                return (
                    f"in one place: meshes[{k}] ends where meshes[{other}] does; leave one out, or start them elsewhere"
                )
    return ""


def _check_apart(tasks: Sequence[PoseTask], starts: Sequence[Pose]) -> None:
    """Raise ValueError where an object lies inside another one, or two coincide."""
    bodies = [_moved(task, start) for task, start in zip(tasks, starts, strict=True)]
    points = [torch.cat([mesh.verts for mesh in body]).double() for body in bodies]
    for k, own in enumerate(points):
        some = own[:: max(1, len(own) // INSIDE)]
        for other, body in enumerate(bodies):
            if other == k:
                continue
            if own.shape == points[other].shape and torch.allclose(own, points[other], atol=1e-6 * tasks[k].size):
                raise ValueError(
                    f"init[{k}]: expected the objects apart, got meshes[{k}] where meshes[{other}] is, vertex by vertex"
                )
            low, high = points[other].aminmax(dim=0)
            if not bool(((own > low) & (own < high)).all()):
                continue
            if any(bool(_inside(some, mesh).all()) for mesh in body):
                raise ValueError(
                    f"init[{k}]: expected the objects next to one another, got meshes[{k}] inside meshes[{other}], where no "
                    "camera sees it; move one of them, or leave it out"
                )
