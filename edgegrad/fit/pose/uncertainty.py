"""How exactly the pictures show a pose, and a lens, from the curvature JᵀJ of the terms at the answer.

Each term is a log likelihood in units of its own noise, relative to how many pixels count as one. So JᵀJ is Fisher's
information, and its inverse the covariance that no unbiased estimate can undercut (Cramér and Rao, 1946). It is local: it does
not know of other poses that match the pictures as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ...camera.camera import Camera
from ...camera.lens import MOST_COEFFICIENTS, distort
from ...scene.symmetries import Symmetries
from ..placement import Pose
from .camera_motion import moving_cameras
from .settings import CAMERA
from .task import DISTORTION, FOCAL_LENGTH, PRINCIPAL, SCALE, PoseTask, focal_of

# Coefficients of distortion, in OpenCV's order; those of a fisheye are k1 … k4.
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
NOT_SOUGHT = torch.zeros(2, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Standard deviations of a pose about the object's centre, the middle of its bounding box, and of a lens.

    Attributes
    ----------
    covariance : (6, 6) float64, of a rotation vector in radians and a shift of the centre, world units and axes
        With the lens unknown, too, where it was sought: distance goes with the focal length. Entries that were not sought, such
        as the distance with scale=True, are zero. Of a camera it is the scene that moves before it.
    size : the diagonal of the object's bounding box, world units
    free : directions (n, 3) in the world
        About these a continuous symmetry makes all rotations the same; none of them is unknown.
    focal : relative to the focal length; 0 where it was not sought
    most : degrees up to which a rotation counts as known: 5, or 2 where only a contour is compared
    principal : (2,) of the principal point, pixels; zeros where it was not sought
    distortion : (n,) of the coefficients of distortion that were sought, in the order of Camera.distortion
    """

    covariance: Tensor
    size: float
    free: Tensor
    focal: float = 0.0
    most: float = CAMERA.most_degrees
    principal: Tensor = NOT_SOUGHT
    distortion: Tensor = NOT_SOUGHT[:0]
    names: Sequence[str] = ()  # of these coefficients
    vague: Sequence[str] = ()  # unknown numbers of the lens, in words
    at_lens: Tensor | None = None  # (6, 6), the covariance at the lens found
    of_camera: bool = False  # whether the pose is a camera's

    @property
    def degrees(self) -> float:
        """Return the deviation of the rotation about the axis about which it is known least."""
        return math.degrees(float(self._rotation[0]))

    @property
    def axis(self) -> Tensor:
        """Return the axis (3,) of this rotation, in the world, of length 1."""
        return self._rotation[1]

    @property
    def shift(self) -> float:
        """Return the deviation of the centre along the direction in which it is known least, world units."""
        return float(_widest(self.covariance[3:, 3:])[0])

    @property
    def direction(self) -> Tensor:
        """Return the direction (3,) of this shift, in the world, of length 1."""
        return _widest(self.covariance[3:, 3:])[1]

    @property
    def words(self) -> str:
        """The standard deviations, and the directions of the pose's in the world, of all that was sought."""
        parts = [f"±{self.degrees:.2g}° about {_named(self.axis)}", f"±{self.shift:.2g} along {_named(self.direction)}"]
        if self.focal > 0.0:
            parts.append(f"focal length ±{self.focal:.2g} of it")
        if self.principal.any():
            parts.append("principal point ±{:.2g}, ±{:.2g} px".format(*self.principal.tolist()))
        parts += [f"{name} ±{value:.2g}" for name, value in zip(self.names, self.distortion.tolist(), strict=True)]
        return ", ".join(parts)

    def to_dict(self) -> dict[str, Any]:
        """Return all numbers as JSON has them."""
        return {
            "degrees": self.degrees, "axis": self.axis.tolist(), "shift": self.shift, "direction": self.direction.tolist(),
            "covariance": self.covariance.tolist(), "size": self.size, "free": self.free.tolist(), "focal": self.focal,
            "most": self.most, "at_lens": None if self.at_lens is None else self.at_lens.tolist(),
        }  # fmt: skip

    @staticmethod
    def from_dict(data: dict[str, Any]) -> Uncertainty:
        """Return what to_dict() described."""
        covariance = torch.tensor(data["covariance"], dtype=torch.float64).reshape(6, 6)
        free = torch.tensor(data["free"], dtype=torch.float64).reshape(-1, 3)
        at_lens = data.get("at_lens")
        at_lens = None if at_lens is None else torch.tensor(at_lens, dtype=torch.float64).reshape(6, 6)
        return Uncertainty(
            covariance, float(data["size"]), free, float(data["focal"]), float(data["most"]), at_lens=at_lens
        )

    @property
    def unknown(self) -> str:
        """Return what is known less exactly than to `most` degrees, 5 % of the object's size, or 3 % of the focal length.

        It is in words, and empty where all are known. The pose counts at the lens found. Other numbers of a camera are unknown
        where they move a corner of the image by more than 3 % of its distance from the principal point, or where a guess says as
        much as the pictures.
        """
        own, parts = self if self.at_lens is None else replace(self, covariance=self.at_lens), []
        if own.degrees > self.most:
            parts.append(f"rotation about {_named(own.axis)} known to ±{own.degrees:.0f}° only")
        if own.shift > CAMERA.most_shift * self.size:
            parts.append(f"place along {_named(own.direction)} known to ±{own.shift / self.size:.0%} of the size only")
        return ", ".join([*parts, *self.vague])

    @property
    def _rotation(self) -> tuple[Tensor, Tensor]:
        block = self.covariance[:3, :3]
        if len(self.free):
            rest = torch.eye(3, dtype=torch.float64) - torch.linalg.pinv(self.free, rtol=1e-3) @ self.free
            block = rest @ block @ rest
        return _widest(block)

    @staticmethod
    def from_information(
        task: PoseTask, pose: Pose, information: Tensor, symmetries: Symmetries | None = None
    ) -> Uncertainty:
        """Return the uncertainty of a pose from the inverse covariance (n, n) of the sought entries of a step."""
        prior = torch.eye(len(information), dtype=torch.float64) / CAMERA.prior_deviation**2
        known = Uncertainty.from_covariance(task, pose, torch.linalg.inv(information + prior))
        assert known.at_lens is not None
        world = torch.block_diag(pose.R, pose.scale * pose.R)
        spins = [pose.R @ axis.direction for axis in ([] if symmetries is None else symmetries.continuous)]
        free = torch.stack(spins) if spins else known.free
        whole, at_lens = (world @ one @ world.T for one in (known.covariance, known.at_lens))
        return replace(
            known, covariance=whole, free=free, at_lens=at_lens if known.focal > 0.0 else None, of_camera=False
        )

    @staticmethod
    def from_covariance(task: PoseTask, pose: Pose, covariance: Tensor) -> Uncertainty:
        """Return the uncertainty of a camera from the covariance (n, n) of the sought entries of a step."""
        dofs, first = task.dofs, task.shots[0].camera
        camera = task.lens(first, pose)
        # The camera that sees the scene at rest; its motion in the scene's axes is about the scene's centre.
        moving = moving_cameras(task, first, [pose], dofs)
        view, dW = moving.cameras.world_to_camera[0, :3, :3], moving.tangents["world_to_camera"][:, 0, :3]
        turn, shift = view.T @ dW[:, :, :3], (dW[:, :, :3] @ task.center + dW[:, :, 3]) @ view
        to_world = torch.cat([torch.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]]), shift.T])
        of_pose = [k for k, entry in enumerate(dofs) if entry < SCALE]
        own = to_world[:, of_pose]
        deviations = dict(zip(dofs, covariance.diagonal().clamp(min=0.0).sqrt().tolist(), strict=True))
        bent = [entry for entry in dofs if entry >= DISTORTION]
        pixels = [camera.size[1] * deviations.get(PRINCIPAL + k, 0.0) for k in (0, 1)]
        return Uncertainty(
            to_world @ covariance @ to_world.T, task.size, torch.empty(0, 3, dtype=torch.float64),
            deviations.get(FOCAL_LENGTH, 0.0), CAMERA.most_contour_degrees if task.colorless else CAMERA.most_degrees,
            torch.tensor(pixels, dtype=torch.float64),
            torch.tensor([deviations[entry] for entry in bent], dtype=torch.float64),
            [coefficient(camera, entry) for entry in bent], vague(camera, deviations),
            own @ covariance[of_pose][:, of_pose] @ own.T, True,
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


def _widest(block: Tensor) -> tuple[Tensor, Tensor]:
    """Return the largest standard deviation and its direction (3,)."""
    values, vectors = torch.linalg.eigh(0.5 * (block + block.T))
    return values[-1].clamp(min=0.0).sqrt(), vectors[:, -1]


def _named(direction: Tensor) -> str:
    """Return the direction in words, with its largest entry above zero."""
    direction = direction * float(direction[direction.abs().argmax()].sign())
    return "({})".format(", ".join(f"{x:.2f}" for x in (direction + 0.0).tolist()))
