"""How exactly pictures show a camera: its pose, and each number of its lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...camera.camera import Camera
from ...camera.lens import MOST_COEFFICIENTS, distort
from .camera_motion import moving_cameras
from .pose import Pose
from .settings import CAMERA
from .task import DISTORTION, FOCAL_LENGTH, PRINCIPAL, PoseTask, focal_of
from .uncertainty import Uncertainty

# Coefficients of distortion, in OpenCV's order; those of a fisheye are k1 … k4.
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraUncertainty(Uncertainty):
    """Standard deviations of a camera's pose and lens, each with all other numbers unknown, too.

    Attributes
    ----------
    covariance : (6, 6) float64, of a rotation vector in radians and a shift in world units along the world's axes
        Of the scene before the camera, about the middle of the scene's bounding box, where the scene was given.
    size : the diagonal of this box, world units
    focal : relative to the focal length; 0 where it was not sought
    principal : (2,) of the principal point, pixels; zeros where it was not sought
    distortion : (n,) of the coefficients of distortion that were sought, in the order of Camera.distortion
    """

    principal: Tensor
    distortion: Tensor
    names: Sequence[str]  # of these coefficients
    vague: Sequence[str]  # unknown numbers of the lens, in words
    at_lens: Tensor  # (6, 6), the covariance at the lens found

    @property
    def unknown(self) -> str:
        """Return what is known less exactly than to 5°, or 5 % of the scene's size with the lens as it was found.

        It is empty where all are known. A number of the lens is named where its deviation moves a corner of the image by more
        than 3 % of its distance from the principal point, or where a guess says as much as the pictures.
        """
        pose = Uncertainty(self.at_lens, self.size, self.free, most=self.most).unknown
        return ", ".join([pose, *self.vague] if pose else self.vague)

    @property
    def words(self) -> str:
        """Return the standard deviations of the pose, and of each number of the lens that was sought."""
        parts = [super().words]
        if self.principal.any():
            parts.append("principal point ±{:.2g}, ±{:.2g} px".format(*self.principal.tolist()))
        parts += [f"{name} ±{value:.2g}" for name, value in zip(self.names, self.distortion.tolist(), strict=True)]
        return ", ".join(parts)

    @staticmethod
    def from_covariance(task: PoseTask, pose: Pose, covariance: Tensor) -> CameraUncertainty:
        """Return the uncertainty from the covariance (m, m) of the entries of a step that the task seeks."""
        dofs, first = task.dofs, task.shots[0].camera
        camera = task.lens(first, pose)
        # The camera that sees the scene at rest; its motion in the scene's axes is about the scene's centre.
        moving = moving_cameras(task, first, [pose], dofs)
        view, dW = moving.cameras.world_to_camera[0, :3, :3], moving.tangents["world_to_camera"][:, 0, :3]
        turn, shift = view.T @ dW[:, :, :3], (dW[:, :, :3] @ task.center + dW[:, :, 3]) @ view
        to_world = torch.cat([torch.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]]), shift.T])
        of_pose = [k for k, entry in enumerate(dofs) if entry < FOCAL_LENGTH]
        own = to_world[:, of_pose]
        deviations = dict(zip(dofs, covariance.diagonal().clamp(min=0.0).sqrt().tolist(), strict=True))
        bent = [entry for entry in dofs if entry >= DISTORTION]
        pixels = [camera.size[1] * deviations.get(PRINCIPAL + k, 0.0) for k in (0, 1)]
        return CameraUncertainty(
            to_world @ covariance @ to_world.T, task.size, torch.empty(0, 3, dtype=torch.float64),
            deviations.get(FOCAL_LENGTH, 0.0), CAMERA.most_contour_degrees if task.colorless else CAMERA.most_degrees,
            principal=torch.tensor(pixels, dtype=torch.float64),
            distortion=torch.tensor([deviations[entry] for entry in bent], dtype=torch.float64),
            names=[coefficient(camera, entry) for entry in bent], vague=vague(camera, deviations),
            at_lens=own @ covariance[of_pose][:, of_pose] @ own.T,
        )  # fmt: skip


def coefficient(camera: Camera, entry: int) -> str:
    """Return the name of a coefficient of distortion, by the entry of a step that moves it."""
    return f"k{entry - DISTORTION + 1}" if camera.projection == "fisheye" else COEFFICIENTS[entry - DISTORTION]


def vague(camera: Camera, deviations: dict[int, float]) -> list[str]:
    """Return the unknown numbers of a lens in words, from the standard deviations of the entries of a step."""
    found = []
    for entry, deviation in deviations.items():
        if entry < FOCAL_LENGTH:
            continue
        share = deviation * reach(camera, entry)
        # Where the prior says more than the pictures, the deviation exceeds √½ of CAMERA.prior_deviation.
        if share <= CAMERA.most_focal and deviation**2 <= 0.5 * CAMERA.prior_deviation**2:
            continue
        if entry == FOCAL_LENGTH:
            found.append(f"focal length known to ±{deviation:.0%} only")
        elif entry < DISTORTION:
            found.append(
                f"principal point known to ±{deviation * camera.size[1]:.2g} pixels in {'xy'[entry - PRINCIPAL]} only"
            )
        else:
            found.append(
                f"{coefficient(camera, entry)} known to ±{deviation:.2g} only, {share:.0%} at the corners of the image"
            )
    return found


def reach(camera: Camera, entry: int) -> float:
    """Return how far a unit of an entry of the lens moves the corner of the image that moves most, relative to its
    distance from the principal point."""
    H, W = camera.size
    K = camera.K.detach().double()
    corners = torch.tensor([[x, y] for x in (0.0, W) for y in (0.0, H)], dtype=torch.float64) - K[:2, 2]
    distance = corners.norm(dim=1)
    if entry == FOCAL_LENGTH:
        return 1.0
    if entry < DISTORTION:
        return float((W / distance).max())
    n = torch.linalg.solve(K[:2, :2], corners.T).T
    ahead = torch.ones(len(n), 1, dtype=torch.float64)
    if camera.projection == "fisheye":
        angle = n.norm(dim=1, keepdim=True)
        n, ahead = n / angle * torch.sin(angle), torch.cos(angle)
    q = torch.cat([n, ahead], 1)
    count = MOST_COEFFICIENTS if camera.projection == "perspective" else 4
    unit = torch.zeros(count, dtype=torch.float64)
    unit[entry - DISTORTION] = 1e-3
    moved = (distort(camera.projection, q, unit) - distort(camera.projection, q, 0.0 * unit)) / 1e-3
    return float((focal_of(camera) * moved.norm(dim=1) / distance).max())
