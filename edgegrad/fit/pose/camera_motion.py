"""Poses in batches: the cameras that see the mesh at rest as one camera sees it at each pose, and how they move with a step.

An object with its lights that moves before a camera has the image of one at rest before a moving camera. So N poses are one
scene and a batch of N cameras, and derivatives are those by the cameras' tensors. A scale s moves the camera to R p + t / s,
from where the image is the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...camera.camera import Camera
from ..placement import Pose
from .task import DISTORTION, FOCAL_LENGTH, PRINCIPAL, ROTATION, SCALE, STEP_SIZE, TRANSLATION, PoseTask, focal_of

F64 = torch.float64
DIFFERENCE = 1e-4  # step of central differences, relative to the distance of the points


def cross_matrices(vectors: Tensor) -> Tensor:
    """Return the matrices (n, 3, 3) of ω × for vectors (n, 3)."""
    basis = torch.eye(3, dtype=F64)
    return torch.linalg.cross(vectors[:, None], basis[None], dim=-1).transpose(1, 2)


def stacked(poses: Sequence[Pose]) -> Pose:
    """Return poses as one whose fields have one more dimension."""
    return Pose(*(torch.stack(column) for column in zip(*poses, strict=True)))


def moved_poses(task: PoseTask, poses: Sequence[Pose], dofs: Sequence[int], steps: Tensor) -> list[Pose]:
    """Return the poses after steps (N, D) whose entries are `dofs`."""
    pose, camera = stacked(poses), task.shots[0].camera
    step = steps.new_zeros(len(steps), STEP_SIZE)
    step[:, list(dofs)] = steps
    view = camera.world_to_camera.double()
    V, v = view[:3, :3], view[:3, 3]
    R = torch.linalg.matrix_exp(cross_matrices(step[:, ROTATION:TRANSLATION] @ V)) @ pose.R
    center = pose.scale[:, None] * (pose.R @ task.center) + pose.t
    seen = center @ V.T + v + task.size * step[:, TRANSLATION:SCALE]
    zoom, scale = step[:, FOCAL_LENGTH].exp(), pose.scale * step[:, SCALE].exp()
    if camera.projection != "orthographic":
        if PRINCIPAL in dofs:
            aside = step[:, PRINCIPAL:DISTORTION] * camera.size[1] / focal_of(camera) / pose.focal[:, None]
            seen = torch.cat([seen[:, :2] - aside * seen[:, 2:], seen[:, 2:]], 1)
        if FOCAL_LENGTH in dofs and SCALE in dofs:
            scale = scale / zoom
        elif FOCAL_LENGTH in dofs:
            seen = torch.cat([seen[:, :2], seen[:, 2:] * zoom[:, None]], 1)
    t = (seen - v) @ V - scale[:, None] * (R @ task.center)
    principal, distortion = pose.principal + step[:, PRINCIPAL:DISTORTION], pose.distortion + step[:, DISTORTION:]
    return [
        Pose(*parts)
        for parts in zip(*Pose(R, t, scale, pose.focal * zoom, principal, distortion), strict=True)  # unstacked
    ]


class MovingCameras(NamedTuple):
    """A batch of N cameras, and the derivatives (D, N, …) of its tensors by the entries of a step."""

    cameras: Camera
    tangents: dict[str, Tensor]

    def crop(self, rows: slice, columns: slice) -> MovingCameras:
        """Return the cameras of a part of the image."""
        size = rows.stop - rows.start, columns.stop - columns.start
        return self._replace(cameras=self.cameras.crop(rows.start, columns.start, *size))

    def flow(self, points: Tensor) -> Tensor:
        """Return how points (N, 3, h, w) of the mesh move in the image (D, N, 2, h, w), pixels."""
        camera, dW = self.cameras, self.tangents["world_to_camera"]
        N, D, size = len(points), len(dW), points.shape[2:]
        bent = camera.projection != "orthographic" and camera.lens != "pinhole"
        real = F64 if bent else torch.float32  # Differences for the lens need digits.
        p, W, dW = points.to(real).flatten(2), camera.world_to_camera.to(real), dW.to(real)
        q = W[:, :3, :3] @ p + W[:, :3, 3:]  # (N, 3, M)
        dq = dW[..., :3, :3] @ p + dW[..., :3, 3:]  # (D, N, 3, M)
        if camera.projection == "orthographic":
            n, dn = q[:, :2], dq[:, :, :2]
        elif camera.lens == "pinhole":
            n = q[:, :2] / q[:, 2:]
            dn = (dq[:, :, :2] - n * dq[:, :, 2:]) / q[:, 2:]
        else:
            n, dn = self._through_lens(q, dq)
        K = camera.K.to(real)
        moved = K[:, :2, :2] @ dn
        if (dK := self.tangents.get("K")) is not None:
            dK = dK.to(real)
            moved = moved + dK[..., :2, :2] @ n + dK[..., :2, 2:]
        return moved.nan_to_num(0.0, 0.0, 0.0).float().reshape(D, N, 2, *size)

    def _through_lens(self, q: Tensor, dq: Tensor) -> tuple[Tensor, Tensor]:
        """Return normalised coordinates (N, 2, M) of points (N, 3, M) before the cameras, and their derivatives (D, N, 2, M), by
        central differences, for any lens."""
        unit, bend = torch.eye(3, dtype=F64), self.tangents.get("distortion")
        places, motions = [], []
        for k, points in enumerate(q.mT):
            # A panorama may not reach around many times, so the image is small where its pixels are large.
            camera = self.cameras[k].replace(world_to_camera=torch.eye(4, dtype=F64), K=unit, size=(1, 1))
            h = DIFFERENCE * float(points.norm(dim=1).mean())
            sides = [(camera.project(points + h * e), camera.project(points - h * e)) for e in unit]
            slopes = torch.stack([(ahead - behind) / (2.0 * h) for ahead, behind in sides], -1)  # (M, 2, 3)
            motion = torch.einsum("mij,djm->dim", slopes, dq[:, k])
            for d in range(0 if bend is None or camera.distortion is None else len(dq)):
                assert bend is not None and camera.distortion is not None
                way = DIFFERENCE * bend[d, k][: len(camera.distortion)]
                if bool(way.any()):
                    ends = (camera.replace(distortion=camera.distortion + s * way).project(points) for s in (1.0, -1.0))
                    ahead, behind = ends
                    motion[d] += ((ahead - behind) / (2.0 * DIFFERENCE)).T
            places.append(camera.project(points).T)
            motions.append(motion)
        return torch.stack(places), torch.stack(motions, 1)


def moving_cameras(task: PoseTask, camera: Camera, poses: Sequence[Pose], dofs: Sequence[int]) -> MovingCameras:
    """Return the cameras that see the task's scene at rest as `camera` sees it at the poses; derivatives are by `dofs`.

    A step rotates the world about the object's centre c by ω, scales it by σ about c, and shifts it by β. In camera axes a
    point R p + τ then moves by ω × (R p + τ) + dτ, where dτ = −ω × c − σ c + β, all lengths relative to the scale. Scaling
    about the eye does not change the image.
    """
    pose, first = stacked(poses), task.shots[0].camera
    N, perspective = len(poses), first.projection != "orthographic"
    view, own = first.world_to_camera.double(), camera.world_to_camera.double()
    axes, V, v = view[:3, :3], own[:3, :3], own[:3, 3]
    center = pose.scale[:, None] * (pose.R @ task.center) + pose.t  # (N, 3)
    depth = center @ axes[2] + view[2, 3]
    omega, sigma = torch.zeros(STEP_SIZE, 3, dtype=F64), torch.zeros(STEP_SIZE, 1, 1, dtype=F64)
    shift, K = torch.zeros(STEP_SIZE, N, 3, dtype=F64), torch.zeros(STEP_SIZE, N, 3, 3, dtype=F64)
    omega[ROTATION:TRANSLATION], sigma[SCALE] = axes, 1.0
    shift[TRANSLATION:SCALE] = task.size * axes[:, None]
    if perspective and SCALE in dofs:
        sigma[FOCAL_LENGTH] = -1.0
    elif perspective:
        shift[FOCAL_LENGTH] = depth[:, None] * axes[2]
    for axis in (0, 1):
        K[PRINCIPAL + axis, :, axis, 2] = camera.size[1]
        if perspective:
            shift[PRINCIPAL + axis] = -(first.size[1] / focal_of(first) / pose.focal * depth)[:, None] * axes[axis]
    lenses = [task.lens(camera, one) for one in poses]
    kept, scale = torch.tensor(list(dofs), dtype=torch.int64), pose.scale[:, None]
    R, tau = V @ pose.R, (pose.t @ V.T + v) / scale
    middle = (center @ V.T + v) / scale
    turn = cross_matrices(omega[kept] @ V.T)  # (D, 3, 3)
    dtau = torch.einsum("dij,nj->dni", turn, tau - middle) - sigma[kept] * middle + (shift[kept] @ V.T) / scale
    of_K = torch.stack([lens.K.double() for lens in lenses])
    if not perspective:  # Pixels a world unit grow with the scale.
        zoom = torch.cat([scale.expand(-1, 2), torch.ones_like(scale)], 1)[..., None]
        of_K = torch.cat([of_K[..., :2] * zoom, of_K[..., 2:]], -1)
        K[SCALE, :, :2, :2] = of_K[:, :2, :2]
    K[FOCAL_LENGTH, :, :2, :2] = of_K[:, :2, :2]
    world, dW = torch.zeros(N, 4, 4, dtype=F64), torch.zeros(len(kept), N, 4, 4, dtype=F64)
    world[:, :3, :3], world[:, :3, 3], world[:, 3, 3] = R, tau, 1.0
    dW[..., :3, :3], dW[..., :3, 3] = turn[:, None] @ R, dtau
    tangents, fields = {"world_to_camera": dW}, dict[str, Any]()
    if bool(K[kept].any()):
        tangents["K"] = K[kept]
    if lenses[0].distortion is not None:
        fields["distortion"] = torch.stack([lens.coefficients.double() for lens in lenses])
        if bool((kept >= DISTORTION).any()):
            unit = torch.eye(STEP_SIZE, dtype=F64)[kept][:, DISTORTION:]
            tangents["distortion"] = unit[:, None].expand(-1, N, -1)
    return MovingCameras(Camera(world, of_K, camera.size, camera.projection, **fields), tangents)
