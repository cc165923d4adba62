"""How exactly the pictures show a pose: from the curvature JᵀJ of the terms at the answer.

Each term of a photograph is a log likelihood in units of its own noise, and residuals of colours as they are have the variance
that is found at the answer. So JᵀJ is Fisher's information, and its inverse the covariance that no unbiased estimate is below
(Cramér and Rao, 1946). It speaks of the place where the fit is: of another pose that looks alike it knows nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ...scene.symmetries import Symmetries
from .pose import Pose
from .task import GROW, TURN, ZOOM, PoseTask

WIDEST = 1.0  # radian and object size, the standard deviation of what the pictures do not show at all
# Shadows, blur and errors of the light model are alike in pixels nearby: errors of fits to lit pictures are so many times the
# standard deviations of independent pixels, as measured.
TOGETHER = 8.0
# A direction that is known less exactly than this, in degrees or object sizes, is unknown; so is a focal length, in parts of it.
DEGREES, SHARE, FOCAL = 5.0, 0.05, 0.03
ALONE_DEGREES = 2.0  # of a contour alone: those known to ± 2.2 … 5° were 2 … 8° off


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Standard deviations of a pose about the object's centre, the middle of its bounding box.

    covariance  (6, 6) float64, of a rotation vector in radians and a shift of the centre in world units, along the world's axes.
                What was not sought, such as the distance with fit_scale, has zeros. With a focal length that is sought, places
                are those at the one found: distance goes with it
    size        the diagonal of the object's bounding box, world units
    focal       of the focal length, as a part of it; 0 where it was not sought
    most        degrees of a rotation that counts as known: 5, and 2 where a contour is all that is compared
    free        directions in the world (n, 3) about which a continuous symmetry makes all turns the same: none of them is unknown
    """

    covariance: Tensor
    size: float
    free: Tensor
    focal: float = 0.0
    most: float = DEGREES

    @property
    def degrees(self) -> float:
        """Of the rotation about the axis about which it is known least."""
        return math.degrees(float(self._turn[0]))

    @property
    def axis(self) -> Tensor:
        """(3,) this axis, in the world, of length 1."""
        return self._turn[1]

    @property
    def shift(self) -> float:
        """Of the centre along the direction along which it is known least, world units."""
        return float(_widest(self.covariance[3:, 3:])[0])

    @property
    def direction(self) -> Tensor:
        """(3,) this direction, in the world, of length 1."""
        return _widest(self.covariance[3:, 3:])[1]

    @property
    def words(self) -> str:
        """Both standard deviations and their directions in the world, and that of a focal length that was sought."""
        parts = [
            f"±{self.degrees:.2g}° about {_named(self.axis)}",
            f"±{self.shift:.2g} along {_named(self.direction)}",
        ]
        if self.focal > 0.0:
            parts.append(f"focal length ±{self.focal:.2g} of it")
        return ", ".join(parts)

    def plain(self) -> dict[str, Any]:
        """All numbers, as JSON has them."""
        return {
            "degrees": self.degrees, "axis": self.axis.tolist(), "shift": self.shift, "direction": self.direction.tolist(),
            "covariance": self.covariance.tolist(), "size": self.size, "free": self.free.tolist(), "focal": self.focal,
            "most": self.most,
        }  # fmt: skip

    @staticmethod
    def from_plain(data: dict[str, Any]) -> Uncertainty:
        """From what plain() gave."""
        covariance = torch.tensor(data["covariance"], dtype=torch.float64).reshape(6, 6)
        free = torch.tensor(data["free"], dtype=torch.float64).reshape(-1, 3)
        return Uncertainty(covariance, float(data["size"]), free, float(data["focal"]), float(data["most"]))

    @property
    def unknown(self) -> str:
        """In words, what is known less exactly than to `most` degrees, 5 % of the object's size, or 3 % of the focal length;
        empty where all is."""
        parts = []
        if self.degrees > self.most:
            parts.append(f"rotation about {_named(self.axis)} known to ±{self.degrees:.0f}° only")
        if self.shift > SHARE * self.size:
            parts.append(
                f"place along {_named(self.direction)} known to ±{self.shift / self.size:.0%} of the size only"
            )
        if self.focal > FOCAL:
            parts.append(f"focal length known to ±{self.focal:.0%} only")
        return ", ".join(parts)

    @property
    def _turn(self) -> tuple[Tensor, Tensor]:
        block = self.covariance[:3, :3]
        if len(self.free):
            rest = torch.eye(3, dtype=torch.float64) - torch.linalg.pinv(self.free, rtol=1e-3) @ self.free
            block = rest @ block @ rest
        return _widest(block)

    @staticmethod
    def of(
        task: PoseTask, pose: Pose, curvature: Tensor, free: list[int], symmetries: Symmetries | None
    ) -> Uncertainty:
        """From JᵀJ (n, n) of the entries `free` of a step."""
        prior = torch.eye(len(free), dtype=torch.float64) / WIDEST**2
        inverse = torch.linalg.inv(curvature / TOGETHER**2 + prior)
        entries = torch.zeros(GROW, GROW, dtype=torch.float64)
        known = [k for k, entry in enumerate(free) if TURN <= entry < GROW]
        rows = torch.tensor([free[k] for k in known])
        entries[rows[:, None], rows] = inverse[known][:, known]
        axes = task.shots[0].camera.world_to_camera[:3, :3].T.double()
        to_world = torch.block_diag(axes, task.size * axes)
        ways = [pose.R.double() @ axis.direction for axis in ([] if symmetries is None else symmetries.continuous)]
        spun = torch.stack(ways) if ways else torch.empty(0, 3, dtype=torch.float64)
        focal = float(inverse[free.index(ZOOM), free.index(ZOOM)].sqrt()) if ZOOM in free else 0.0
        most = ALONE_DEGREES if task.colourless else DEGREES
        return Uncertainty(to_world @ entries @ to_world.T, task.size, spun, focal, most)


def _widest(block: Tensor) -> tuple[Tensor, Tensor]:
    """Standard deviation and direction (3,)."""
    values, vectors = torch.linalg.eigh(0.5 * (block + block.T))
    return values[-1].clamp(min=0.0).sqrt(), vectors[:, -1]


def _named(way: Tensor) -> str:
    """Its largest entry above zero."""
    way = way * float(way[way.abs().argmax()].sign())
    return "({})".format(", ".join(f"{x:.2f}" for x in (way + 0.0).tolist()))
