"""The contour term: across the silhouette a pixel mixes the colours of both sides by the share that the object covers.

Lenses and sensors mix radiance, and the display's curve comes after, see contour_colors.py. The region term decides on which
side of the contour a pixel lies; this one measures its share of each side. Both sides are means of the picture a little inside
and a little outside, or the background where that is known. The mesh in the fitted light says what the object's side is, too;
both are combined by their variances, which weight the difference. The cost is −log of the likelihood's ratio to pixels of one
side alone, or of any colour nearby, so that only mixtures count and neither longer nor wider contours are likelier in themselves.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ....files.image import linear_to_srgb, srgb_slope, srgb_to_linear
from ...contour_colors import PURE, SUPPORT, local_colors
from ...region import smoothed_within
from ..settings import POSE
from .light import FittedLight
from .picture import PictureLevel, RenderedPoses
from .term import Term

MIN_VISIBLE = 0.3  # A pixel that something else probably covers shows no contour.


class ContourNoise(NamedTuple):
    """How sharp and how noisy the contours of a picture are."""

    blur: float = POSE.first_contour[0]  # standard deviation in pixels of the blur of alpha
    deviation: float = POSE.first_contour[1]  # of a mixed pixel, display values


class Sides(NamedTuple):
    """The colours on both sides of N contours, the 0.5 level of a blurred alpha, and their mixture across it."""

    alpha: Tensor  # (N, h, w)
    front: Tensor  # (N, C, h, w), display values of both sides, and their variances
    back: Tensor
    front_variance: Tensor
    back_variance: Tensor
    band: Tensor  # (N, h, w), weights of the mixed pixels whose sides are both known
    mixed: Tensor  # (N, C, h, w), what the picture shows if the contour is right
    step: Tensor  # (N, C, h, w), its derivative by alpha
    variance: Tensor  # (N, C, h, w)
    density: Tensor  # (1, h, w), log density of the pixels' colours nearby

    @staticmethod
    def from_picture(
        picture: PictureLevel, seen: RenderedPoses, visible: Tensor, light: FittedLight | None, every: Tensor,
        noise: ContourNoise, window: float = POSE.contour_window,
    ) -> Sides:  # fmt: skip
        """Measure the colours in the picture of a box, in windows of so many pixels; `visible` (N, h, w) weights the pixels,
        whose colours have the frequencies `every` (1, h, w) nearby."""
        alpha = smoothed_within(seen.alpha, noise.blur)
        image, curved = picture.outlined, picture.mask is None  # A mask's values mix as they are.
        near = picture.weight * visible
        behind = torch.zeros_like(image) if picture.background is None else picture.background
        front, front_variance, front_count = local_colors(
            image.expand(len(alpha), -1, -1, -1), (alpha > 1.0 - PURE) * near, window
        )
        back, back_variance, back_count = local_colors((image - behind).expand_as(front), (alpha < PURE) * near, window)
        known = (front_count > SUPPORT) & (back_count > SUPPORT) & (near > MIN_VISIBLE)
        a = alpha[:, None]
        if light is not None and curved:
            lit = smoothed_within(light.lit(seen).flatten(0, 1), noise.blur).reshape(front.shape) / a.clamp(min=PURE)
            sure = front_variance / (front_variance + light.deviation.square()[:, None, None, None] + 1e-8)
            front = torch.lerp(front - behind, linear_to_srgb(lit.clamp(0.0, 1.0)) - behind, sure) + behind
            front_variance = front_variance * (1.0 - sure)
        back = back + behind
        mixed, step = mixture(front, back, alpha) if curved else (back + a * (front - back), front - back)
        band = ((alpha > PURE) & (alpha < 1.0 - PURE) & known) * near
        kernel = POSE.color_kernel * math.sqrt(2.0 * math.pi)
        density = every.log() - (len(image) * math.log(kernel) if curved else 0.0)
        sides = Sides(alpha, front, back, front_variance, back_variance, band, mixed, step, front_variance, density)
        return sides.noisy(math.hypot(picture.noise, noise.deviation))

    def noisy(self, deviation: float) -> Sides:
        """Return the sides with this noise of pixels."""
        a = self.alpha[:, None]
        varied = a.square() * self.front_variance + (1.0 - a).square() * self.back_variance
        return self._replace(variance=varied + deviation**2)

    @property
    def contrast(self) -> Tensor:
        """The difference (N, h, w) of both sides, in standard deviations."""
        return ((self.front - self.back).square() / self.variance).sum(1).sqrt()

    def gain(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log likelihood ratio (N, h, w) of an image (C, h, w) to one whose pixels show the one side, the other, or
        any colour nearby, whichever is likeliest; and the probability that a pixel shows the mixture and nothing else."""
        e = POSE.occluded
        pure = [log_normal(image - side, self.variance) for side in (self.front, self.back)]
        reference = torch.maximum(torch.maximum(*pure), self.density)
        own = log_normal(image - self.mixed, self.variance) - reference + math.log(1.0 - e)
        total = torch.logaddexp(own, torch.full_like(own, math.log(e)))
        return total, (own - total).exp()

    def distance(self, other: Sides) -> float:
        """Return the root mean square difference of the mixtures of two renders, in standard deviations of the other's."""
        square = ((self.mixed - other.mixed).square() / other.variance).mean(1)
        return math.sqrt(float((self.band * square).sum() / self.band.sum().clamp(min=1e-12)))


def mixture(front: Tensor, back: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Return the display values (N, C, h, w) of two sides' radiances mixed by alpha (N, h, w), and their derivative by it."""
    inside, outside = (srgb_to_linear(side.clamp(0.0, 1.0)) for side in (front, back))
    mixed = linear_to_srgb((outside + alpha[:, None] * (inside - outside)).clamp(0.0, 1.0))
    return mixed, srgb_slope(mixed) * (inside - outside)


def log_normal(residual: Tensor, variance: Tensor) -> Tensor:
    """Return the log density (N, h, w) of normal residuals (N, C, h, w)."""
    return -0.5 * (residual.square() / variance + (2.0 * math.pi * variance).log()).sum(1)


def contour_rows(seen: RenderedPoses, blur: float) -> Tensor:
    """Return the derivatives (N, D, h · w) of silhouettes that are blurred by so many pixels."""
    return smoothed_within(seen.tangents.flatten(0, 1), blur).reshape(seen.tangents.shape).flatten(2).movedim(0, 1)


def contour_term(picture: PictureLevel, sides: Sides, gained: tuple[Tensor, Tensor], rows: Tensor) -> Term:
    """Return the term of N silhouettes, with derivatives `rows`, for the picture of their box; `gained` is what Sides.gain()
    says of it."""
    deviation, band = sides.variance.sqrt(), sides.band
    residual, step = (sides.mixed - picture.outlined) / deviation, sides.step / deviation
    gain, own = gained
    # One row of J serves all channels, whose slopes by alpha are `step`.
    strength = step.square().sum(1)
    along = (residual * step).sum(1) / strength.clamp(min=1e-12)
    weight = (own * band * strength).flatten(1)
    return Term.from_rows(band * gain, rows, weight, along.flatten(1))


def contour_noise(
    picture: PictureLevel, seen: RenderedPoses, visible: Tensor, light: FittedLight | None, every: Tensor
) -> ContourNoise:
    """Return the likeliest blur of the contour of one silhouette, and its deviation by that. An offset passes for a blur, so each
    blur is judged after the step of the pose that suits it best. All are compared in the pixels of the widest one."""
    band, found = None, list[tuple[float, ContourNoise]]()
    for blur in sorted(POSE.contour_blurs, reverse=True):
        sides = Sides.from_picture(picture, seen, visible, light, every, ContourNoise(blur, 0.0))
        band = sides.band if band is None else band
        rows = contour_rows(seen, blur)
        noisy = [sides.noisy(math.hypot(picture.noise, one))._replace(band=band) for one in POSE.contour_noises]
        terms = [contour_term(picture, one, one.gain(picture.outlined), rows) for one in noisy]
        _, deviation = min(zip((float(term.cost) for term in terms), POSE.contour_noises, strict=True))
        after = min(float(term.cost - term.predicted_gain) for term in terms)
        found.append((after, ContourNoise(blur, deviation)))
    return min(found)[1]
