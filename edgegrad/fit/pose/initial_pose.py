"""The pose at which a search starts when none is given."""

from __future__ import annotations

import torch
from torch import Tensor

from .inputs import depth_of
from .pose import Pose
from .settings import CAMERA
from .task import PoseTask, TargetView, focal_of


def initial_pose(task: PoseTask) -> Pose:
    """Return the mesh file's own pose if the first camera sees the object there and the mask agrees. Otherwise the object
    keeps the file's rotation and goes to the middle of the mask, as large as the mask, or of the picture."""
    one = torch.ones((), dtype=torch.float64)
    identity = Pose(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64), one, one)
    shot = task.shots[0]
    camera = shot.camera
    H, W = camera.size
    perspective = camera.projection != "orthographic"
    if camera.projection not in ("perspective", "orthographic"):
        return identity  # A camera that sees all around has nothing out of view.
    seen = _box(task, shot, identity) if not perspective or _before(task, shot, identity) else None
    wanted = _mask_box(shot) if "alpha" in task.aovs and not task.clutter else None
    if seen is not None:
        inside = bool((seen[1] > 0).all()) and bool((seen[0] < torch.tensor([W, H])).all())
        if inside and (wanted is None or _overlap(seen, wanted) > CAMERA.least_overlap):
            return identity
    if wanted is None:
        middle = torch.tensor([0.5 * W, 0.5 * H], dtype=torch.float64)
        across = CAMERA.default_fill * min(H, W)
    else:
        middle, across = (wanted[0] + wanted[1]) / 2, float((wanted[1] - wanted[0]).max())
    # From a random side, a box is about 0.8 of its diagonal wide.
    depth = focal_of(camera) * 0.8 * task.size / max(across, 1.0) if perspective else 2.0 * task.size
    view, K = camera.world_to_camera, camera.K
    ray = torch.linalg.solve(K[:2, :2], middle - K[:2, 2])
    q = torch.cat([ray * (depth if perspective else 1.0), ray.new_tensor([depth])])
    return identity._replace(t=view[:3, :3].T @ (q - view[:3, 3]) - task.center)


def _before(task: PoseTask, shot: TargetView, pose: Pose) -> bool:
    return float(depth_of(shot.camera, pose, task.center)) > 0.5 * task.size


def _box(task: PoseTask, shot: TargetView, pose: Pose) -> tuple[Tensor, Tensor]:
    """Return opposite corners (2,) of the object's box in the image, in pixels, without distortion."""
    verts = torch.cat([mesh.verts for mesh in task.scene.meshes])
    view, K = shot.camera.world_to_camera, shot.camera.K
    q = (verts @ pose.R.T + pose.t) @ view[:3, :3].T + view[:3, 3]
    flat = q[:, :2] if shot.camera.projection == "orthographic" else q[:, :2] / q[:, 2:].clamp(min=1e-3 * task.size)
    pixels = flat @ K[:2, :2].T + K[:2, 2]
    return pixels.amin(0), pixels.amax(0)


def _mask_box(shot: TargetView) -> tuple[Tensor, Tensor] | None:
    rows, columns = torch.nonzero(shot.target[..., -1] > 0.5, as_tuple=True)
    if not len(rows):
        return None
    low = torch.stack([columns.min(), rows.min()]).double()
    return low, torch.stack([columns.max(), rows.max()]).double() + 1.0


def _overlap(a: tuple[Tensor, Tensor], b: tuple[Tensor, Tensor]) -> float:
    """Return the intersection over union of two boxes."""
    both = (torch.minimum(a[1], b[1]) - torch.maximum(a[0], b[0])).clamp(min=0.0).prod()
    return float(both / ((a[1] - a[0]).prod() + (b[1] - b[0]).prod() - both))
