"""Regions and contours of pictures as a loss, the mean over what surrounds the object.

The region term is −log(αP + (1 − α)(1 − P)), with the posterior P of the colours as a silhouette divides them (region.py). It has
its least where P has its border, which is where the silhouette was: errors of P keep themselves. The contour term, half the
robust squared difference of the picture from the mixture of the colours on both sides (sides.py), tells where between them a
border lies. P and the colours of the sides are held fixed between renewals: with them, the loss is a function of the pixels'
alpha, each by itself, which a descent can compare from step to step.

Alpha is blurred, widely at first, that a step reaches far; the contour term joins when it is as sharp as the pictures show it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ...files.image import linear_to_srgb
from ..region import RADIUS, Windows, around, likelihood, palette, posterior, slope, smoothed
from ..sides import BLUR as SOFT
from ..sides import BLURS, PURE, TOLERANCE, Sides, blur_losses, outlines_explained
from ..verdict import ENOUGH
from ..views import View, has_levels, white_of

LAST = 2**20  # a step at which alpha is as sharp as pictures are
EVERY = 3  # steps from one renewal to the next
BLUR = 0.7  # pixels, of alpha, until the pictures show their own
FIRST_BLUR, NARROWED = 3.0, 0.6  # pixels at the start, and the factor from one renewal to the next
BESIDE = 2.5  # the same, where colours beside the contour are judged
# Of right fits colours tell the sides apart by 0.70 … 0.81, of wrong ones on edges of clutter by up to 0.69.
SURE = 0.695
EVEN = 1.5 / 255.0  # sRGB values: pixels that differ by no more are of one colour in eight bits
LEAST_AROUND = 0.02  # of what lies near the object: less tells no colours of a background


class Regions:
    """The pictures of some views, and what their colours say of the object's place."""

    def __init__(self, views: Sequence[View], seed: int) -> None:
        pictures = [view.image for view in views if view.image is not None]
        whites = [1.0 if has_levels(picture) else white_of(picture.flatten(0, 1)) for picture in pictures]
        shown = [picture / white for picture, white in zip(pictures, whites, strict=True)]
        self.displays = [linear_to_srgb(picture.clamp(0.0, 1.0)) for picture in shown]
        self.palettes = [palette(display, seed) for display in self.displays]
        self.labels = [own.labels(display) for display, own in zip(self.displays, self.palettes, strict=True)]
        most = max((float(view.weight.max()) for view in views if view.weight is not None), default=1.0)
        self.weights = [None if view.weight is None else view.weight[..., 0] / most for view in views]
        self.near = [torch.zeros(view.camera.size) for view in views]
        self.posteriors = [torch.full(view.camera.size, 0.5) for view in views]
        self.sides: list[Sides | None] = [None for _ in views]
        self.blur = BLUR
        self.narrows = False  # whether alpha is blurred more than it will be
        self._losses = [torch.zeros(len(BLURS)) for _ in views]  # of each view's contour, by its blur

    def renew(self, index: int, alpha: Tensor, step: int = LAST) -> None:
        """By the silhouette (H, W, 1) that a view shows at a step; without one, what was known stays."""
        wide = FIRST_BLUR * NARROWED ** (step // EVERY)
        self.narrows = wide > BLUR
        share = alpha[..., 0].detach().float()
        near, extent = self.around(index, share)
        if extent > 0.0 and bool((near > 0.0).any()):
            windows = Windows(
                (share.shape[0], share.shape[1]), self.labels[index], self.palettes[index].colours, RADIUS * extent
            )
            self.near[index], self.posteriors[index] = near, posterior(windows, share, near)
            sides = Sides.of(self.displays[index], smoothed(share[None], SOFT)[0], near)
            self.sides[index] = sides
            self._losses[index] = blur_losses(sides, self.displays[index], near, share)
        known = torch.stack(self._losses).sum(0)
        self.blur = wide if self.narrows else BLURS[int(known.argmin())] if bool(known.any()) else BLUR

    def around(self, index: int, alpha: Tensor) -> tuple[Tensor, float]:
        """Weights (H, W) of what surrounds the object, and its extent, pixels; 0 where it is not seen."""
        near, extent = around(alpha)
        weight = self.weights[index]
        return near if weight is None else near * weight, extent

    def loss(self, group: Sequence[int], alpha: Tensor) -> Tensor:
        """Σ of the losses of these views, of their alpha (B, H, W, 1)."""
        P, near = self._of(group)
        soft = self.blurred(alpha)
        found = -likelihood(P, soft).double().log()
        if (sides := self._sides(group)) is not None:
            squares = self._squares(group, sides, soft)
            found = found + 0.5 * sides.band * (squares / (1.0 + squares / TOLERANCE)).double()
        return (near * found).sum()

    def curvature(self, group: Sequence[int], alpha: Tensor) -> Tensor:
        """(B, H, W) of the same by each pixel's alpha, blurred as `blurred` does: Fisher's information, and the squares of the
        mixture's slopes."""
        P, near = self._of(group)
        soft = self.blurred(alpha)
        found = slope(P, soft).square()
        if (sides := self._sides(group)) is not None:
            robust = (1.0 + self._squares(group, sides, soft) / TOLERANCE).pow(-2)
            slopes = (sides.slope_by(soft).square() / sides.variance).sum(-1)
            found = found + sides.band * robust * slopes
        return near * found

    def blurred(self, images: Tensor) -> Tensor:
        """(n, H, W) as alpha is blurred, from alpha or its derivatives (n, H, W, 1)."""
        return smoothed(images[..., 0].float(), self.blur)

    def shares(self, group: Sequence[int]) -> Tensor:
        """(B, H, W): by how much each pixel counts of the loss of its view, 1 in sum."""
        return self._of(group)[1]

    def explained(self, alphas: Sequence[Tensor], within: Sequence[Tensor] | None = None) -> float:
        """How much of the contour the pictures show, 0 … 1, from alphas (H, W, 1) by which they were renewed: the share of its
        edges, or, where that is less, how surely colours tell its two sides apart: the mean of 2P − 1 inside, 1 − 2P outside, in
        such units that SURE is just enough. Where `within` (H, W) is 1."""
        parts, told, length = [], 0.0, 0.0
        for k, alpha in enumerate(alphas):
            share = alpha[..., 0].float()
            near = self.around(k, share)[0]
            near = near if within is None else near * within[k]
            parts.append((self.displays[k], share, near))
            soft = smoothed(share[None], BESIDE)[0]
            band = ((soft > PURE) & (soft < 1.0 - PURE)) * near
            sure = 2.0 * self.posteriors[k] - 1.0
            told += float((band * torch.where(share > 0.5, sure, -sure)).sum())
            length += float(band.sum())
        return max(0.0, min(ENOUGH / SURE * told / max(length, 1e-30), outlines_explained(parts)))

    def check(self, alphas: Sequence[Tensor]) -> None:
        """That the silhouettes of the start leave something of the pictures around them, of more than one colour. Raises
        ValueError."""
        seen = coloured = 0
        for k, alpha in enumerate(alphas):
            share = alpha[..., 0].float()
            near, extent = self.around(k, share)
            seen += extent > 0.0
            colours = self.displays[k][near > 0.0]
            coloured += len(colours) > 0 and float((colours.amax(0) - colours.amin(0)).max()) > EVEN
            if extent > 0.0 and float((near * (1.0 - share)).sum()) <= LEAST_AROUND * float(near.sum()):
                raise ValueError(
                    f'scene: expected meshes with some of the picture around them, as loss="region" needs, got a scene that '
                    f"fills picture {k} at the start; leave out ground and walls, for all meshes of the scene are the object"
                )
        if not seen:
            raise ValueError(
                'scene: expected an object that the pictures show at the start, as loss="region" needs, got one out of view of '
                "all cameras; start nearer"
            )
        if not coloured:
            raise ValueError(
                'images: expected the object before something of another colour, as loss="region" needs, got one colour alone '
                "where it is at the start and around it; start nearer, or look for what made the pictures black or white"
            )

    def _of(self, group: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Posteriors (B, H, W), and weights whose sum is 1 for each view."""
        near = torch.stack([self.near[i] for i in group])
        return torch.stack([self.posteriors[i] for i in group]), near / near.sum((1, 2), keepdim=True).clamp(min=1e-30)

    def _sides(self, group: Sequence[int]) -> Sides | None:
        """Of these views, one on the other; None while alpha is blurred widely, or where no view has shown the object."""
        found = [self.sides[i] for i in group]
        if self.narrows or any(sides is None for sides in found):
            return None
        columns = zip(*(_tensors(sides) for sides in found if sides), strict=True)
        alpha, inside, outside, variance, band = (torch.stack(list(column)) for column in columns)
        return Sides(alpha, inside, outside, variance, band)

    def _squares(self, group: Sequence[int], sides: Sides, alpha: Tensor) -> Tensor:
        """(B, H, W): squared differences of the pictures from the mixture by alpha (B, H, W), in variances."""
        off = sides.mixed_by(alpha) - torch.stack([self.displays[i] for i in group])
        return (off.square() / sides.variance).sum(-1)


def _tensors(sides: Sides) -> tuple[Tensor, ...]:
    return sides.alpha, sides.inside, sides.outside, sides.variance, sides.band
