"""The result of tracking an object in one frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor

from ..camera.poses import rigid

HALF_COVERED = 0.5  # visible share of the outline below which `reason` says so


@dataclass(frozen=True, eq=False)
class TrackedPose:
    """The pose of an object in one frame: `world = scale · R v + t`."""

    index: int  # number of the frame, from 0
    R: Tensor  # (3, 3) float64
    t: Tensor  # (3,) float64, world units
    scale: float  # as of `init`
    # (6, 6) float64, of a rotation vector about the centre of the object's box, radians, and of that centre's shift, world units.
    covariance: Tensor
    confidence: float  # calibrated probability that the pose is within 5° and 5 % of the object's size
    lost: bool  # The confidence is low; the pose is the last one that was likely.
    visible: float  # share of the object's outline that is in the frame, and that no other tracked object covers
    features: Mapping[str, float] = field(
        default_factory=dict, repr=False
    )  # of the frame, on which `confidence` depends

    @property
    def reason(self) -> str:
        """How well the pose is known, in words: "seen", or "lost: …" or "covered: …"."""
        if self.lost:
            return (
                f"lost: where the object was seen last; the frame shows it with a probability of {self.confidence:.0%}"
            )
        if self.visible < HALF_COVERED:
            return f"covered: {1.0 - self.visible:.0%} of the outline is behind another object"
        return "seen"

    @property
    def matrix(self) -> Tensor:
        """Mesh to world, (4, 4) float64, for column vectors: `scale · R` and `t`."""
        return rigid(self.scale * self.R, self.t)
