"""What is seen of a surface's inside, away from its contours: how its points move in the image, and the image's slope there."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ....camera.camera import Camera
from ..jacobian import Motion

COVERED = 0.98  # share of a pixel of the inside, and of its neighbours
STEP = 1e-4  # of differences, in units of a motion
AOVS = ("image", "alpha", "normal", "position", "depth")


@dataclass(frozen=True)
class Surface:
    """The inside of a rendered surface."""

    camera: Camera
    channels: dict[str, Tensor]  # (h, w, c), of AOVS
    inside: Tensor  # (h, w) bool
    motion: Motion

    @staticmethod
    def of(camera: Camera, channels: dict[str, Tensor], motion: Motion, visible: Tensor | None = None) -> Surface:
        """`visible` (h, w): the surface's alpha where something else that is rendered may cover it."""
        alpha = channels["alpha"][..., 0]
        open_ = ((alpha if visible is None else visible) < COVERED).float()
        return Surface(camera, channels, F.max_pool2d(open_[None, None], 3, 1, 1)[0, 0] == 0.0, motion)

    @property
    def points(self) -> Tensor:
        """(N, 3) float64, those inside, world coordinates."""
        return self.channels["position"][self.inside].double() / self.channels["alpha"][self.inside].double()

    def flow(self) -> Tensor:
        """(D, N, 2) how the N points inside move in the image by the motion, pixels; by central differences, for any lens."""
        points = self.points
        ways = self.motion.of_points(points)
        camera, found = self.camera.to(torch.float64), []
        for k, way in enumerate(ways):
            ends = [self._moved(camera, k, sign * STEP).project(points + sign * STEP * way) for sign in (1.0, -1.0)]
            found.append((ends[0] - ends[1]) / (2.0 * STEP))
        return torch.stack(found).nan_to_num(0.0, 0.0, 0.0).float()

    @property
    def normals(self) -> Tensor:
        """(h, w, 3), of length 1."""
        return F.normalize(self.channels["normal"].float(), dim=-1, eps=1e-6)

    def _moved(self, camera: Camera, k: int, step: float) -> Camera:
        fields = {}
        if self.motion.K is not None:
            fields["K"] = camera.K + step * self.motion.K[k]
        if self.motion.distortion is not None and camera.distortion is not None:
            bend = F.pad(self.motion.distortion[k], (0, 8))[: len(camera.distortion)]
            fields["distortion"] = camera.distortion + step * bend
        return camera.replace(**fields) if fields else camera


def slope(image: Tensor) -> Tensor:
    """(h, w, C, 2), by columns and rows, central differences per pixel."""
    padded = F.pad(image.movedim(-1, 0)[None], (1, 1, 1, 1), mode="replicate")[0].movedim(0, -1)
    return 0.5 * torch.stack([padded[1:-1, 2:] - padded[1:-1, :-2], padded[2:, 1:-1] - padded[:-2, 1:-1]], -1)
