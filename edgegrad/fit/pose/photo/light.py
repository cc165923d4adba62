"""The light term: inside the silhouette a picture is what the mesh's colours are in a light that is solved for.

Of a matte surface with the colour a and the normal n, a light that is far away makes a L·Y(n), with spherical harmonics Y up to
the second degree and nine coefficients L a channel (Ramamoorthi and Hanrahan, An Efficient Representation for Irradiance
Environment Maps, 2001); exposure and white balance are in L. The picture is linear in L, so the best L of a pose is known in
closed form, and is eliminated from the normal equations (variable projection, Golub and Pereyra 1973, as Kaufman 1975 has it).
Cast shadows and highlights are what the model lacks: pixels that differ hardly count.

As the pose moves, a point of the surface takes its colour along. With the flow u of the surface's points in the image,
∂(a L·Y)/∂p = −∇(a L·Y) · u + a L·∂Y/∂n ∂n/∂p, with ∇ the mean of the render's and the picture's slope, which makes a step right
to the second order (Malis, Improving Vision-Based Control Using Efficient Second-Order Minimization Techniques, 2004).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ...region import smoothed
from ..gauss_newton import Normal
from .picture import Picture
from .surface import Surface, slope

BLUR = 1.0  # pixels, of both
HARMONICS = 9
RIDGE = 5e-4  # of the constant's curvature: keeps what the picture does not show of the light near zero; more would bias poses
WHOLE = 0.9  # share of a blur's window that lies inside
FEWEST = 60  # pixels
REWEIGHTED = 4  # times
CLIPPED = 0.95  # linear radiance
LEAST = 0.02  # standard deviation of a difference
OUTLIER = 3.0  # deviations: differences that are far above this hardly count (Geman and McClure 1987)
# Differences of neighbouring pixels are alike, for shadows and highlights have an extent: so many pixels count as one.
TOGETHER = 8.0


@dataclass(frozen=True)
class Lit:
    """A surface in the light that fits a picture best."""

    surface: Surface
    predicted: Tensor  # (h, w, C) linear radiance, blurred
    coefficients: Tensor  # (C, n), of harmonics
    residual: Tensor  # (C, N) of the pixels inside, scaled
    count: Tensor  # (N,), how much a pixel counts
    robust: Tensor  # (N,), the same of those that differ no more than noise does
    deviation: float  # of a scaled difference
    _basis: Tensor  # (C, n, N), scaled
    _scale: Tensor  # (C, N)
    _slopes: Tensor  # (2, C, N)
    _ridge: Tensor  # (C, n)

    @staticmethod
    def of(picture: Picture, surface: Surface, harmonics: int) -> Lit | None:
        """With so many `harmonics`; 1 is an exposure alone. None where hardly anything is seen of the surface."""
        inside = surface.inside
        if int(inside.sum()) < FEWEST:
            return None
        # Channels come first here, where most of the time of a fit goes.
        colour = surface.channels["image"].float().movedim(-1, 0)
        Y = spherical(surface.normals)[..., :harmonics].movedim(-1, 0)
        C, (h, w) = len(colour), inside.shape
        pictured = _blurred_inside(picture.radiance.movedim(-1, 0), inside)
        basis = _blurred_inside((colour[:, None] * Y).flatten(0, 1), inside).reshape(C, harmonics, h, w)
        # The slope of the display's curve, about: noise and errors are even in its values.
        y = pictured[:, inside]
        scale = (y + 0.02 + 0.1 * y.mean()).clamp(min=1e-3).rsqrt()
        B, y = basis[:, :, inside] * scale[:, None], y * scale
        count = picture.weight[inside]
        # What a sensor shows as white may be any brighter colour.
        clipped = (pictured[:, inside] > CLIPPED) & bool(picture.radiance.max() <= 1.0)
        robust, residual, light, ridge, middle = count, -y, y.new_zeros(C, harmonics), y.new_zeros(C, harmonics), LEAST
        seen = y
        for _ in range(REWEIGHTED):
            weighted = B * robust
            curvature = weighted @ B.mT
            ridge = (RIDGE * curvature[:, :1, 0]).repeat(1, harmonics) + 1e-9
            ridge[:, 0] = 1e-9 + 1e-3 * ridge[:, 0]
            light = torch.linalg.solve(curvature + torch.diag_embed(ridge), weighted @ seen[..., None])[..., 0]
            shown = (light[:, None] @ B)[:, 0]
            seen = torch.where(clipped, torch.maximum(y, shown), y)
            residual = shown - seen
            e = residual.square().sum(0).sqrt()
            middle = max(_weighted_median(e, count) / _median(C), LEAST)
            robust = count * (1.0 + (e / (OUTLIER * middle)).square()).pow(-2)
        predicted = (light[:, None] @ basis.flatten(2)).reshape(C, h, w)
        slopes = slope(0.5 * (predicted + pictured))[..., inside]
        # Beside the rim a blur reaches fewer pixels, and slopes are too low.
        whole = smoothed(inside[None].float(), BLUR)[0][inside] > WHOLE
        image = predicted.movedim(0, -1)
        return Lit(surface, image, light, residual, count, robust * whole, middle, B, scale, slopes, ridge)

    def change(self) -> float:
        """How much the light changes the mesh's colours, in parts of them: 0 where it multiplies all of them by one number."""
        inside = self.surface.inside
        colour = self.surface.channels["image"].float()[inside]
        irradiance = spherical(self.surface.normals[inside])[..., : self.coefficients.shape[1]] @ self.coefficients.T
        lit = colour * irradiance
        gain = (lit * colour).sum() / colour.square().sum().clamp(min=1e-30)
        return float((lit - gain * colour).abs().mean() / (gain * colour).abs().mean().clamp(min=1e-30))

    def difference(self, light: Tensor) -> Tensor:
        """(N,): how far the picture inside is from the surface in another light (C, n), scaled as `residual` is."""
        off = ((light - self.coefficients)[:, None] @ self._basis)[:, 0] + self.residual
        return off.square().sum(0).sqrt()

    def loss(self, deviation: float) -> float:
        """−log of the likelihood of the picture inside, for differences of a standard deviation, in nats, less what noise alone
        leaves: of two poses, the one that shows less of the surface is no likelier for that."""
        channels, far = len(self.coefficients), OUTLIER * OUTLIER
        squares = self.residual.square().sum(0) / deviation**2
        excess = squares / (1.0 + squares / far) - channels / (1.0 + channels / far)
        return 0.5 * float((self.count * excess).sum()) / TOGETHER

    def term(self) -> Normal:
        """The equations of a step of the pose, of which those of the light are eliminated."""
        surface = self.surface
        inside, D = surface.inside, len(surface.motion)
        (x, y), n = surface.flow().unbind(-1), surface.normals[inside]
        turned = surface.motion.of_directions(n.double()).float()
        slopes_of_light = spherical_slopes(n, turned)[..., : self.coefficients.shape[1]]
        colour = surface.channels["image"].float()[inside].T
        curvature, gradient = torch.zeros(D, D), torch.zeros(D)
        for c, light in enumerate(self.coefficients):
            moved = x * self._slopes[0, c] + y * self._slopes[1, c]
            J = torch.cat([(colour[c] * (slopes_of_light @ light) - moved) * self._scale[c], self._basis[c]])
            A, b = (J * self.robust) @ J.T, (J * self.robust) @ self.residual[c]
            A[D:, D:] += torch.diag(self._ridge[c])
            b[D:] += self._ridge[c] * light
            eliminated = torch.linalg.solve(A[D:, D:], torch.cat([A[D:, :D], b[D:, None]], 1))
            curvature += A[:D, :D] - A[:D, D:] @ eliminated[:, :D]
            gradient += b[:D] - A[:D, D:] @ eliminated[:, D]
        information = 1.0 / (TOGETHER * self.deviation**2)
        return Normal(information * curvature.double(), information * gradient.double())


def spherical(n: Tensor) -> Tensor:
    """(…, 9) harmonics of directions (…, 3), up to factors."""
    x, y, z = n.unbind(-1)
    return torch.stack([torch.ones_like(x), x, y, z, x * y, y * z, 3.0 * z * z - 1.0, x * z, x * x - y * y], -1)


def spherical_slopes(n: Tensor, tangents: Tensor) -> Tensor:
    """(D, …, 9), derivatives of spherical(n) along tangents (D, …, 3)."""
    (x, y, z), (a, b, c) = n.unbind(-1), tangents.unbind(-1)
    parts = [a * 0.0, a, b, c, a * y + x * b, b * z + y * c, 6.0 * z * c, a * z + x * c, 2.0 * (x * a - y * b)]
    return torch.stack(parts, -1)


def _weighted_median(values: Tensor, weights: Tensor) -> float:
    """Of (N,): what is known to be covered may be most of a surface."""
    if bool((weights == weights[0]).all()):
        return float(values.median())
    ordered, order = values.sort()
    below = weights[order].cumsum(0)
    return float(ordered[torch.searchsorted(below, 0.5 * below[-1]).clamp(max=len(values) - 1)])


def _median(channels: int) -> float:
    """Of the length of so many normal numbers of variance 1 (Wilson and Hilferty, The Distribution of Chi-Square, 1931)."""
    return math.sqrt(channels * (1.0 - 2.0 / (9.0 * channels)) ** 3)


def _blurred_inside(images: Tensor, inside: Tensor) -> Tensor:
    """Of images (n, h, w), blurred, the mean of what lies inside."""
    share = inside.float()
    return smoothed(images * share, BLUR) / smoothed(share[None], BLUR).clamp(min=1e-3)
