"""How exactly the pictures show a pose, from the curvature JᵀJ of the terms at the answer.

Each term is a log likelihood in units of its own noise, relative to how many pixels count as one. So JᵀJ is Fisher's
information, and its inverse the covariance that no unbiased estimate can undercut (Cramér and Rao, 1946). It is local: it does
not know of other poses that match the pictures as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ...scene.symmetries import Symmetries
from .pose import Pose
from .settings import CAMERA
from .task import FOCAL_LENGTH, ROTATION, SCALE, PoseTask


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Standard deviations of a pose about the object's centre, the middle of its bounding box.

    Attributes
    ----------
    covariance : (6, 6) float64, of a rotation vector in radians and a shift of the centre, world units and axes
        Entries that were not sought, such as the distance with scale=True, are zero. Where the focal length is sought, places
        are those at the one found, since distance goes with it.
    size : the diagonal of the object's bounding box, world units
    focal : relative to the focal length; 0 where it was not sought
    most : degrees up to which a rotation counts as known: 5, or 2 where only a contour is compared
    free : directions (n, 3) in the world
        About these a continuous symmetry makes all rotations the same; none of them is unknown.
    """

    covariance: Tensor
    size: float
    free: Tensor
    focal: float = 0.0
    most: float = CAMERA.most_degrees

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
        """Both standard deviations and their directions in the world, and the focal length's where it was sought."""
        parts = [f"±{self.degrees:.2g}° about {_named(self.axis)}", f"±{self.shift:.2g} along {_named(self.direction)}"]
        if self.focal > 0.0:
            parts.append(f"focal length ±{self.focal:.2g} of it")
        return ", ".join(parts)

    def to_dict(self) -> dict[str, Any]:
        """Return all numbers as JSON has them."""
        return {
            "degrees": self.degrees, "axis": self.axis.tolist(), "shift": self.shift, "direction": self.direction.tolist(),
            "covariance": self.covariance.tolist(), "size": self.size, "free": self.free.tolist(), "focal": self.focal,
            "most": self.most,
        }  # fmt: skip

    @staticmethod
    def from_dict(data: dict[str, Any]) -> Uncertainty:
        """Return what to_dict() described."""
        covariance = torch.tensor(data["covariance"], dtype=torch.float64).reshape(6, 6)
        free = torch.tensor(data["free"], dtype=torch.float64).reshape(-1, 3)
        return Uncertainty(covariance, float(data["size"]), free, float(data["focal"]), float(data["most"]))

    @property
    def unknown(self) -> str:
        """Return what is known less exactly than to `most` degrees, 5 % of the object's size, or 3 % of the focal length.

        It is in words, and empty where all are known.
        """
        parts = []
        if self.degrees > self.most:
            parts.append(f"rotation about {_named(self.axis)} known to ±{self.degrees:.0f}° only")
        if self.shift > CAMERA.most_shift * self.size:
            parts.append(
                f"place along {_named(self.direction)} known to ±{self.shift / self.size:.0%} of the size only"
            )
        if self.focal > CAMERA.most_focal:
            parts.append(f"focal length known to ±{self.focal:.0%} only")
        return ", ".join(parts)

    @property
    def _rotation(self) -> tuple[Tensor, Tensor]:
        block = self.covariance[:3, :3]
        if len(self.free):
            rest = torch.eye(3, dtype=torch.float64) - torch.linalg.pinv(self.free, rtol=1e-3) @ self.free
            block = rest @ block @ rest
        return _widest(block)

    @staticmethod
    def from_information(
        task: PoseTask, pose: Pose, information: Tensor, dofs: list[int], symmetries: Symmetries | None
    ) -> Uncertainty:
        """Return the uncertainty from the inverse covariance (n, n) of the entries `dofs` of a step."""
        prior = torch.eye(len(dofs), dtype=torch.float64) / CAMERA.prior_deviation**2
        inverse = torch.linalg.inv(information + prior)
        entries = torch.zeros(SCALE, SCALE, dtype=torch.float64)
        known = [k for k, entry in enumerate(dofs) if ROTATION <= entry < SCALE]
        rows = torch.tensor([dofs[k] for k in known])
        entries[rows[:, None], rows] = inverse[known][:, known]
        axes = task.shots[0].camera.world_to_camera[:3, :3].T.double()
        to_world = torch.block_diag(axes, task.size * axes)
        spins = [pose.R.double() @ axis.direction for axis in ([] if symmetries is None else symmetries.continuous)]
        spun = torch.stack(spins) if spins else torch.empty(0, 3, dtype=torch.float64)
        focal = (
            float(inverse[dofs.index(FOCAL_LENGTH), dofs.index(FOCAL_LENGTH)].sqrt()) if FOCAL_LENGTH in dofs else 0.0
        )
        most = CAMERA.most_contour_degrees if task.colorless else CAMERA.most_degrees
        return Uncertainty(to_world @ entries @ to_world.T, task.size, spun, focal, most)


def _widest(block: Tensor) -> tuple[Tensor, Tensor]:
    """Return the largest standard deviation and its direction (3,)."""
    values, vectors = torch.linalg.eigh(0.5 * (block + block.T))
    return values[-1].clamp(min=0.0).sqrt(), vectors[:, -1]


def _named(direction: Tensor) -> str:
    """Return the direction in words, with its largest entry above zero."""
    direction = direction * float(direction[direction.abs().argmax()].sign())
    return "({})".format(", ".join(f"{x:.2f}" for x in (direction + 0.0).tolist()))
