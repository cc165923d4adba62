"""The inside of a rendered surface, away from its contours: how its points move in the image, and the image's slope there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ....camera.camera import Camera
from ..jacobian import Motion

MIN_PIXEL_ALPHA = 0.98  # least alpha of an inner pixel and its neighbours
DIFFERENCE_STEP = 1e-4  # step of central differences, in units of a motion
AOVS = ("image", "alpha", "normal", "position", "depth")


@dataclass(frozen=True)
class SurfaceInterior:
    """The inside of a rendered surface."""

    camera: Camera
    channels: dict[str, Tensor]  # (h, w, c), of AOVS
    inside: Tensor  # (h, w) bool
    motion: Motion

    @staticmethod
    def from_channels(
        camera: Camera, channels: dict[str, Tensor], motion: Motion, visible: Tensor | None = None
    ) -> SurfaceInterior:
        """Return the interior; `visible` (h, w) is the surface's alpha where something else that is rendered may cover it."""
        alpha = channels["alpha"][..., 0]
        open_ = ((alpha if visible is None else visible) < MIN_PIXEL_ALPHA).float()
        return SurfaceInterior(camera, channels, F.max_pool2d(open_[None, None], 3, 1, 1)[0, 0] == 0.0, motion)

    @property
    def points(self) -> Tensor:
        """The points (N, 3) inside, float64 world coordinates."""
        return self.channels["position"][self.inside].double() / self.channels["alpha"][self.inside].double()

    def flow(self) -> Tensor:
        """Return the motion (D, N, 2) in the image of the N points inside, pixels; by central differences, for any lens."""
        points, camera = self.points, self.camera
        if camera.K.dtype != torch.float64:
            camera = camera.to(torch.float64)
        along = torch.eye(3, dtype=torch.float64)
        slopes = [_difference(lambda h, e=e: camera.project(points + h * e)) for e in along]
        found = torch.einsum("nij,dnj->dni", torch.stack(slopes, -1), self.motion.of_points(points))
        if self.motion.K is not None or self.motion.distortion is not None:
            lens = [
                _difference(lambda h, k=k: self._moved(camera, k, h).project(points)) for k in range(len(self.motion))
            ]
            found = found + torch.stack(lens)
        return found.nan_to_num(0.0, 0.0, 0.0).float()

    @property
    def normals(self) -> Tensor:
        """The unit normals (h, w, 3)."""
        return F.normalize(self.channels["normal"].float(), dim=-1, eps=1e-6)

    def _moved(self, camera: Camera, k: int, step: float) -> Camera:
        fields = {}
        if self.motion.K is not None:
            fields["K"] = camera.K + step * self.motion.K[k]
        if self.motion.distortion is not None and camera.distortion is not None:
            coefficients = F.pad(self.motion.distortion[k], (0, 8))[: len(camera.distortion)]
            fields["distortion"] = camera.distortion + step * coefficients
        return camera.replace(**fields) if fields else camera


def _difference(f: Callable[[float], Tensor]) -> Tensor:
    return (f(DIFFERENCE_STEP) - f(-DIFFERENCE_STEP)) / (2.0 * DIFFERENCE_STEP)


def slope(image: Tensor) -> Tensor:
    """Return central differences (2, n, h, w), by columns and rows, of images (n, h, w)."""
    p = F.pad(image[None], (1, 1, 1, 1), mode="replicate")[0]
    return 0.5 * torch.stack([p[:, 1:-1, 2:] - p[:, 1:-1, :-2], p[:, 2:, 1:-1] - p[:, :-2, 1:-1]])
