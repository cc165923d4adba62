"""The contour term: across the silhouette a picture changes from the object's colour to the background's (contour_colors.py).

Variances of the two sides weight the difference. The region term decides on which side of the contour a pixel lies; this term
measures its share of each side. Blurred pixels are mixtures, which neither histogram contains.
"""

from __future__ import annotations

from torch import Tensor

from ...contour_colors import TOLERANCE, ContourColors
from ..gauss_newton import NormalEquations
from .picture import Picture

MIN_CONTOUR_PIXELS = 20


def contour_loss(picture: Picture, sides: ContourColors) -> float:
    """Return half the robust squares of the contour's differences, in variances, less their expectation from noise, so that
    longer contours are no less likely."""
    squares = ((sides.mixed - picture.outlined).square() / sides.variance).sum(-1)
    channels = picture.outlined.shape[-1]
    excess = squares / (1.0 + squares / TOLERANCE) - channels / (1.0 + channels / TOLERANCE)
    return 0.5 * float((sides.band * picture.weight * excess).sum())


def contour_term(picture: Picture, sides: ContourColors, tangents: Tensor) -> NormalEquations | None:
    """Return the equations of alpha's derivatives (n, h, w), blurred as alpha was; None where there is hardly any contour."""
    band = sides.band
    if int(band.sum()) < MIN_CONTOUR_PIXELS:
        return None
    deviation = sides.variance[band].sqrt()
    residual = (sides.mixed - picture.outlined)[band] / deviation
    step = sides.slope_by(sides.alpha)[band] / deviation
    robust = (1.0 + residual.square().sum(-1) / TOLERANCE).pow(-2) * picture.weight[band]
    J = tangents[:, band].double()
    curvature = (J * (robust * step.square().sum(-1))) @ J.T
    return NormalEquations(curvature, J @ (robust * (residual * step).sum(-1)).double())
