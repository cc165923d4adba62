"""What is compared at one resolution of a photograph, and the normal equations of a step there."""

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
from ...region import RADIUS, Palette, Windows, information, likelihood, palette, posterior, smoothed, surroundings
from ..gauss_newton import Normal
from ..given import bare
from ..jacobian import Motion, Rendered
from ..observed import motion
from ..pose import Pose
from ..task import ZOOM, Level, PoseTask, Shot
from .contour import contour_loss, contour_term
from .depth import depth_term
from .light import HARMONICS, Lit
from .picture import Picture
from .region import region_term
from .surface import AOVS, Surface

COARSEST = 30  # pixels across the object where the fit begins
SMALLEST = 12  # pixels on the shorter side of the coarsest level
BLURS = (1.0, 0.7)  # pixels: of alpha on the coarse levels; the last but one, if there are three
FEW_HARMONICS = 4  # of the light on the coarsest level
GRID = 16  # pixels that crops are aligned to, so that a pose which is a little different has the same
MARGIN = 0.6  # around the object that a crop keeps, in its extent in the image
BESIDE = 12  # pixels around the silhouette: the windows that the contour's colours are taken from reach as far
MASKED = 0.01  # probability that a mask is wrong
RESOLVED = 40.0  # pixels across the object: light and colours that are fitted to fewer explain any picture
SHOWN = 0.5  # share of the contour that has to show beside what is inside; with less, less is explained


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
    box: tuple[slice, slice]  # rows and columns around the object
    part: Picture  # what lies in them
    alpha: Tensor  # (h, w)
    tangents: Tensor  # (D, h, w)
    near: Tensor  # (h, w): weights of what lies around the object
    extent: float  # pixels across the object in the image
    surface: Surface | None  # in the box
    lit: Lit | None

    def sides(self, blur: float = CONTOUR_BLUR) -> ContourColors:
        """Of the contour, in the box, when alpha is blurred by so many pixels."""
        contour = smoothed(self.alpha[self.box][None], blur)[0]
        part = self.part
        return ContourColors.from_image(part.outlined, contour, self.near[self.box], part.mask is None, part.noise)


@dataclass(frozen=True)
class PhotoLevel:
    """Pictures at one resolution, and what is made of them."""

    task: PoseTask
    plain: Level  # sizes and cameras as other fits have them
    pictures: list[Picture]
    palettes: list[Palette]
    blur: float
    harmonics: int  # 0: the mesh has no colours
    last: bool
    blur_of_contours: float = CONTOUR_BLUR  # pixels

    @property
    def size(self) -> tuple[int, int]:
        return self.pictures[0].size

    def see(self, pose: Pose, seed: int) -> list[Seen]:
        """Raises ValueError when the object leaves no trace in a picture."""
        moved = self.task.scene.transformed(pose.R, pose.t, pose.scale)
        shapes, found = bare(moved), []
        for shot, picture in zip(self.plain.shots, self.pictures, strict=True):
            camera = self.task.lens(picture.camera, pose)
            moves = motion(self.task, self.plain, shot, pose)
            rendered = Rendered(shapes, camera, ["alpha"], self.plain.spp, seed)
            alpha = rendered.images["alpha"][..., 0].float()
            tangents = rendered.derivatives(moves)["alpha"][..., 0].float()
            found.append(self.beside(moved, camera, moves, picture, alpha, tangents, seed))
        return found

    def beside(
        self, moved: Scene, camera: Camera, moves: Motion, picture: Picture, alpha: Tensor, tangents: Tensor, seed: int,
        others: bool = False,
    ) -> Seen:  # fmt: skip
        """The moved object, whose silhouette is alpha (h, w), beside a picture. `others` may cover it: alpha is then what they
        leave to be seen."""
        rows, columns = box = _box(alpha)
        cut = camera.crop(rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start)
        part = picture.part(rows, columns, cut)
        surface = None
        if self.harmonics or picture.depth is not None:
            names = [name for name in AOVS if name != "image" or self.harmonics]
            with torch.no_grad():
                channels = render_aovs(moved, cut, names, self.plain.spp, seed)
            surface = Surface.of(cut, channels, moves, alpha[box] if others else None)
        lit = Lit.of(part, surface, self.harmonics) if surface is not None and self.harmonics else None
        near, extent = surroundings(alpha)
        return Seen(picture, box, part, alpha, tangents, near * picture.weight, extent, surface, lit)

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
                rows, columns = seen.box
                blurred = smoothed(seen.tangents[:, rows, columns], self.blur_of_contours)
                terms.append(contour_term(seen.part, seen.sides(self.blur_of_contours), blurred))
            if seen.surface is not None and seen.part.depth is not None:
                terms.append(depth_term(seen.surface, seen.part.depth, seen.part.weight, self.task.size))
            for term in terms:
                if term is not None:
                    curvature, gradient = curvature + term.curvature, gradient + term.gradient
        return Normal(curvature, gradient), sum(losses) / len(losses) if losses else math.inf

    def focused(self, seen: Sequence[Seen]) -> PhotoLevel:
        """With contours as sharp as the pictures show them where the object is: one blur for all, of CONTOUR_BLURS."""
        return replace(self, blur_of_contours=sharpest(seen))

    def unlikely(self, poses: Sequence[Pose], seed: int) -> list[float]:
        """Of each pose, −log of the likelihood of the pictures by all terms but depth, in nats of independent pixels, up to a
        constant that all share."""
        views = [self.see(pose, seed) for pose in poses]
        # All are asked about the same pixels: those around any of them.
        near = [torch.stack([seen[k].near for seen in views]).amax(0) for k in range(len(self.pictures))]
        totals = []
        for seen in views:
            total = 0.0
            for k, one in enumerate(replace(one, near=wide) for one, wide in zip(seen, near, strict=True)):
                total -= float((one.near * likelihood(self._posterior(k, one), one.alpha).log()).sum())
                total += contour_loss(one.part, one.sides())
                if one.lit is not None:  # one noise for all: that of the pose which leaves the least
                    total += one.lit.loss(min(lit.deviation for other in views if (lit := other[k].lit) is not None))
            totals.append(total)
        return totals

    def covered(self, pose: Pose, seed: int) -> float:
        """Pixels of the pictures that the object covers by itself."""
        moved = self.task.scene.transformed(pose.R, pose.t, pose.scale)
        with torch.no_grad():
            return sum(
                float(render_aovs(bare(moved), picture.camera, ["alpha"], self.plain.spp, seed)["alpha"].sum())
                for picture in self.pictures
            )

    def explained(self, pose: Pose, seed: int, views: list[Seen] | None = None) -> float:
        """The share, 0 … 1, of the edges that the render should have in the pictures, of contours and of what is inside, that
        they have. `views`: as of equations()."""
        pairs, shown, length, extent, bits, pixels = [], 0.0, 0.0, 0.0, 0.0, 0.0
        for k, seen in enumerate(self.see(pose, seed) if views is None else views):
            picture, sides = seen.part, seen.sides()
            contour = sides.alpha
            extent = max(extent, seen.extent)
            on = ((contour > PURE) & (contour < 1.0 - PURE)).float() * picture.weight
            length += float(on.sum())
            shown += float((on * (sides.contrast > CONTRAST) * sides.band).sum())
            if not self.harmonics:
                soft = smoothed(seen.alpha[None], COLOUR_WINDOW)[0]
                beside = ((soft > PURE) & (soft < 1.0 - PURE)) * seen.near
                bits += float((beside * information(self._posterior(k, seen), seen.alpha)).sum())
                pixels += float(beside.sum())
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
            return share * min(1.0, shown / length / SHOWN)
        # The colours that a contour divides are alike on both sides where it is not the object's, however strong the edges are
        # that it happens to follow.
        sure = max(0.0, min(1.0, bits / max(pixels, 1e-30) / ALONE_INFORMATION))
        return share * min(1.0, shown / length / ALONE_SHOWN) * sure

    @cached_property
    def labels(self) -> list[Tensor]:
        """Of the pixels of each picture; they are the same at each step."""
        return [colours.labels(picture.display) for picture, colours in zip(self.pictures, self.palettes, strict=True)]

    def _posterior(self, k: int, seen: Seen) -> Tensor:
        """(h, w), that a pixel of picture k shows the object: by the mask, or else by its colour."""
        mask = seen.picture.mask
        if mask is not None:
            return mask.clamp(MASKED, 1.0 - MASKED)
        windows = Windows(seen.picture.size, self.labels[k], self.palettes[k].colours, RADIUS * seen.extent)
        return posterior(windows, seen.alpha, seen.near)


def sharpest(seen: Sequence[Seen]) -> float:
    """The one of CONTOUR_BLURS, pixels, with which the pictures' contours are likeliest."""
    losses = torch.zeros(len(CONTOUR_BLURS))
    for one in seen:
        part = one.part
        losses += blur_losses(one.sides(max(CONTOUR_BLURS)), part.outlined, part.weight, one.alpha[one.box])
    return CONTOUR_BLURS[int(losses.argmin())]


def photo_levels(
    task: PoseTask, start: Pose, depths: Sequence[Tensor | None], max_size: int, spp: int, seed: int,
    palettes: list[Palette] | None = None, crops: Sequence[Crop] | None = None,
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


def _box(alpha: Tensor) -> tuple[slice, slice]:
    """Rows and columns of a silhouette alpha (h, w) and of what its contour is compared with; all where nothing is seen."""
    found = []
    for axis, size in enumerate(alpha.shape):
        filled = torch.nonzero(alpha.amax(1 - axis) > 0.0)[:, 0]
        low, high = (int(filled[0]), int(filled[-1]) + 1) if len(filled) else (0, size)
        found.append(slice(max(0, low - BESIDE), min(size, high + BESIDE)))
    return found[0], found[1]
