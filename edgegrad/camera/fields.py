"""The fields of a camera, and their checks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from ..check import LARGEST, as_tensor, check_finite, check_float, check_shape, values_visible
from .lens import COEFFICIENT_COUNTS, MOST_TURNS
from .poses import check_last_row, check_rotation, image_size

CameraT = TypeVar("CameraT", bound="CameraFields")


@dataclass(frozen=True, eq=False)
class CameraFields:
    """Fields that Camera has and its constructors make; see there."""

    world_to_camera: Tensor
    K: Tensor
    size: tuple[int, int]
    projection: str = "perspective"
    distortion: Tensor | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "world_to_camera", as_tensor("world_to_camera", self.world_to_camera, floating=True))
        object.__setattr__(self, "K", as_tensor("K", self.K, like=self.world_to_camera))
        for name in ("world_to_camera", "K"):
            check_float(name, getattr(self, name))
        check_shape("world_to_camera", self.world_to_camera, (4, 4), ("B", 4, 4))
        fix = "of a 4 × 4 projection to clip space take Camera.from_projection" if self.K.shape[-2:] == (4, 4) else ""
        check_shape("K", self.K, (3, 3), ("B", 3, 3), fix=fix)
        if self.K.dim() == self.world_to_camera.dim() == 3 and self.K.shape[0] != self.world_to_camera.shape[0]:
            raise ValueError(
                f"K: expected a batch of {self.world_to_camera.shape[0]} like world_to_camera, got {self.K.shape[0]}; "
                "give one K (3, 3) for all or as many as cameras"
            )
        object.__setattr__(self, "size", image_size(self.size))
        if self.projection not in tuple(COEFFICIENT_COUNTS):
            raise ValueError(
                f"projection: expected one of {', '.join(map(repr, COEFFICIENT_COUNTS))}, got {self.projection!r}"
            )
        if self.distortion is not None:
            distortion = as_tensor("distortion", self.distortion, like=self.K)
            if self.projection == "perspective" and distortion.dim() > 0:
                distortion = _without_zeros(distortion)
            object.__setattr__(self, "distortion", distortion)
            self._check_distortion(self.distortion)
        self._check_values()

    def _check_distortion(self, distortion: Tensor) -> None:
        counts = COEFFICIENT_COUNTS[self.projection]
        if not counts:
            article = "an" if self.projection == "orthographic" else "a"
            raise ValueError(
                f"distortion: expected None for {article} {self.projection} camera, got {tuple(distortion.shape)}"
            )
        check_float("distortion", distortion)
        check_shape("distortion", distortion, *((n,) for n in counts), *(("B", n) for n in counts))
        check_finite("distortion", distortion)
        for name, other in (("world_to_camera", self.world_to_camera), ("K", self.K)):
            if distortion.dim() == 2 and other.dim() == 3 and len(other) != len(distortion):
                raise ValueError(
                    f"distortion: expected a batch of {len(other)} like {name}, got {len(distortion)}; "
                    "give one for all or as many as cameras"
                )

    def _check_values(self) -> None:
        check_last_row("world_to_camera", self.world_to_camera, [0.0, 0.0, 0.0, 1.0])
        fix = "is it transposed? Of a projection to clip space take Camera.from_projection"
        check_last_row("K", self.K, [0.0, 0.0, 1.0], fix)
        check_rotation("world_to_camera", self.world_to_camera[..., :3, :3])
        if not values_visible(self.K):
            return
        A = self.K.detach().double()[..., :2, :2]
        # The inverse of [[a, b], [c, d]] has the same numbers, over the determinant.
        inverse = A.abs().amax((-2, -1)) / torch.linalg.det(A).abs()
        if not bool((inverse <= LARGEST).all()):
            raise ValueError(
                "K: expected focal lengths that are not zero, got a singular matrix"
                + (f" (its inverse reaches {float(inverse.max()):.3g})" if bool(torch.isfinite(inverse).all()) else "")
                + "; give a focal length in pixels to each axis"
            )
        if self.projection == "panorama":
            self._check_turns()

    def _check_turns(self) -> None:
        """Check how often a panorama reaches around, because the kernel draws it once for each turn."""
        H, W = self.size
        K = self.K.detach().double().reshape(-1, 3, 3)
        around = [[x, y] for x in (-1.0, W + 1.0) for y in (-1.0, H + 1.0)]
        corners = torch.tensor(around, dtype=K.dtype, device=K.device)
        angles = torch.linalg.solve(K[:, None, :2, :2], (corners - K[:, None, :2, 2])[..., None])
        turns = float(angles.abs().max()) / math.tau
        if not turns <= MOST_TURNS:
            raise ValueError(
                f"K: expected a panorama that reaches no more than {MOST_TURNS} turns from its axis, got {turns:.4g}; "
                "K is in pixels a radian: width / 2π for all around, height / π from pole to pole"
            )


def _without_zeros(distortion: Tensor) -> Tensor:
    """Return the first eight of OpenCV's 12 or 14 coefficients, where the others are zero. Raises ValueError where they are
    not."""
    count, most = distortion.shape[-1], max(COEFFICIENT_COUNTS["perspective"])
    if count not in (12, 14):
        return distortion
    if not values_visible(distortion):
        raise ValueError(
            f"distortion: expected 4, 5 or 8 coefficients in a transform of torch, got {count}; leave out the zeros"
        )
    thin_prism, tilt = distortion.detach()[..., most:12], distortion.detach()[..., 12:]
    if not bool(thin_prism.any() or tilt.any()):
        return distortion[..., :most]
    which = "a thin prism (s1 to s4)" if bool(thin_prism.any()) else "a tilt of the sensor (τx, τy)"
    raise ValueError(
        f"distortion: expected OpenCV's 4, 5 or 8 coefficients, or zeros after them, got {count} with {which}; calibrate "
        "without cv2.CALIB_THIN_PRISM_MODEL and cv2.CALIB_TILTED_MODEL, or undistort the images with cv2.undistort and leave "
        "the distortion out"
    )
