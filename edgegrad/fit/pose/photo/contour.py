"""The contour term: across the silhouette a picture changes from the object's colour to that of what lies behind (sides.py).

Variances of the two sides weigh the difference. Where the region term tells on which side of the contour a pixel lies, this
tells to which part: blurred pixels are mixtures, and belong to neither histogram.
"""

from __future__ import annotations

from torch import Tensor

from ...contour_colors import TOLERANCE, ContourColors
from ..gauss_newton import Normal
from .picture import Picture

FEWEST = 20  # pixels on the contour


def contour_loss(picture: Picture, sides: ContourColors) -> float:
    """Of the contour's pixels, half the robust squares of the differences, in variances, less what noise alone leaves of them:
    poses whose contours are longer are no less likely for that."""
    squares = ((sides.mixed - picture.outlined).square() / sides.variance).sum(-1)
    channels = picture.outlined.shape[-1]
    excess = squares / (1.0 + squares / TOLERANCE) - channels / (1.0 + channels / TOLERANCE)
    return 0.5 * float((sides.band * picture.weight * excess).sum())


def contour_term(picture: Picture, sides: ContourColors, tangents: Tensor) -> Normal | None:
    """The equations of alpha's derivatives (n, h, w), blurred as alpha was; None where there is hardly any contour."""
    band = sides.band
    if int(band.sum()) < FEWEST:
        return None
    deviation = sides.variance[band].sqrt()
    residual = (sides.mixed - picture.outlined)[band] / deviation
    step = sides.slope_by(sides.alpha)[band] / deviation
    robust = (1.0 + residual.square().sum(-1) / TOLERANCE).pow(-2) * picture.weight[band]
    J = tangents[:, band].double()
    curvature = (J * (robust * step.square().sum(-1))) @ J.T
    return Normal(curvature, J @ (robust * (residual * step).sum(-1)).double())
