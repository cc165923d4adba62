"""The light term: inside the silhouette a picture is the mesh's colours in a light that is solved for.

A matte surface with the colour a and the normal n reflects a L·Y(n) of distant light, with spherical harmonics Y up to the
second degree and nine coefficients L a channel (Ramamoorthi and Hanrahan, An Efficient Representation for Irradiance
Environment Maps, 2001); L includes exposure and white balance. The picture is linear in L, so a pose's best L has a closed form
and is eliminated from the normal equations (variable projection, Golub and Pereyra 1973, in Kaufman's form, 1975). Rotations
map harmonics of one degree to one another, so L may be of light that turns with the mesh: only the flow u of the surface's
points moves the picture, ∂(a L·Y)/∂p = −∇(a L·Y) · u. Here ∇ is the mean of the render's and the picture's slope, which makes
a step right to the second order (Malis, Improving Vision-Based Control Using Efficient Second-Order Minimization, 2004).

A pixel is the object's with the density N(r; σ) of its difference r, or with a small probability something that covers it,
with the density of the colours inside the silhouette nearby. Since occluders are larger than a pixel, pixels decide together
in a window. The cost is −log of the mixture's ratio to that density, so that with the region term colours count once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ....scene.spherical_harmonics import UNSCALED, harmonics
from ...region import smoothed
from ..settings import POSE
from .picture import PictureLevel, RenderedPoses
from .term import Term

HARMONICS = 9
MIN_PIXEL_ALPHA = 0.98  # least alpha of an inner pixel and its neighbours
WINDOW_INSIDE = 0.9  # share of a blur's window that must lie inside


class FittedLight(NamedTuple):
    """N surfaces, each in the light that fits a picture best; M pixels of a box, which show any of them."""

    inside: Tensor  # (N, h, w) bool
    at: Tensor  # (M,), numbers of the pixels
    known: Tensor  # (N,) bool: enough of the surface is seen to show its light
    coefficients: Tensor  # (N, C, n), of harmonics
    predicted: Tensor  # (N, C, M), linear radiance, blurred
    residual: Tensor  # (N, C, M), scaled
    weight: Tensor  # (N, M), of pixels
    robust: Tensor  # (N, M), weights of pixels, the probability that they show the surface
    deviation: Tensor  # (N,), of scaled differences
    likely: Tensor  # (N, M), log likelihood ratio to the colours nearby
    visible: Tensor  # (N, h, w), probability that nothing covers the pixel
    basis: Tensor  # (N, C, n, M), scaled
    scale: Tensor  # (N, C, M)
    slopes: Tensor  # (2, N, C, M)
    ridge: Tensor  # (N, C, n)

    @staticmethod
    def from_picture(
        picture: PictureLevel, seen: RenderedPoses, harmonic_count: int, colors: Tensor, deviation: float | None
    ) -> FittedLight | None:  # fmt: skip
        """Fit so many harmonics to the picture of a box; 1 is an exposure alone.

        colors     (N, h, w), frequencies of the pixels' colours inside nearby
        deviation  of differences, where that is known; None: each pose's own

        None where hardly anything of any surface is seen.
        """
        assert seen.color is not None and seen.normal is not None
        inside = inner_pixels(seen.alpha)
        known = inside.sum((1, 2)) >= POSE.min_light_pixels
        if not bool(known.any()):
            return None
        (N, h, w), C, n = inside.shape, seen.color.shape[1], harmonic_count
        near = F.max_pool2d(inside.any(0).float()[None], 3, 1, 1)  # Slopes need the neighbours.
        at = near.flatten().nonzero()[:, 0]
        share = inside.float()
        Y = harmonics_of(seen.normal, n)
        under = smoothed(share, POSE.light_blur)
        mean = under.clamp(min=1e-3).reciprocal()  # of what lies inside a window
        pictured = smoothed((picture.radiance * share[:, None]).flatten(0, 1), POSE.light_blur)
        pictured = pictured.reshape(N, C, h, w) * mean[:, None]
        lit = seen.color[:, :, None] * Y[:, None] * share[:, None, None]
        basis = smoothed(lit.flatten(0, 2), POSE.light_blur).flatten(1)[:, at].reshape(N, C, n, -1)
        basis, flat = basis * mean.flatten(1)[:, None, None, at], share.flatten(1)[:, at]
        shown = pictured.flatten(2)[..., at]
        # The scale is about the slope of the display's curve, by which noise and errors are uniform.
        middle = (shown * flat[:, None]).sum((1, 2)) / (C * flat.sum(1)).clamp(min=1.0)
        scale = (shown + 0.02 + 0.1 * middle[:, None, None]).clamp(min=1e-3).rsqrt() * flat[:, None]
        B, target = basis * scale[:, :, None], shown * scale
        count = (picture.weight * share).flatten(1)[:, at]
        clipped = (shown > POSE.clipped) & bool(picture.radiance.max() <= 1.0)
        density = colors.flatten(1)[:, at].clamp(min=1e-6).log() - C * math.log(
            POSE.color_kernel * math.sqrt(2.0 * math.pi)
        )
        window = smoothed(share, POSE.occluder_width).clamp(min=1e-3)
        robust, own, wanted = count, torch.ones(N, dtype=torch.float32), target
        residual, visible = -target, share
        light = ridge = target.new_zeros(N, C, n)
        likely, used = torch.zeros_like(count), own
        for _ in range(POSE.light_rounds):
            weighted = B * robust[:, None, None]
            curvature = weighted @ B.mT
            ridge = (POSE.light_ridge * curvature[..., :1, 0]).repeat(1, 1, n) + 1e-9
            ridge[..., 0] = 1e-9 + 1e-3 * ridge[..., 0]
            light = torch.linalg.solve(curvature + torch.diag_embed(ridge), weighted @ wanted[..., None])[..., 0]
            fitted = (light[:, :, None] @ B)[:, :, 0]
            wanted = torch.where(
                clipped, torch.maximum(target, fitted), target
            )  # Clipped white may be any brighter colour.
            residual = fitted - wanted
            size = residual.square().sum(1).sqrt()
            own = weighted_median(size, count * visible.flatten(1)[:, at], flat) / _median_length(C)
            own = own.clamp(min=POSE.min_light_noise)
            used = own if deviation is None else torch.full_like(own, deviation)
            likely = _log_normal(size, used, C) - density
            visible = _visible(_spread(likely, at, (h, w)), inside, window)
            tail = (1.0 + (size / (POSE.tail * own[:, None])).square()).pow(-2)
            robust = count * visible.flatten(1)[:, at] * tail
        predicted = (light[:, :, None] @ basis)[:, :, 0]
        slopes = slope(0.5 * (_spread(predicted, at, (h, w)) + pictured)).flatten(3)[..., at]
        # Near the silhouette a blur reaches fewer pixels, and slopes are too low.
        whole = (under > WINDOW_INSIDE).flatten(1)[:, at]
        # Along the silhouette a blur mixes the contours of object and occluder, so a margin counts as occluded.
        hidden = F.max_pool2d(torch.where(inside, 1.0 - visible, 0.0)[:, None], 5, 1, 2)[:, 0]
        visible = 1.0 - torch.where(inside, 1.0 - visible, hidden) * known[:, None, None]
        # The cost's derivative by a difference is the difference times this, the mixture's posterior.
        own_share = torch.sigmoid(likely + math.log(1.0 / POSE.occluded - 1.0))
        robust = count * own_share * visible.flatten(1)[:, at] * whole * known[:, None]
        return FittedLight(
            inside, at, known, light, predicted, residual, count, robust, used, likely, visible, B, scale, slopes, ridge
        )

    def image(self, values: Tensor) -> Tensor:
        """Return images (…, h, w) of pixels (…, M), zero elsewhere."""
        return _spread(values, self.at, self.inside.shape[1:])

    def lit(self, seen: RenderedPoses) -> Tensor:
        """Return the radiance (N, C, h, w) of the surfaces in their light, times alpha."""
        assert seen.color is not None and seen.normal is not None
        Y = harmonics_of(seen.normal, self.coefficients.shape[2])
        return (seen.color * torch.einsum("nck,nkhw->nchw", self.coefficients, Y)).clamp(min=0.0)

    def term(self, flow: Tensor, tangents: Tensor | None = None) -> Term:
        """Return the term of the surfaces, whose points move by `flow` (D, N, 2, h, w), and their silhouettes by `tangents`
        (D, N, h, w), with the light's numbers eliminated."""
        e = POSE.occluded
        gain = ((1.0 - e) * self.likely.clamp(max=20.0).exp() + e).log()
        cost = -(self.weight * gain).sum(1) / POSE.correlated_light * self.known
        D, N, C = len(flow), len(self.inside), self.residual.shape[1]
        x, y = flow.flatten(3)[..., self.at].movedim(0, 1).unbind(2)  # (N, D, M)
        gradient, curvature = torch.zeros(N, D, dtype=torch.float32), torch.zeros(N, D, D, dtype=torch.float32)
        kept: list[
            tuple[Tensor, Tensor]
        ] = []  # of each channel: derivatives without what the light makes up for, residuals
        for c in range(C):
            moved = -(x * self.slopes[0, :, None, c] + y * self.slopes[1, :, None, c]) * self.scale[:, None, c]
            J = torch.cat([moved, self.basis[:, c]], 1)
            weighted = J * self.robust[:, None]
            A, b = weighted @ J.mT, (weighted @ self.residual[:, c, :, None])[..., 0]
            A[:, D:, D:] += torch.diag_embed(self.ridge[:, c])
            b[:, D:] += self.ridge[:, c] * self.coefficients[:, c]
            eliminated = torch.linalg.solve(A[:, D:, D:], torch.cat([A[:, D:, :D], b[:, D:, None]], 2))
            curvature += A[:, :D, :D] - A[:, :D, D:] @ eliminated[..., :D]
            gradient += b[:, :D] - (A[:, :D, D:] @ eliminated[..., D:])[..., 0]
            kept.append((moved - eliminated[..., :D].mT @ self.basis[:, c], self.robust * self.residual[:, c]))
        information = 1.0 / (POSE.correlated_light * self.deviation.double().square())
        gradient = information[:, None] * gradient
        if tangents is not None:
            gradient -= self._growth(gain, tangents)

        def summands() -> Tensor:
            total = sum((rows * pull[:, None] for rows, pull in kept[1:]), kept[0][0] * kept[0][1][:, None])
            return self.image(information[:, None, None].float() * total)

        return Term(cost.double(), gradient, information[:, None, None] * curvature, summands)

    def _growth(self, gain: Tensor, tangents: Tensor) -> Tensor:
        """Return by how much the gain (N, M) of pixels grows (N, D) as the silhouette, which moves by `tangents` (D, N, h, w),
        takes in others that are like those along it."""
        # Where a window has next to no inner pixels, the silhouette takes in nothing that is known.
        near = smoothed(self.image(self.weight * gain), POSE.contour_window)
        mean = near / smoothed(self.inside.float(), POSE.contour_window).clamp(min=0.02)
        return (mean * tangents).sum((2, 3)).T * (self.known / POSE.correlated_light)[:, None]


def harmonics_of(normals: Tensor, count: int) -> Tensor:
    """Return the first harmonics (N, count, h, w), up to factors, of directions (N, 3, h, w) of any length."""
    one, y, z, x, *second = harmonics(F.normalize(normals, dim=1, eps=1e-6).movedim(1, -1), UNSCALED)
    return torch.stack([one, x, y, z, *second], 1)[:, :count]


def _spread(values: Tensor, at: Tensor, size: tuple[int, ...]) -> Tensor:
    """Return images (…, h, w) of the values (…, M) of some pixels, zero elsewhere."""
    h, w = size
    return values.new_zeros(*values.shape[:-1], h * w).index_copy(-1, at, values).reshape(*values.shape[:-1], h, w)


def slope(image: Tensor) -> Tensor:
    """Return central differences (2, …, h, w), by columns and rows, of images (…, h, w)."""
    p = F.pad(image.flatten(0, -3)[None], (1, 1, 1, 1), mode="replicate")[0]
    found = 0.5 * torch.stack([p[:, 1:-1, 2:] - p[:, 1:-1, :-2], p[:, 2:, 1:-1] - p[:, :-2, 1:-1]])
    return found.reshape(2, *image.shape)


def inner_pixels(alpha: Tensor) -> Tensor:
    """Return which pixels of silhouettes (N, h, w) are covered with all their neighbours."""
    return F.max_pool2d((alpha < MIN_PIXEL_ALPHA).float()[:, None], 3, 1, 1)[:, 0] == 0.0


def _visible(likely: Tensor, inside: Tensor, window: Tensor) -> Tensor:
    """Return the probability (N, h, w) that a pixel inside shows the surface, by the mean log likelihood ratio around it."""
    clamped = torch.where(inside, likely.clamp(-POSE.max_pixel_nats, POSE.max_pixel_nats), 0.0)
    evidence = smoothed(clamped, POSE.occluder_width) / window
    return torch.where(inside, torch.sigmoid(evidence + math.log(1.0 / POSE.occluded - 1.0)), 0.0)


def _log_normal(size: Tensor, deviation: Tensor, channels: int) -> Tensor:
    """Return log N(r; σ) of differences with these lengths (N, M)."""
    sigma = deviation[:, None]
    return -0.5 * (size / sigma).square() - channels * (sigma * math.sqrt(2.0 * math.pi)).log()


def weighted_median(values: Tensor, weights: Tensor, among: Tensor) -> Tensor:
    """Return the weighted medians (N,) of rows (N, M), of what `among` (N, M) does not leave out."""
    ordered, order = torch.where(among > 0.0, values, math.inf).sort(1)
    below = weights.gather(1, order).cumsum(1)
    middle = torch.searchsorted(below, 0.5 * below[:, -1:]).clamp(max=values.shape[1] - 1)
    found = ordered.gather(1, middle)[:, 0]
    return torch.where(found.isfinite(), found, 1.0)


def _median_length(channels: int) -> float:
    """Return the median length of so many normal numbers of variance 1 (Wilson and Hilferty, The Distribution of Chi-Square,
    1931)."""
    return math.sqrt(channels * (1.0 - 2.0 / (9.0 * channels)) ** 3)
