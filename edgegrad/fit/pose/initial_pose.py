"""The pose at which a search starts when none is given."""

from __future__ import annotations

import torch
from torch import Tensor

from ..placement import Pose
from .inputs import depth_of
from .settings import CAMERA
from .task import PoseTask, focal_of

Box = tuple[Tensor, Tensor]  # opposite corners (2,), pixels


def initial_pose(task: PoseTask) -> Pose:
    """Return the mesh file's own pose if the first camera sees the object there and the mask agrees. Otherwise the object
    keeps the file's rotation and goes to the middle of the mask, as large as the mask, or of the picture."""
    own = Pose(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    camera, target = task.shots[0].camera, task.shots[0].target
    size = torch.tensor([camera.size[1], camera.size[0]], dtype=torch.float64)
    perspective = camera.projection != "orthographic"
    if camera.projection not in ("perspective", "orthographic"):
        return own  # A camera that sees all around has nothing out of view.
    wanted = None
    if "alpha" in task.aovs and not task.clutter and bool((target[..., -1] > 0.5).any()):
        first, last = (target[..., -1] > 0.5).nonzero().flip(1).aminmax(dim=0)
        wanted = first.double(), last.double() + 1.0
    if not perspective or float(depth_of(camera, own, task.center)) > 0.5 * task.size:
        seen = camera.project(torch.cat([mesh.verts for mesh in task.scene.meshes])).aminmax(dim=0)
        inside = bool((seen[1] > 0).all()) and bool((seen[0] < size).all())
        if inside and (wanted is None or _overlap(seen, wanted) > CAMERA.least_overlap):
            return own
    low, high = (0.0 * size, size) if wanted is None else wanted
    across = CAMERA.default_fill * float(size.min()) if wanted is None else float((high - low).max())
    # From a random side, a box is about 0.8 of its diagonal wide.
    depth = focal_of(camera) * 0.8 * task.size / max(across, 1.0) if perspective else 2.0 * task.size
    view, K = camera.world_to_camera, camera.K
    ray = torch.linalg.solve(K[:2, :2], 0.5 * (low + high) - K[:2, 2])
    q = torch.cat([ray * (depth if perspective else 1.0), ray.new_tensor([depth])])
    return own._replace(t=view[:3, :3].T @ (q - view[:3, 3]) - task.center)


def _overlap(a: Box, b: Box) -> float:
    """Return the intersection over union of two boxes."""
    both = (torch.minimum(a[1], b[1]) - torch.maximum(a[0], b[0])).clamp(min=0.0).prod()
    return float(both / ((a[1] - a[0]).prod() + (b[1] - b[0]).prod() - both))
