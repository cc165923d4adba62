"""A picture at one resolution, and a batch of renders that are compared with it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ....aovs import aovs_request, by_name, render_aovs
from ....camera.camera import Camera
from ....files.image import linear_to_srgb
from ....kernel.operators import forward_kernel, jvp_kernel
from ...contour_colors import mask_noise
from ...region import Palette
from ...views import area_mean
from ..camera_motion import MovingCameras
from ..task import PoseTask, TargetView

MASK_ERROR = 0.01  # probability that a mask's pixel is wrong
BOX_MARGIN = 2  # pixels around the vertices in the image
CONTOUR_MARGIN = 12  # pixels around a render: windows for the contour's colours reach as far


@dataclass(frozen=True)
class PictureLevel:
    """A picture at one resolution. `display` has sRGB values, in which noise, blur and compression are nearly uniform."""

    camera: Camera
    radiance: Tensor  # (C, h, w), linear; white is 1
    display: Tensor  # (C, h, w)
    mask: Tensor | None  # (h, w), 1 on the object
    weight: Tensor  # (h, w)
    depth: Tensor | None  # (h, w), NaN where it was not measured
    background: Tensor | None  # (C, h, w), sRGB values, where it is known
    palette: Palette
    labels: Tensor  # (h · w,), of the palette
    extent: float  # pixels across the object
    noise: float  # standard deviation of mixed pixels of `outlined` that is known: of a mask of zeros and ones

    @property
    def size(self) -> tuple[int, int]:
        return self.camera.size

    @property
    def outlined(self) -> Tensor:
        """The channels (c, h, w) that show the outline: the mask, or else the colours."""
        return self.display if self.mask is None else self.mask[None]

    @staticmethod
    def from_shot(
        shot: TargetView, depth: Tensor | None, masked: bool, size: tuple[int, int], extent: float, palette: Palette
    ) -> PictureLevel:  # fmt: skip
        """Return the picture of a shot with this size, which shows the object `extent` pixels large. `masked`: its last channel
        is a mask."""
        radiance, mask = area_mean(shot.target, size), None
        noise = 0.0
        if masked:
            radiance, mask = radiance[..., :-1], radiance[..., -1].clamp(MASK_ERROR, 1.0 - MASK_ERROR)
            noise = mask_noise(shot.target[..., -1], size[0] / shot.target.shape[0])
        display = linear_to_srgb(radiance.clamp(0.0, 1.0))
        behind = None
        if shot.background is not None and not masked:
            behind = shot.background
            behind = area_mean(behind, size) if behind.dim() == 3 else behind.expand(*size, -1)
            behind = linear_to_srgb(behind.clamp(0.0, 1.0)).movedim(-1, 0)
        weight = torch.ones(size, dtype=torch.float32) if shot.weight is None else area_mean(shot.weight, size)[..., 0]
        nearest = None if depth is None else F.interpolate(depth[None, None], size, mode="nearest-exact")[0, 0]
        labels = palette.labels(display if mask is None else mask[..., None])
        radiance, display = radiance.movedim(-1, 0).contiguous(), display.movedim(-1, 0).contiguous()
        return PictureLevel(
            shot.camera.resized(size), radiance, display, mask, weight, nearest, behind, palette, labels, extent, noise
        )

    def part(self, box: Box) -> PictureLevel:
        """Return what is compared in a box; camera and labels stay those of the whole."""
        names = ("radiance", "display", "mask", "weight", "depth", "background")
        values = {name: getattr(self, name) for name in names}
        return replace(self, **{name: None if x is None else box.cut(x) for name, x in values.items()})


class Box(NamedTuple):
    """Rows and columns of an image."""

    rows: slice
    columns: slice

    def cut(self, image: Tensor) -> Tensor:
        """Return the part of an image (…, h, w)."""
        return image[..., self.rows, self.columns]

    def grown(self, margin: int, size: tuple[int, int]) -> Box:
        """Return the box with a margin, inside an image of this size."""
        return Box(*(slice(max(0, s.start - margin), min(n, s.stop + margin)) for s, n in zip(self, size, strict=True)))

    def pasted(self, part: Tensor, whole: Box) -> Tensor:
        """Return what a larger box shows (…, h, w) of an image that is zero outside of this one."""
        left, top = self.columns.start - whole.columns.start, self.rows.start - whole.rows.start
        right, bottom = whole.columns.stop - self.columns.stop, whole.rows.stop - self.rows.stop
        return F.pad(part, (left, right, top, bottom))

    @staticmethod
    def around(task: PoseTask, camera: Camera) -> Box:
        """Return where a batch of cameras sees the task's meshes; all of the image where a lens may bend them out of it."""
        H, W = camera.size
        whole = Box(slice(0, H), slice(0, W))
        flat = camera.projection == "orthographic"
        if not flat and (camera.projection != "perspective" or camera.lens != "pinhole"):
            return whole
        verts, M = torch.cat([mesh.verts for mesh in task.scene.meshes]), camera.world_to_camera
        q = M[:, :3, :3] @ verts.T + M[:, :3, 3:]
        if not flat and float(q[:, 2].min()) <= 0.0:
            return whole
        u = camera.K[:, :2, :2] @ (q[:, :2] if flat else q[:, :2] / q[:, 2:]) + camera.K[:, :2, 2:]
        found = []
        for low, high, size in zip(u.amin((0, 2)).flip(0), u.amax((0, 2)).flip(0), (H, W), strict=True):
            first = min(max(0, int(low) - BOX_MARGIN), size - 1)
            found.append(slice(first, min(max(math.ceil(float(high)) + BOX_MARGIN, first + 1), size)))
        return Box(*found)


class RenderedPoses(NamedTuple):
    """Renders of N poses in a box of the image."""

    box: Box
    alpha: Tensor  # (N, h, w)
    tangents: Tensor  # (D, N, h, w), of alpha
    color: Tensor | None  # (N, C, h, w), times alpha
    normal: Tensor | None  # (N, 3, h, w), in mesh axes, times alpha
    position: Tensor | None  # (N, 3, h, w), of the mesh, times alpha

    @staticmethod
    def from_cameras(
        task: PoseTask, moving: MovingCameras, colored: bool, surface: bool, spp: int, seed: int
    ) -> RenderedPoses:
        """Render the silhouettes and their derivatives, and what they show of the `surface` and its colours."""
        names = ["alpha", *["image"] * colored, *["normal", "position"] * surface]
        size = moving.cameras.size
        box = Box.around(task, moving.cameras)
        cut = moving.crop(*box)
        with torch.no_grad():
            moves = len(cut.tangents["world_to_camera"])
            if colored and task.scene.is_shaded:
                seen = render_aovs(task.scene, cut.cameras, names, spp, seed)
                request = aovs_request(task.scene, cut.cameras, ["alpha"], spp, seed)
                hits = forward_kernel(request)[1] if moves else None
            else:
                request = aovs_request(task.scene, cut.cameras, names, spp, seed)
                image, hits, _ = forward_kernel(request)
                seen = by_name(task.scene, names, image)
                if len(names) > 1:  # The derivatives of the silhouette alone are cheaper.
                    request = aovs_request(task.scene, cut.cameras, ["alpha"], spp, seed)
            if moves:
                assert hits is not None
                tangents = jvp_kernel(hits, request, cut.tangents, moves)[..., 0].float()
            else:
                tangents = seen["alpha"][None, ..., 0].float()[:0]
        whole = box.grown(CONTOUR_MARGIN, size)

        def channel(name: str) -> Tensor | None:
            return box.pasted(seen[name].float().movedim(-1, 1), whole) if name in seen else None

        alpha = box.pasted(seen["alpha"][..., 0].float(), whole)
        slopes = box.pasted(tangents, whole)
        return RenderedPoses(whole, alpha, slopes, channel("image"), channel("normal"), channel("position"))
