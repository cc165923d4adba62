"""The light term: inside the silhouette a picture is the mesh's colours in a fitted light.

A matte surface with the colour a and the normal n reflects a L·Y(n) of distant light, with spherical harmonics Y up to the
second degree and nine coefficients L a channel (Ramamoorthi and Hanrahan, An Efficient Representation for Irradiance
Environment Maps, 2001); L includes exposure and white balance. The picture is linear in L, so a pose's best L has a closed
form and is eliminated from the normal equations (variable projection, Golub and Pereyra 1973, in Kaufman's form, 1975). The
model lacks cast shadows and highlights: pixels that differ hardly count.

As the pose moves, a point of the surface takes its colour along. With the flow u of the surface's points in the image, ∂(a
L·Y)/∂p = −∇(a L·Y) · u + a L·∂Y/∂n ∂n/∂p. Here ∇ is the mean of the render's and the picture's slope, which makes a step
right to the second order (Malis, Improving Vision-Based Control Using Efficient Second-Order Minimization Techniques, 2004).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ....scene.spherical_harmonics import UNSCALED, harmonics, harmonics_jvp
from ...region import smoothed
from ..gauss_newton import NormalEquations
from .picture import Picture
from .surface_interior import SurfaceInterior, slope

LIGHT_BLUR = 1.0  # pixels, of picture and render
HARMONICS = 9
# Relative to the constant's curvature: keeps light that the picture does not show near zero; more would bias poses.
LIGHT_RIDGE = 5e-4
WINDOW_INSIDE = 0.9  # share of a blur's window that must lie inside
MIN_LIT_PIXELS = 60
LIGHT_ITERATIONS = 4
CLIPPED = 0.95  # linear radiance
MIN_LIGHT_NOISE = 0.02  # least standard deviation of a difference
OUTLIER_DEVIATIONS = 3.0  # Differences far above hardly count (Geman and McClure 1987).
# Differences of neighbouring pixels correlate, since shadows and highlights are extended: so many pixels count as one.
CORRELATED_LIGHT_PIXELS = 8.0


@dataclass(frozen=True)
class FittedLight:
    """A surface in the light that fits a picture best."""

    surface: SurfaceInterior
    predicted: Tensor  # (h, w, C) linear radiance, blurred
    coefficients: Tensor  # (C, n), of harmonics
    residual: Tensor  # (C, N) of the pixels inside, scaled
    count: Tensor  # (N,), weights of pixels
    robust: Tensor  # (N,), weights of pixels, near zero for outliers
    deviation: float  # standard deviation of scaled differences
    _basis: Tensor  # (C, n, N), scaled
    _scale: Tensor  # (C, N)
    _slopes: Tensor  # (2, C, N)
    _ridge: Tensor  # (C, n)

    @staticmethod
    def from_picture(picture: Picture, surface: SurfaceInterior, harmonics: int) -> FittedLight | None:
        """Fit so many `harmonics`; 1 is an exposure alone. None where hardly anything of the surface is seen."""
        inside = surface.inside
        if int(inside.sum()) < MIN_LIT_PIXELS:
            return None
        # Channels come first, for speed: most time of a fit goes here.
        color = surface.channels["image"].float().movedim(-1, 0)
        Y = harmonics_of(surface.normals)[..., :harmonics].movedim(-1, 0)
        C, (h, w) = len(color), inside.shape
        pictured = _blurred_inside(picture.radiance.movedim(-1, 0), inside)
        basis = _blurred_inside((color[:, None] * Y).flatten(0, 1), inside).reshape(C, harmonics, h, w)
        # The scale is about the slope of the display's curve, by which noise and errors are uniform.
        y = pictured[:, inside]
        scale = (y + 0.02 + 0.1 * y.mean()).clamp(min=1e-3).rsqrt()
        B, y = basis[:, :, inside] * scale[:, None], y * scale
        count = picture.weight[inside]
        # Clipped white may be any brighter colour.
        clipped = (pictured[:, inside] > CLIPPED) & bool(picture.radiance.max() <= 1.0)
        light = ridge = y.new_zeros(C, harmonics)
        robust, residual, middle, seen = count, -y, MIN_LIGHT_NOISE, y
        for _ in range(LIGHT_ITERATIONS):
            weighted = B * robust
            curvature = weighted @ B.mT
            ridge = (LIGHT_RIDGE * curvature[:, :1, 0]).repeat(1, harmonics) + 1e-9
            ridge[:, 0] = 1e-9 + 1e-3 * ridge[:, 0]
            light = torch.linalg.solve(curvature + torch.diag_embed(ridge), weighted @ seen[..., None])[..., 0]
            shown = (light[:, None] @ B)[:, 0]
            seen = torch.where(clipped, torch.maximum(y, shown), y)
            residual = shown - seen
            e = residual.square().sum(0).sqrt()
            middle = max(_weighted_median(e, count) / _median(C), MIN_LIGHT_NOISE)
            robust = count * (1.0 + (e / (OUTLIER_DEVIATIONS * middle)).square()).pow(-2)
        predicted = (light[:, None] @ basis.flatten(2)).reshape(C, h, w)
        slopes = slope(0.5 * (predicted + pictured))[..., inside]
        # Near the silhouette a blur reaches fewer pixels, and slopes are too low.
        whole = smoothed(inside[None].float(), LIGHT_BLUR)[0][inside] > WINDOW_INSIDE
        image = predicted.movedim(0, -1)
        return FittedLight(surface, image, light, residual, count, robust * whole, middle, B, scale, slopes, ridge)

    def change(self) -> float:
        """Return the relative change of the mesh's colours by the light: 0 where one number multiplies all of them."""
        inside = self.surface.inside
        color = self.surface.channels["image"].float()[inside]
        irradiance = harmonics_of(self.surface.normals[inside])[..., : self.coefficients.shape[1]] @ self.coefficients.T
        lit = color * irradiance
        gain = (lit * color).sum() / color.square().sum().clamp(min=1e-30)
        return float((lit - gain * color).abs().mean() / (gain * color).abs().mean().clamp(min=1e-30))

    def difference(self, light: Tensor) -> Tensor:
        """Return the differences (N,) between the picture and the surface in another light (C, n), scaled like `residual`."""
        off = ((light - self.coefficients)[:, None] @ self._basis)[:, 0] + self.residual
        return off.square().sum(0).sqrt()

    def loss(self, deviation: float) -> float:
        """Return −log likelihood of the picture inside, in nats, for differences of this standard deviation, less its
        expectation from noise, so that showing less of the surface is no likelier."""
        channels, far = len(self.coefficients), OUTLIER_DEVIATIONS * OUTLIER_DEVIATIONS
        squares = self.residual.square().sum(0) / deviation**2
        excess = squares / (1.0 + squares / far) - channels / (1.0 + channels / far)
        return 0.5 * float((self.count * excess).sum()) / CORRELATED_LIGHT_PIXELS

    def term(self) -> NormalEquations:
        """Return the equations of a step of the pose, with the light's eliminated."""
        surface = self.surface
        inside, D = surface.inside, len(surface.motion)
        (x, y), n = surface.flow().unbind(-1), surface.normals[inside]
        turned = surface.motion.of_directions(n.double()).float()
        slopes_of_light = _x_first(harmonics_jvp(n, turned))[..., : self.coefficients.shape[1]]
        color = surface.channels["image"].float()[inside].T
        curvature, gradient = torch.zeros(D, D, dtype=torch.float32), torch.zeros(D, dtype=torch.float32)
        for c, light in enumerate(self.coefficients):
            moved = x * self._slopes[0, c] + y * self._slopes[1, c]
            J = torch.cat([(color[c] * (slopes_of_light @ light) - moved) * self._scale[c], self._basis[c]])
            A, b = (J * self.robust) @ J.T, (J * self.robust) @ self.residual[c]
            A[D:, D:] += torch.diag(self._ridge[c])
            b[D:] += self._ridge[c] * light
            eliminated = torch.linalg.solve(A[D:, D:], torch.cat([A[D:, :D], b[D:, None]], 1))
            curvature += A[:D, :D] - A[:D, D:] @ eliminated[:, :D]
            gradient += b[:D] - A[:D, D:] @ eliminated[:, D]
        information = 1.0 / (CORRELATED_LIGHT_PIXELS * self.deviation**2)
        return NormalEquations(information * curvature.double(), information * gradient.double())


def harmonics_of(n: Tensor) -> Tensor:
    """Return the harmonics (…, 9) of directions (…, 3), up to factors."""
    return _x_first(harmonics(n, UNSCALED))


def _x_first(terms: list[Tensor]) -> Tensor:
    """Stack harmonics with those of the first degree in the order x, y, z."""
    one, y, z, x, *second = terms
    return torch.stack([one, x, y, z, *second], -1)


def _weighted_median(values: Tensor, weights: Tensor) -> float:
    """Return the weighted median of (N,): known occluders may cover most of a surface."""
    if bool((weights == weights[0]).all()):
        return float(values.median())
    ordered, order = values.sort()
    below = weights[order].cumsum(0)
    return float(ordered[torch.searchsorted(below, 0.5 * below[-1]).clamp(max=len(values) - 1)])


def _median(channels: int) -> float:
    """Return the median length of so many normal numbers of variance 1 (Wilson and Hilferty, The Distribution of Chi-Square,
    1931)."""
    return math.sqrt(channels * (1.0 - 2.0 / (9.0 * channels)) ** 3)


def _blurred_inside(images: Tensor, inside: Tensor) -> Tensor:
    """Blur images (n, h, w) by the mean of what lies inside."""
    share = inside.float()
    return smoothed(images * share, LIGHT_BLUR) / smoothed(share[None], LIGHT_BLUR).clamp(min=1e-3)
