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

from ..gauss_newton import Normal
from .picture import Picture, smoothed
from .surface import Surface, slope

BLUR = 1.0  # pixels, of both
HARMONICS = 9
RIDGE = 5e-4  # of the constant's curvature: keeps what the picture does not show of the light near zero; more would bias poses
WHOLE = 0.9  # share of a blur's window that lies inside
FEWEST = 60  # pixels
REWEIGHTED = 4  # times
CLIPPED = 0.95  # linear radiance
LEAST = 0.02  # standard deviation of a difference
# Differences of neighbouring pixels are alike, for shadows and highlights have an extent: so many pixels count as one.
TOGETHER = 8.0


@dataclass(frozen=True)
class Lit:
    """A surface in the light that fits a picture best."""

    surface: Surface
    predicted: Tensor  # (h, w, C) linear radiance, blurred
    coefficients: Tensor  # (C, n), of harmonics
    residual: Tensor  # (N, C) of the pixels inside, scaled
    robust: Tensor  # (N,) weights
    deviation: float  # of a scaled difference
    _basis: Tensor  # (N, C, n), scaled
    _scale: Tensor  # (N, C)
    _slopes: Tensor  # (N, C, 2)
    _ridge: Tensor  # (C, n)

    @staticmethod
    def of(picture: Picture, surface: Surface, harmonics: int) -> Lit | None:
        """With so many `harmonics`; 1 is an exposure alone. None where hardly anything is seen of the surface."""
        inside = surface.inside
        if int(inside.sum()) < FEWEST:
            return None
        colour, Y = surface.channels["image"].float(), spherical(surface.normals)[..., :harmonics]
        pictured = _blurred_inside(picture.radiance, inside)
        basis = torch.stack([_blurred_inside(one[..., None] * Y, inside) for one in colour.unbind(-1)], -2)
        # The slope of the display's curve, about: noise and errors are even in its values.
        scale = (pictured + 0.02 + 0.1 * pictured[inside].mean()).clamp(min=1e-3).rsqrt()[inside]
        B, y = basis[inside] * scale[..., None], pictured[inside] * scale
        count = picture.weight[inside]
        w, counted = count, count >= 0.5 * count.max()
        light = y.new_zeros(colour.shape[-1], harmonics)
        ridge = torch.zeros_like(light)
        residual, middle = -y, LEAST
        # What a sensor shows as white may be any brighter colour.
        clipped = (pictured[inside] > CLIPPED) & bool(picture.radiance.max() <= 1.0)
        seen = y
        for _ in range(REWEIGHTED):
            for c in range(len(light)):
                curvature = (B[:, c] * w[:, None]).T @ B[:, c]
                ridge[c] = RIDGE * curvature[0, 0] + 1e-9
                ridge[c, 0] = 1e-9 + 1e-3 * ridge[c, 0]
                light[c] = torch.linalg.solve(curvature + torch.diag(ridge[c]), (B[:, c] * w[:, None]).T @ seen[:, c])
            shown = torch.einsum("pcn,cn->pc", B, light)
            seen = torch.where(clipped, torch.maximum(y, shown), y)
            residual = shown - seen
            e = residual.norm(dim=-1)
            middle = max(float(e[counted].median()) / _median(len(light)), LEAST)
            w = count * (1.0 + (e / (3.0 * middle)).square()).pow(-2)
        predicted = torch.einsum("hwcn,cn->hwc", basis, light)
        slopes = slope(0.5 * (predicted + pictured))[inside]
        # Beside the rim a blur reaches fewer pixels, and slopes are too low.
        whole = smoothed(inside[None].float(), BLUR)[0][inside] > WHOLE
        return Lit(surface, predicted, light, residual, w * whole, middle, B, scale, slopes, ridge)

    @property
    def change(self) -> float:
        """How much the light changes the mesh's colours, in parts of them: 0 where it leaves them as they are."""
        inside = self.surface.inside
        colour = self.surface.channels["image"].float()[inside]
        irradiance = spherical(self.surface.normals[inside])[..., : self.coefficients.shape[1]] @ self.coefficients.T
        return float((colour * (irradiance - 1.0)).abs().mean() / colour.abs().mean().clamp(min=1e-30))

    def difference(self, light: Tensor) -> Tensor:
        """(N,): how far the picture inside is from the surface in another light (C, n), scaled as `residual` is."""
        return (torch.einsum("pcn,cn->pc", self._basis, light - self.coefficients) + self.residual).norm(dim=-1)

    def term(self) -> Normal:
        """The equations of a step of the pose, of which those of the light are eliminated."""
        surface = self.surface
        inside, D = surface.inside, len(surface.motion)
        flow, n = surface.flow(), surface.normals[inside]
        turned = surface.motion.of_directions(n.double()).float()
        slopes_of_light = spherical_slopes(n, turned)[..., : self.coefficients.shape[1]]
        colour = surface.channels["image"].float()[inside]
        curvature, gradient = torch.zeros(D, D), torch.zeros(D)
        for c, light in enumerate(self.coefficients):
            by_pose = (colour[:, c] * (slopes_of_light @ light) - (flow * self._slopes[:, c]).sum(-1)) * self._scale[
                :, c
            ]
            J = torch.cat([by_pose, self._basis[:, c].T])
            A, b = (J * self.robust) @ J.T, (J * self.robust) @ self.residual[:, c]
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


def _median(channels: int) -> float:
    """Of the length of so many normal numbers of variance 1 (Wilson and Hilferty, The Distribution of Chi-Square, 1931)."""
    return math.sqrt(channels * (1.0 - 2.0 / (9.0 * channels)) ** 3)


def _blurred_inside(image: Tensor, inside: Tensor) -> Tensor:
    """(h, w, C), the mean of what lies inside."""
    share = inside.float()
    count = smoothed(share[None], BLUR)[0].clamp(min=1e-3)
    return (smoothed(image.movedim(-1, 0) * share, BLUR) / count).movedim(0, -1)
