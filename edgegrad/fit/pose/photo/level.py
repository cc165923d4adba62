"""What is compared at one resolution of a photograph, and the normal equations of a step there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from ....aovs import render_aovs
from ....camera.camera import Camera
from ....files.image import linear_to_srgb
from ....scene.mesh import Mesh
from ....scene.scene import Scene
from ...verdict import explained
from ..gauss_newton import Normal
from ..jacobian import Motion, Rendered
from ..observed import motion
from ..pose import Pose
from ..task import ZOOM, Level, PoseTask, Shot
from .contour import PURE, Sides, contour_term
from .depth import depth_term
from .light import HARMONICS, Lit
from .picture import Picture, Windows, palette, smoothed
from .region import posterior, region_term
from .surface import AOVS, Surface

COARSEST = 30  # pixels across the object where the fit begins
SMALLEST = 12  # pixels on the shorter side of the coarsest level
BLURS = (1.0, 0.7)  # pixels: of alpha on the coarse levels; the last but one, if there are three
CONTOUR_BLUR = 0.9  # of alpha in the contour term: about that of photographs at full size
FEW_HARMONICS = 4  # of the light on the coarsest level
GRID = 16  # pixels that crops are aligned to, so that a pose which is a little different has the same
MARGIN = 0.6  # around the object that a crop keeps, in its extent in the image
AROUND = 0.25  # of the object's extent in the image, where colours count as those that surround it
RADIUS = 0.15  # of windows in which colours are counted, in the object's extent in the image
MASKED = 0.01  # probability that a mask is wrong
VISIBLE = 10  # pixels that a render must cover
CONTRAST = 2.0  # of both sides of a contour that shows, in standard deviations
RESOLVED = 40.0  # pixels across the object: light and colours that are fitted to fewer explain any picture
# Share of the contour that has to show; with less, less is explained. More where the contour is all that is compared: wrong
# places show 0.5 … 0.7 of it in clutter, right ones 0.85 and more.
SHOWN, ALONE_SHOWN = 0.5, 0.85


class Crop(NamedTuple):
    """What is used of a picture: rows and columns of pixels, and the object's extent there."""

    top: int
    left: int
    bottom: int
    right: int
    extent: float  # pixels

    @staticmethod
    def around(task: PoseTask, shot: Shot, pose: Pose) -> Crop:
        H, W = shot.camera.size
        whole = Crop(0, 0, H, W, float(max(H, W)) / 2)
        camera = task.lens(shot.camera, pose)
        verts = torch.cat([mesh.verts for mesh in task.scene.meshes])
        seen = camera.project(pose.scale * verts @ pose.R.T + pose.t)
        if camera.projection == "panorama" or not bool(seen.isfinite().all()):
            return whole
        low, high = seen.amin(0), seen.amax(0)
        extent = float((high - low).norm())
        left, top = (max(0, GRID * math.floor((float(v) - MARGIN * extent) / GRID)) for v in low)
        ends = (GRID * math.ceil((float(v) + MARGIN * extent) / GRID) for v in high)
        right, bottom = (min(side, end) for end, side in zip(ends, (W, H), strict=True))
        if right - left < SMALLEST or bottom - top < SMALLEST:
            return whole
        return Crop(top, left, bottom, right, extent)

    def joined(self, other: Crop) -> Crop:
        """Both; the extent is that of the smaller object."""
        return Crop(
            min(self.top, other.top), min(self.left, other.left), max(self.bottom, other.bottom), max(self.right, other.right),
            min(self.extent, other.extent),
        )  # fmt: skip


@dataclass(frozen=True)
class Seen:
    """A render beside a picture."""

    picture: Picture
    alpha: Tensor  # (h, w)
    tangents: Tensor  # (D, h, w)
    near: Tensor  # (h, w): weights of what lies around the object
    extent: float  # pixels across the object in the image
    surface: Surface | None
    lit: Lit | None


@dataclass(frozen=True)
class PhotoLevel:
    """Pictures at one resolution, and what is made of them."""

    task: PoseTask
    plain: Level  # sizes and cameras as other fits have them
    pictures: list[Picture]
    palettes: list[Tensor]
    blur: float
    harmonics: int  # 0: the mesh has no colours
    last: bool

    @property
    def size(self) -> tuple[int, int]:
        return self.pictures[0].size

    def see(self, pose: Pose, seed: int) -> list[Seen]:
        """Raises ValueError when the object leaves no trace in a picture."""
        moved = self.task.scene.transformed(pose.R, pose.t, pose.scale)
        bare = Scene([Mesh(mesh.verts, mesh.faces) for mesh in moved.meshes])
        found = []
        for shot, picture in zip(self.plain.shots, self.pictures, strict=True):
            camera = self.task.lens(picture.camera, pose)
            moves = motion(self.task, self.plain, shot, pose)
            rendered = Rendered(bare, camera, ["alpha"], self.plain.spp, seed)
            alpha = rendered.images["alpha"][..., 0].float()
            tangents = rendered.derivatives(moves)["alpha"][..., 0].float()
            surface, lit = self.surface(moved, camera, moves, picture, seed)
            near, extent = surroundings(alpha)
            found.append(Seen(picture, alpha, tangents, near * picture.weight, extent, surface, lit))
        return found

    def surface(
        self, moved: Scene, camera: Camera, moves: Motion, picture: Picture, seed: int, visible: Tensor | None = None
    ) -> tuple[Surface | None, Lit | None]:  # fmt: skip
        """Of the moved object beside a picture, and its light, where terms ask for them. `visible` (h, w): its alpha, where
        others may cover it."""
        if not self.harmonics and picture.depth is None:
            return None, None
        names = [name for name in AOVS if name != "image" or self.harmonics]
        with torch.no_grad():
            channels = render_aovs(moved, camera, names, self.plain.spp, seed)
        surface = Surface.of(camera, channels, moves, visible)
        return surface, Lit.of(picture, surface, self.harmonics) if self.harmonics else None

    def equations(self, pose: Pose, seed: int, views: list[Seen] | None = None) -> tuple[Normal, float]:
        """Of all terms and pictures, and the mean loss of the region term. Each term is a likelihood in units of its own noise,
        so they are added as they are. `views`: what see() gave for the pose, where it was asked before."""
        D = len(self.plain.free)
        curvature, gradient = torch.zeros(D, D, dtype=torch.float64), torch.zeros(D, dtype=torch.float64)
        losses = []
        for k, seen in enumerate(self.see(pose, seed) if views is None else views):
            if seen.extent == 0.0:
                continue
            region, loss = region_term(self._posterior(k, seen), seen.alpha, seen.tangents, seen.near, self.blur)
            losses.append(loss)
            terms: list[Normal | None] = [region]
            if seen.lit is not None:
                terms.append(seen.lit.term())
            if self.last:
                sides = Sides.of(seen.picture, smoothed(seen.alpha[None], CONTOUR_BLUR)[0], seen.near)
                terms.append(contour_term(seen.picture, sides, smoothed(seen.tangents, CONTOUR_BLUR)))
            if seen.surface is not None and seen.picture.depth is not None:
                terms.append(depth_term(seen.surface, seen.picture.depth, seen.picture.weight, self.task.size))
            for term in terms:
                if term is not None:
                    curvature, gradient = curvature + term.curvature, gradient + term.gradient
        return Normal(curvature, gradient), sum(losses) / len(losses) if losses else math.inf

    def covered(self, pose: Pose, seed: int) -> float:
        """Pixels of the pictures that the object covers by itself."""
        moved = self.task.scene.transformed(pose.R, pose.t, pose.scale)
        bare = Scene([Mesh(mesh.verts, mesh.faces) for mesh in moved.meshes])
        with torch.no_grad():
            return sum(
                float(render_aovs(bare, picture.camera, ["alpha"], self.plain.spp, seed)["alpha"].sum())
                for picture in self.pictures
            )

    def explained(self, pose: Pose, seed: int, views: list[Seen] | None = None) -> float:
        """The share, 0 … 1, of the edges that the render should have in the pictures, of contours and of what is inside, that
        they have. `views`: as of equations()."""
        pairs, shown, length, extent = [], 0.0, 0.0, 0.0
        for seen in self.see(pose, seed) if views is None else views:
            picture, contour = seen.picture, smoothed(seen.alpha[None], CONTOUR_BLUR)[0]
            sides = Sides.of(picture, contour, seen.near)
            extent = max(extent, seen.extent)
            on = ((contour > PURE) & (contour < 1.0 - PURE)).float() * picture.weight
            length += float(on.sum())
            shown += float((on * (sides.contrast > CONTRAST) * sides.band).sum())
            band = sides.band.float() * picture.weight
            if seen.lit is None or picture.mask is not None:
                pairs.append((sides.mixed, sides.mixed, picture.outlined, band[..., None]))
            if seen.lit is not None:
                inside, lit = seen.lit.surface.inside, linear_to_srgb(seen.lit.predicted.clamp(0.0, 1.0))
                expected, weight = lit, torch.where(inside, picture.weight, 0.0)
                if picture.mask is None:
                    expected = torch.where(inside[..., None], lit, sides.mixed)
                    weight = torch.where(inside, picture.weight, band)
                pairs.append((expected, expected, picture.display, weight[..., None]))
        if length == 0.0:
            return 0.0
        needed = SHOWN if self.harmonics else ALONE_SHOWN
        return explained(pairs) * min(1.0, shown / length / needed) * min(1.0, extent / RESOLVED)

    @cached_property
    def labels(self) -> list[Tensor]:
        """Of the pixels of each picture; they are the same at each step."""
        return [picture.labels(colours) for picture, colours in zip(self.pictures, self.palettes, strict=True)]

    def _posterior(self, k: int, seen: Seen) -> Tensor:
        """(h, w), that a pixel of picture k shows the object: by the mask, or else by its colour."""
        mask = seen.picture.mask
        if mask is not None:
            return mask.clamp(MASKED, 1.0 - MASKED)
        windows = Windows(seen.picture, self.labels[k], self.palettes[k], RADIUS * seen.extent)
        return posterior(windows, seen.alpha, seen.near)


def photo_levels(
    task: PoseTask, start: Pose, depths: Sequence[Tensor | None], max_size: int, spp: int, seed: int,
    palettes: list[Tensor] | None = None, crops: Sequence[Crop] | None = None,
) -> list[PhotoLevel]:  # fmt: skip
    """From coarse to fine, of what surrounds the object at the start. `palettes` of the pictures, and `crops`, what is used of
    them, where they are known."""
    crops = crops or [Crop.around(task, shot, start) for shot in task.shots]
    shots, cut, across = [], [], []
    for shot, depth, crop in zip(task.shots, depths, crops, strict=True):
        rows, columns = slice(crop.top, crop.bottom), slice(crop.left, crop.right)
        weight = None if shot.weight is None else shot.weight[rows, columns]
        camera = shot.camera.crop(crop.top, crop.left, crop.bottom - crop.top, crop.right - crop.left)
        shots.append(Shot(camera, shot.target[rows, columns], None, weight))
        cut.append(None if depth is None else depth[rows, columns])
        across.append(crop.extent)
    finest = [min(1.0, max_size / max(shot.camera.size)) for shot in shots]
    shorter = min(factor * min(shot.camera.size) for factor, shot in zip(finest, shots, strict=True))
    largest = max(factor * extent for factor, extent in zip(finest, across, strict=True))
    halvings = round(math.log2(max(1.0, min(largest / COARSEST, shorter / SMALLEST))))
    halved = [*range(halvings, -1, -1)]
    halved = halved + [0] * (1 + len(BLURS) - len(halved))
    masked = "alpha" in task.aovs and not task.clutter
    harmonics = 0 if task.colourless or task.aovs == ("alpha",) else 1 if task.scene.is_shaded else HARMONICS
    levels = []
    for k, n in enumerate(halved):
        sizes = [_reduced(shot.camera.size, f / 2**n) for shot, f in zip(shots, finest, strict=True)]
        pictures = [Picture.of(shot, masked, depth, size) for shot, depth, size in zip(shots, cut, sizes, strict=True)]
        smaller = [shot._replace(camera=picture.camera) for shot, picture in zip(shots, pictures, strict=True)]
        blur = BLURS[k] if k < len(BLURS) else 0.0
        # Perspective shows in fine detail only: on the coarsest level the focal length would run away.
        free = [entry for entry in task.free if entry < ZOOM] if k == 0 else task.free
        plain = Level(smaller, 0.0, float(2**n), spp, free)
        few = min(harmonics, FEW_HARMONICS) if k == 0 else harmonics
        if palettes is None:
            palettes = [palette(picture.outlined, seed) for picture in pictures]
        levels.append(PhotoLevel(task, plain, pictures, palettes, blur, few, k == len(halved) - 1))
    return levels


def _reduced(size: tuple[int, int], factor: float) -> tuple[int, int]:
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


def surroundings(alpha: Tensor) -> tuple[Tensor, float]:
    """What surrounds the object (h, w), and its extent, pixels; 0 where it is not seen."""
    rows, columns = torch.nonzero(alpha > 0.5, as_tuple=True)
    near = torch.zeros_like(alpha)
    if len(rows) < VISIBLE:
        return near, 0.0
    low, high = (int(rows.min()), int(columns.min())), (int(rows.max()), int(columns.max()))
    extent = math.hypot(high[0] - low[0], high[1] - low[1])
    margin = int(AROUND * extent) + 2
    near[max(0, low[0] - margin) : high[0] + margin, max(0, low[1] - margin) : high[1] + margin] = 1.0
    return near, extent
