"""The contour term: across the silhouette a picture changes from the object's colour to that of what lies behind.

A pixel that is covered by the share α shows α F + (1 − α) B, with the colours F of the object and B of what is behind it, which
are the means of the picture a little inside and a little outside. Both vary there by their textures, whose variances weigh the
difference. Where the region term tells on which side of the contour a pixel lies, this tells to which part: blurred pixels are
mixtures, and belong to neither histogram.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ..gauss_newton import Normal
from .picture import Picture, smoothed

REACH = 2.0  # pixels: standard deviation of the windows that colours are taken from
NOISE = 0.03  # standard deviation of a pixel, sRGB values
PURE = 0.03  # share of the other side in a pixel of one side alone
SUPPORT = 0.03  # of a window
TOLERANCE = 12.0  # squared differences, in variances, that are far above this hardly count (Geman and McClure 1987)
FEWEST = 20  # pixels on the contour


@dataclass(frozen=True)
class Sides:
    """The colours beside a contour, of a blurred alpha (h, w)."""

    alpha: Tensor  # (h, w)
    inside: Tensor  # (h, w, C)
    outside: Tensor
    variance: Tensor  # (h, w, C) of their mixture
    band: Tensor  # (h, w) bool: where it is mixed, and both sides are known

    @staticmethod
    def of(picture: Picture, alpha: Tensor, near: Tensor) -> Sides:
        """`near` (h, w): what may be used of the picture."""
        front, front_spread, front_count = _local(picture.outlined, (alpha > 1.0 - PURE) * near)
        behind, behind_spread, behind_count = _local(picture.outlined, (alpha < PURE) * near)
        known = (front_count > SUPPORT) & (behind_count > SUPPORT) & (near > 0.0)
        a = alpha[..., None]
        variance = NOISE**2 + a.square() * front_spread + (1.0 - a).square() * behind_spread
        return Sides(alpha, front, behind, variance, (alpha > PURE) & (alpha < 1.0 - PURE) & known)

    @property
    def mixed(self) -> Tensor:
        """(h, w, C), what the picture shows there if the contour is right."""
        return self.outside + self.alpha[..., None] * (self.inside - self.outside)

    @property
    def contrast(self) -> Tensor:
        """(h, w): the difference of both sides, in standard deviations."""
        return ((self.inside - self.outside).square() / self.variance).sum(-1).sqrt()


def contour_term(picture: Picture, sides: Sides, tangents: Tensor) -> Normal | None:
    """The equations of alpha's derivatives (n, h, w), blurred as alpha was; None where there is hardly any contour."""
    band = sides.band
    if int(band.sum()) < FEWEST:
        return None
    deviation = sides.variance[band].sqrt()
    residual = (sides.mixed - picture.outlined)[band] / deviation
    step = (sides.inside - sides.outside)[band] / deviation
    robust = (1.0 + residual.square().sum(-1) / TOLERANCE).pow(-2) * picture.weight[band]
    J = tangents[:, band].double()
    curvature = (J * (robust * step.square().sum(-1))) @ J.T
    return Normal(curvature, J @ (robust * (residual * step).sum(-1)).double())


def _local(image: Tensor, share: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and variance (h, w, C) of the pixels around each that `share` (h, w) counts, and how many (h, w) of a window."""
    rows = image.movedim(-1, 0)
    count = smoothed(share.to(image)[None], REACH)[0]
    enough = count.clamp(min=1e-4)
    mean = smoothed(rows * share, REACH) / enough
    square = smoothed(rows.square() * share, REACH) / enough
    return mean.movedim(0, -1), (square - mean.square()).clamp(min=0.0).movedim(0, -1), count
