"""Comparison with photographs at one resolution, and the normal equations of a step there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from ....aovs import render_aovs
from ....camera.camera import Camera
from ....files.image import linear_to_srgb
from ....scene.scene import Scene
from ...contour_colors import (
    ALONE_INFORMATION,
    ALONE_SHOWN,
    COLOUR_WINDOW,
    CONTOUR_BLUR,
    CONTOUR_BLURS,
    CONTRAST,
    PURE,
    ContourColors,
    blur_losses,
)
from ...edge_support import edge_support
from ...options import Settings
from ...region import RADIUS, Palette, Windows, information, likelihood, palette, posterior, smoothed, surroundings
from ..gauss_newton import NormalEquations
from ..inputs import without_colors
from ..jacobian import Motion, Rendered
from ..pose import Pose
from ..target_images import scaled
from ..task import FOCAL_LENGTH, PoseTask, PyramidLevel, TargetView
from .contour import contour_loss, contour_term
from .depth import depth_term
from .light import HARMONICS, FittedLight
from .picture import Picture
from .region_term import region_term
from .surface_interior import AOVS, SurfaceInterior

COARSEST_PHOTO = 30  # pixels across the object on the coarsest level
SMALLEST_PHOTO_SIDE = 12  # pixels on the shorter side of the coarsest level
# The damping is relative to the curvature's diagonal, before the last level and on it, the least damping to its largest entry.
COARSE_DAMPING, FINE_DAMPING, MIN_PHOTO_DAMPING = 0.1, 0.01, 1e-5
MAX_PHOTO_STEP = 0.1  # largest entry of a step
ALPHA_BLURS = (1.0, 0.7)  # pixels, of alpha on coarse levels; of three levels the last but one has the second
FEW_HARMONICS = 4  # number for the light on the coarsest level
CROP_GRID = 16  # Crops are aligned to so many pixels, so that a slightly different pose has the same.
CROP_MARGIN = 0.6  # margin around the object, in its extent in the image
CONTOUR_MARGIN = 12  # Pixels around the silhouette: windows for the contour's colours reach as far.
MASK_ERROR = 0.01  # probability that a mask's pixel is wrong
RESOLVED = 40.0  # Pixels across the object: light and colours fitted to fewer match any picture.
MIN_SHOWN_CONTOUR = 0.5  # Edge support is reduced if less of the contour shows.


class Crop(NamedTuple):
    """The part of a picture that is used: rows and columns of pixels, and the object's extent there."""

    top: int
    left: int
    bottom: int
    right: int
    extent: float  # pixels

    @staticmethod
    def around(task: PoseTask, shot: TargetView, pose: Pose) -> Crop:
        H, W = shot.camera.size
        whole = Crop(0, 0, H, W, float(max(H, W)) / 2)
        camera = task.lens(shot.camera, pose)
        verts = torch.cat([mesh.verts for mesh in task.scene.meshes])
        seen = camera.project(pose.scale * verts @ pose.R.T + pose.t)
        if camera.projection == "panorama" or not bool(seen.isfinite().all()):
            return whole
        low, high = seen.amin(0), seen.amax(0)
        extent = float((high - low).norm())
        left, top = (max(0, CROP_GRID * math.floor((float(v) - CROP_MARGIN * extent) / CROP_GRID)) for v in low)
        ends = (CROP_GRID * math.ceil((float(v) + CROP_MARGIN * extent) / CROP_GRID) for v in high)
        right, bottom = (min(side, end) for end, side in zip(ends, (W, H), strict=True))
        if right - left < SMALLEST_PHOTO_SIDE or bottom - top < SMALLEST_PHOTO_SIDE:
            return whole
        return Crop(top, left, bottom, right, extent)

    def joined(self, other: Crop) -> Crop:
        """Return the crop around both; the extent is that of the smaller object."""
        return Crop(
            min(self.top, other.top), min(self.left, other.left), max(self.bottom, other.bottom), max(self.right, other.right),
            min(self.extent, other.extent),
        )  # fmt: skip


@dataclass(frozen=True)
class PictureComparison:
    """A render compared with a picture."""

    picture: Picture
    box: tuple[slice, slice]  # rows and columns around the object
    part: Picture  # picture in the box
    alpha: Tensor  # (h, w)
    tangents: Tensor  # (D, h, w)
    near: Tensor  # (h, w), weights of what lies around the object
    extent: float  # pixels across the object in the image
    surface: SurfaceInterior | None  # in the box
    lit: FittedLight | None

    def sides(self, blur: float = CONTOUR_BLUR) -> ContourColors:
        """Return the colours at both sides of the contour, in the box, when alpha is blurred by so many pixels."""
        contour = smoothed(self.alpha[self.box][None], blur)[0]
        part = self.part
        return ContourColors.from_image(part.outlined, contour, self.near[self.box], part.mask is None, part.noise)


@dataclass(frozen=True)
class PhotoLevel:
    """Pictures at one resolution, and how they are compared."""

    task: PoseTask
    pyramid_level: PyramidLevel  # sizes and cameras
    pictures: list[Picture]
    palettes: list[Palette]
    blur: float
    harmonics: int  # 0 for a mesh without colours
    last: bool
    blur_of_contours: float = CONTOUR_BLUR  # pixels

    @property
    def size(self) -> tuple[int, int]:
        return self.pictures[0].size

    def comparisons(self, pose: Pose, seed: int) -> list[PictureComparison]:
        """Compare renders at a pose with the pictures. Raises ValueError when the object leaves no trace in a picture."""
        moved = self.task.scene.transformed(pose.R, pose.t, pose.scale)
        shapes, found = without_colors(moved), []
        for shot, picture in zip(self.pyramid_level.shots, self.pictures, strict=True):
            camera = self.task.lens(picture.camera, pose)
            moves = self.task.motion(self.pyramid_level, shot, pose)
            rendered = Rendered(shapes, camera, ["alpha"], self.pyramid_level.spp, seed)
            alpha = rendered.images["alpha"][..., 0].float()
            tangents = rendered.derivatives(moves)["alpha"][..., 0].float()
            found.append(self.comparison(moved, camera, moves, picture, alpha, tangents, seed))
        return found

    def comparison(
        self, moved: Scene, camera: Camera, moves: Motion, picture: Picture, alpha: Tensor, tangents: Tensor, seed: int,
        others: bool = False,
    ) -> PictureComparison:  # fmt: skip
        """Compare the moved object, whose silhouette is alpha (h, w), with a picture. Where `others` may cover it, alpha is
        its visible part."""
        rows, columns = box = _box(alpha)
        cut = camera.crop(rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start)
        part = picture.part(rows, columns, cut)
        surface = None
        if self.harmonics or picture.depth is not None:
            names = [name for name in AOVS if name != "image" or self.harmonics]
            with torch.no_grad():
                channels = render_aovs(moved, cut, names, self.pyramid_level.spp, seed)
            surface = SurfaceInterior.from_channels(cut, channels, moves, alpha[box] if others else None)
        lit = (
            FittedLight.from_picture(part, surface, self.harmonics) if surface is not None and self.harmonics else None
        )
        near, extent = surroundings(alpha)
        return PictureComparison(picture, box, part, alpha, tangents, near * picture.weight, extent, surface, lit)

    def equations(
        self, pose: Pose, seed: int, views: list[PictureComparison] | None = None
    ) -> tuple[NormalEquations, float]:
        """Return the equations of all terms and pictures, and the mean loss of the region term. Each term is a likelihood in
        units of its own noise, so they are added as they are. `views` are comparisons() at the pose, if known."""
        D = len(self.pyramid_level.dofs)
        curvature, gradient = torch.zeros(D, D, dtype=torch.float64), torch.zeros(D, dtype=torch.float64)
        losses = []
        for k, seen in enumerate(self.comparisons(pose, seed) if views is None else views):
            if seen.extent == 0.0:
                continue
            region, loss = region_term(self._posterior(k, seen), seen.alpha, seen.tangents, seen.near, self.blur)
            losses.append(loss)
            terms: list[NormalEquations | None] = [region]
            if seen.lit is not None:
                terms.append(seen.lit.term())
            if self.last:
                rows, columns = seen.box
                blurred = smoothed(seen.tangents[:, rows, columns], self.blur_of_contours)
                terms.append(contour_term(seen.part, seen.sides(self.blur_of_contours), blurred))
            if seen.surface is not None and seen.part.depth is not None:
                terms.append(depth_term(seen.surface, seen.part.depth, seen.part.weight, self.task.size))
            for term in terms:
                if term is not None:
                    curvature, gradient = curvature + term.curvature, gradient + term.gradient
        return NormalEquations(curvature, gradient), sum(losses) / len(losses) if losses else math.inf

    def step(self, normal: NormalEquations, longest: float = MAX_PHOTO_STEP) -> Tensor | None:
        """Return the damped step (n,), or None where nothing depends on the parameters."""
        return normal.damped(FINE_DAMPING if self.last else COARSE_DAMPING, MIN_PHOTO_DAMPING, longest)

    def focused(self, seen: Sequence[PictureComparison]) -> PhotoLevel:
        """Return the level with contours as sharp as the pictures show them where the object is: one of CONTOUR_BLURS for
        all."""
        return replace(self, blur_of_contours=sharpest(seen))

    def negative_log_likelihoods(self, poses: Sequence[Pose], seed: int) -> list[float]:
        """Return those of the pictures for each pose, by all terms but depth, in nats of independent pixels, up to a common
        constant."""
        views = [self.comparisons(pose, seed) for pose in poses]
        # All are compared by the same pixels: those around any of them.
        near = [torch.stack([seen[k].near for seen in views]).amax(0) for k in range(len(self.pictures))]
        totals = []
        for seen in views:
            total = 0.0
            for k, one in enumerate(replace(one, near=wide) for one, wide in zip(seen, near, strict=True)):
                total -= float((one.near * likelihood(self._posterior(k, one), one.alpha).log()).sum())
                total += contour_loss(one.part, one.sides())
                if one.lit is not None:  # The best match sets one noise level for all.
                    total += one.lit.loss(min(lit.deviation for other in views if (lit := other[k].lit) is not None))
            totals.append(total)
        return totals

    def covered(self, pose: Pose, seed: int) -> float:
        """Return the number of the pictures' pixels that the object alone covers."""
        moved = self.task.scene.transformed(pose.R, pose.t, pose.scale)
        with torch.no_grad():
            return sum(
                float(
                    render_aovs(without_colors(moved), picture.camera, ["alpha"], self.pyramid_level.spp, seed)[
                        "alpha"
                    ].sum()
                )
                for picture in self.pictures
            )

    def edge_support(self, pose: Pose, seed: int, views: list[PictureComparison] | None = None) -> float:
        """Return the share, 0 … 1, of the render's edges that the pictures have, of contours and inside. `views` as of
        equations()."""
        pairs, shown, length, extent, bits, pixels = [], 0.0, 0.0, 0.0, 0.0, 0.0
        for k, seen in enumerate(self.comparisons(pose, seed) if views is None else views):
            picture, sides = seen.part, seen.sides()
            contour = sides.alpha
            extent = max(extent, seen.extent)
            on = ((contour > PURE) & (contour < 1.0 - PURE)).float() * picture.weight
            length += float(on.sum())
            shown += float((on * (sides.contrast > CONTRAST) * sides.band).sum())
            if not self.harmonics:
                soft = smoothed(seen.alpha[None], COLOUR_WINDOW)[0]
                ring = ((soft > PURE) & (soft < 1.0 - PURE)) * seen.near
                bits += float((ring * information(self._posterior(k, seen), seen.alpha)).sum())
                pixels += float(ring.sum())
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
        share = edge_support(pairs, softer=True) * min(1.0, extent / RESOLVED)
        if self.harmonics:
            return share * min(1.0, shown / length / MIN_SHOWN_CONTOUR)
        # Off the object, both sides of a contour have similar colours, however strong the edges that it follows.
        sure = max(0.0, min(1.0, bits / max(pixels, 1e-30) / ALONE_INFORMATION))
        return share * min(1.0, shown / length / ALONE_SHOWN) * sure

    @cached_property
    def labels(self) -> list[Tensor]:
        """The palette's labels of the pixels of each picture; they are the same at each step."""
        return [colors.labels(picture.display) for picture, colors in zip(self.pictures, self.palettes, strict=True)]

    def _posterior(self, k: int, seen: PictureComparison) -> Tensor:
        """Return the posterior (h, w) that a pixel of picture k shows the object: by the mask, or else by its colour."""
        mask = seen.picture.mask
        if mask is not None:
            return mask.clamp(MASK_ERROR, 1.0 - MASK_ERROR)
        windows = Windows(seen.picture.size, self.labels[k], self.palettes[k].colors, RADIUS * seen.extent)
        return posterior(windows, seen.alpha, seen.near)


def sharpest(seen: Sequence[PictureComparison]) -> float:
    """Return the one of CONTOUR_BLURS, in pixels, with which the pictures' contours are likeliest."""
    losses = torch.zeros(len(CONTOUR_BLURS), dtype=torch.float32)
    for one in seen:
        part = one.part
        losses += blur_losses(one.sides(max(CONTOUR_BLURS)), part.outlined, part.weight, one.alpha[one.box])
    return CONTOUR_BLURS[int(losses.argmin())]


def photo_levels(
    task: PoseTask, start: Pose, depths: Sequence[Tensor | None], settings: Settings,
    palettes: list[Palette] | None = None, crops: Sequence[Crop] | None = None,
) -> list[PhotoLevel]:  # fmt: skip
    """Return the levels from coarse to fine, of what surrounds the object at the start. `palettes` and `crops` of the
    pictures may be given."""
    crops = crops or [Crop.around(task, shot, start) for shot in task.shots]
    shots, cut, across = [], [], []
    for shot, depth, crop in zip(task.shots, depths, crops, strict=True):
        rows, columns = slice(crop.top, crop.bottom), slice(crop.left, crop.right)
        weight = None if shot.weight is None else shot.weight[rows, columns]
        camera = shot.camera.crop(crop.top, crop.left, crop.bottom - crop.top, crop.right - crop.left)
        shots.append(TargetView(camera, shot.target[rows, columns], None, weight))
        cut.append(None if depth is None else depth[rows, columns])
        across.append(crop.extent)
    finest = [min(1.0, settings.max_size / max(shot.camera.size)) for shot in shots]
    shorter = min(factor * min(shot.camera.size) for factor, shot in zip(finest, shots, strict=True))
    largest = max(factor * extent for factor, extent in zip(finest, across, strict=True))
    halvings = round(math.log2(max(1.0, min(largest / COARSEST_PHOTO, shorter / SMALLEST_PHOTO_SIDE))))
    halved = [*range(halvings, -1, -1)]
    halved = halved + [0] * (1 + len(ALPHA_BLURS) - len(halved))
    masked = "alpha" in task.aovs and not task.clutter
    harmonics = 0 if task.colorless or task.aovs == ("alpha",) else 1 if task.scene.is_shaded else HARMONICS
    levels = []
    for k, n in enumerate(halved):
        sizes = [scaled(shot.camera.size, f / 2**n) for shot, f in zip(shots, finest, strict=True)]
        pictures = [
            Picture.from_shot(shot, masked, depth, size) for shot, depth, size in zip(shots, cut, sizes, strict=True)
        ]
        smaller = [shot._replace(camera=picture.camera) for shot, picture in zip(shots, pictures, strict=True)]
        blur = ALPHA_BLURS[k] if k < len(ALPHA_BLURS) else 0.0
        # Perspective shows in fine detail only: on the coarsest level the focal length would diverge.
        dofs = [entry for entry in task.dofs if entry < FOCAL_LENGTH] if k == 0 else task.dofs
        pyramid_level = PyramidLevel(smaller, 0.0, float(2**n), settings.spp, dofs)
        few = min(harmonics, FEW_HARMONICS) if k == 0 else harmonics
        if palettes is None:
            palettes = [palette(picture.outlined, settings.seed) for picture in pictures]
        levels.append(PhotoLevel(task, pyramid_level, pictures, palettes, blur, few, k == len(halved) - 1))
    return levels


def _box(alpha: Tensor) -> tuple[slice, slice]:
    """Return rows and columns around a silhouette alpha (h, w) that its contour needs; all where nothing is seen."""
    found = []
    for axis, size in enumerate(alpha.shape):
        filled = torch.nonzero(alpha.amax(1 - axis) > 0.0)[:, 0]
        low, high = (int(filled[0]), int(filled[-1]) + 1) if len(filled) else (0, size)
        found.append(slice(max(0, low - CONTOUR_MARGIN), min(size, high + CONTOUR_MARGIN)))
    return found[0], found[1]
