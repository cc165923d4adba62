"""The loss of regions and contours of pictures, a mean over the pixels near the object.

The region term is −log(αP + (1 − α)(1 − P)), with the posterior P of the colours as a silhouette divides them (region.py). Its
minimum is where P has its border, and that is where the silhouette was, so errors of P preserve themselves. The contour term is
half the robust squared difference of the picture from a mixture of the colours on both sides (pose/likelihood/contour.py). It
says where between these colours a border lies. P and the colours are held fixed between renewals, so that the loss is a function
of each pixel's alpha, which a descent can compare from step to step.

Alpha is blurred, widely at first, so that a step reaches far. The contour term joins when alpha is as sharp as the pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from ...files.image import linear_to_srgb
from ..contour_colors import ALONE_SHOWN, COLOUR_WINDOW, CONTOUR_BLURS, PURE, TOLERANCE
from ..edge_support import MIN_EDGE_SUPPORT, edge_support
from ..pose.likelihood.contour import ContourNoise, Sides, mixture
from ..pose.likelihood.picture import Box, PictureLevel, RenderedPoses
from ..pose.likelihood.support import compared_images, contour_length
from ..pose.task import TargetView
from ..region import COLORS, ColorFrequencies, likelihood, palette, slope, smoothed, smoothed_within, surroundings
from ..views import Observation, has_levels, white_level

FINAL_STEP = 2**20  # a step at which alpha is as sharp as pictures are


@dataclass(frozen=True)
class RegionSettings:
    """How the loss of regions changes along a descent, and how contours are judged by it. Lengths are in pixels.

    Of four brackets before clutter (tests/fit/photographs.py), three are found within 1.4°, and the fourth is 2° off. Half or
    twice a number changes this by less than 0.5°, where it does not say otherwise.
    """

    # From one renewal of colours and blur to the next: two lose the fourth, six too, and take 1.7 times as many steps.
    renewal_steps: int = 3
    start_blur: float = 3.0  # of alpha: a wider one reaches farther and shows less of the shape; half loses the fourth
    narrowing: float = 0.6  # factor of the blur from one renewal to the next
    least_blur: float = 0.7  # of alpha, until the pictures show their own blur
    # Of the band in which colours next to the contour are judged, in radii of the windows in which they are counted: half of it
    # doubts two right ones. In pixels it would judge large pictures by their blurred pixels alone, and doubt right ones there.
    sureness_blur: float = 0.2
    # How surely colours must separate the two sides of a right contour. Of small pictures, wrong ones on edges of clutter reach
    # 0.69, right ones 0.70 … 0.81. Of ten objects 157 … 236 pixels across, seven within 1° have 0.79 … 0.93, one 15° off 0.57;
    # a stone 5° off is above the limit.
    min_sureness: float = 0.695
    # These refuse starts alone: pixels that differ by no more are of one colour in eight bits, sRGB values; and the share of
    # background among the pixels near the object.
    min_color_range: float = 1.5 / 255.0
    min_background: float = 0.02


class ViewColors(NamedTuple):
    """The colours of a view's picture as its last renewal divided them, (1, H, W) each."""

    near: Tensor  # weights of the pixels near the object
    posterior: Tensor
    sides: Sides | None = None  # of the contour


class RegionLoss:
    """The colours of some views' pictures, and the loss of silhouettes by them."""

    def __init__(self, views: Sequence[Observation], seed: int, settings: RegionSettings | None = None) -> None:
        self.settings = settings or RegionSettings()
        most = max((float(view.weight.max()) for view in views if view.weight is not None), default=1.0)
        self.pictures = [_picture(view, most, seed) for view in views]
        blank = [torch.zeros(1, *view.camera.size, dtype=torch.float32) for view in views]
        self.colors = [ViewColors(zero, zero + 0.5) for zero in blank]
        self.blur = self.settings.least_blur
        self.narrows = False  # whether alpha is blurred more than at later steps
        # Of each view's contour, for each of CONTOUR_BLURS.
        self._costs = [torch.zeros(len(CONTOUR_BLURS), dtype=torch.float32) for _ in views]

    def renew(self, index: int, alpha: Tensor, step: int = FINAL_STEP) -> None:
        """Take posterior and colours from a view's silhouette alpha (H, W, 1) at a step; keep the last ones if it is empty."""
        settings = self.settings
        wide = settings.start_blur * settings.narrowing ** (step // settings.renewal_steps)
        self.narrows = wide > settings.least_blur
        share = alpha[None, ..., 0].detach().float()
        near, extent = self.around(index, alpha)
        if extent > 0.0 and bool((near > 0.0).any()):
            picture = replace(self.pictures[index], weight=near[0])
            labels, colors, radius = picture.labels, picture.palette.colors, COLORS.radius * extent
            found = ColorFrequencies.from_labels(labels, colors, share, near[0], radius, COLORS.prior_pixels)
            box = Box(*(slice(0, n) for n in picture.size))
            seen = RenderedPoses(box, share, share[None, :0], None, None, None)
            visible, noise = torch.ones_like(share), ContourNoise()
            sides = Sides.from_picture(picture, seen, visible, None, found.every, noise, COLOUR_WINDOW)
            self.colors[index] = ViewColors(near, found.posterior, sides)
            costs = [_contour(sides, picture.outlined, smoothed(share, blur))[0] for blur in CONTOUR_BLURS]
            self._costs[index] = (near * torch.cat(costs)).sum((1, 2))
        known = torch.stack(self._costs).sum(0)
        self.blur = (
            wide if self.narrows else CONTOUR_BLURS[int(known.argmin())] if bool(known.any()) else settings.least_blur
        )

    def around(self, index: int, alpha: Tensor) -> tuple[Tensor, float]:
        """Return weights (1, H, W) of the pixels near the object, and its extent in pixels, 0 if it is not seen."""
        near, extent = surroundings(alpha[..., 0].detach().float())
        return (near * self.pictures[index].weight)[None], extent

    def loss(self, group: Sequence[int], alpha: Tensor) -> Tensor:
        """Return the sum of these views' losses at their alpha (B, H, W, 1)."""
        return self._terms(group, alpha)[0].sum()

    def curvature(self, group: Sequence[int], alpha: Tensor) -> Tensor:
        """Return the curvature (B, H, W) of loss() by each pixel's blurred alpha: Fisher's information of the region term, and
        the squared slopes of the mixture in the contour term."""
        return self._terms(group, alpha)[1]

    def _terms(self, group: Sequence[int], alpha: Tensor) -> tuple[Tensor, Tensor]:
        """Return the costs (B, H, W) of these views' pixels and their curvature. The contour counts once alpha is no longer
        blurred widely, and all of the views have shown the object."""
        P, soft = torch.cat([self.colors[i].posterior for i in group]), self.blurred(alpha)
        cost, curvature = -likelihood(P, soft).double().log(), slope(P, soft).square()
        found = [sides for i in group if (sides := self.colors[i].sides) is not None]
        if not self.narrows and len(found) == len(group):
            sides = Sides(*(torch.cat(parts) for parts in zip(*found, strict=True)))
            own, bend = _contour(sides, torch.stack([self.pictures[i].outlined for i in group]), soft)
            cost, curvature = cost + own, curvature + bend
        shares = self.shares(group)
        return shares * cost, shares * curvature

    def blurred(self, images: Tensor) -> Tensor:
        """Blur alpha or its derivatives (n, H, W, 1) as the loss does; return (n, H, W)."""
        return smoothed(images[..., 0].float(), self.blur)

    def shares(self, group: Sequence[int]) -> Tensor:
        """Return the weights (B, H, W) of the pixels, which sum to 1 in each view."""
        near = torch.cat([self.colors[i].near for i in group])
        return near / near.sum((1, 2), keepdim=True).clamp(min=1e-30)

    def edge_support(self, alphas: Sequence[Tensor], within: Sequence[Tensor] | None = None) -> float:
        """Return how much of the contour the pictures show, 0 … 1, from the alphas (H, W, 1) of the last renewal. It is the
        smaller of two shares: that of the contour's edges, and how surely colours separate its two sides. The latter is the
        mean of 2P − 1 inside and 1 − 2P outside, scaled so that `min_sureness` is just enough. `within` (H, W) masks pixels."""
        pairs, contour, sureness, length = [], torch.zeros(2), 0.0, 0.0
        for k, (alpha, picture, colors) in enumerate(zip(alphas, self.pictures, self.colors, strict=True)):
            share, near = alpha[None, ..., 0].float(), colors.near * (1.0 if within is None else within[k])
            if (sides := colors.sides) is not None:
                contour = contour + contour_length(sides, near)
                pairs.append(compared_images(sides.mixed[0], picture.outlined, (sides.band * (near > 0.0))[0]))
            _, extent = self.around(k, alpha)
            soft = smoothed_within(share, self.settings.sureness_blur * COLORS.radius * extent)
            band = ((soft > PURE) & (soft < 1.0 - PURE)) * near
            sure = 2.0 * colors.posterior - 1.0
            sureness += float((band * torch.where(share > 0.5, sure, -sure)).sum())
            length += float(band.sum())
        sure_share = MIN_EDGE_SUPPORT / self.settings.min_sureness * sureness / max(length, 1e-30)
        shown = min(1.0, float(contour[1] / contour[0].clamp(min=1e-30)) / ALONE_SHOWN)
        return max(0.0, min(sure_share, edge_support(pairs, softer=True) * shown)) if float(contour[0]) > 0.0 else 0.0

    def check(self, alphas: Sequence[Tensor]) -> None:
        """Check that the silhouettes of the start leave pixels of the pictures around them, of more than one colour. Raises
        ValueError."""
        seen = colored = 0
        for k, alpha in enumerate(alphas):
            near, extent = self.around(k, alpha)
            seen += extent > 0.0
            colors, least = self.pictures[k].display[:, near[0] > 0.0], self.settings.min_color_range
            colored += colors.numel() > 0 and float((colors.amax(1) - colors.amin(1)).max()) > least
            behind = float((near * (1.0 - alpha[..., 0])).sum())
            if extent > 0.0 and behind <= self.settings.min_background * float(near.sum()):
                raise ValueError(
                    f'scene: expected meshes with some of the picture around them, as loss="region" needs, got a scene that '
                    f"fills picture {k} at the start; leave out ground and walls, for all meshes of the scene are the object"
                )
        if not seen:
            raise ValueError(
                'scene: expected an object that the pictures show at the start, as loss="region" needs, got one out of view of '
                "all cameras; start nearer"
            )
        if not colored:
            raise ValueError(
                'images: expected the object before something of another colour, as loss="region" needs, got one colour alone '
                "where it is at the start and around it; start nearer, or look for what made the pictures black or white"
            )


def _picture(view: Observation, most: float, seed: int) -> PictureLevel:
    """Return the picture of a view, whose weights are relative to the largest of all."""
    assert view.image is not None
    image = view.image / (1.0 if has_levels(view.image) else white_level(view.image.flatten(0, 1)))
    colors = palette(linear_to_srgb(image.clamp(0.0, 1.0)), seed)
    shot = TargetView(view.camera, image, None, None if view.weight is None else view.weight / most)
    return PictureLevel.from_shot(shot, None, False, view.camera.size, 0.0, colors)


def _contour(sides: Sides, images: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Return half the robust squared differences (N, h, w) of images (…, C, h, w) from both sides mixed by alpha, and their
    curvature by it."""
    mixed, step = mixture(sides.front, sides.back, alpha)
    squares = ((mixed - images).square() / sides.variance).sum(1)
    robust, band = 1.0 + squares / TOLERANCE, sides.band > 0.0
    return 0.5 * band * (squares / robust).double(), band * robust.pow(-2) * (step.square() / sides.variance).sum(1)
