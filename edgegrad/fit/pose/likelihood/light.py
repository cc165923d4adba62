"""The light term: inside the silhouette a picture is the mesh's colours in a light that is solved for.

A matte surface with the colour a and the normal n reflects a L·Y(n) of distant light, with spherical harmonics Y up to the
second degree and nine coefficients L a channel (Ramamoorthi and Hanrahan, An Efficient Representation for Irradiance
Environment Maps, 2001); L includes exposure and white balance. The picture is linear in L, so a pose's best L has a closed form
and is eliminated from the normal equations (variable projection, Golub and Pereyra 1973, in Kaufman's form, 1975). Rotations
map harmonics of one degree to one another, so L may be of light that turns with the mesh: only the flow u of the surface's
points moves the picture, ∂(a L·Y)/∂p = −∇(a L·Y) · u. Here ∇ is the mean of the render's and the picture's slope, which makes
a step right to the second order (Malis, Improving Vision-Based Control Using Efficient Second-Order Minimization, 2004).

A pixel shows the surface with the density N(r; σ) of its difference r, or with small probabilities in a shadow, which is a
factor that is constant nearby, or something that covers it. Without the mesh it has one of the colours inside the silhouette
nearby, or continues its neighbours. Since occluders are larger than a pixel, pixels decide together in a window. The cost is
−log of the ratio of both, so that with the region term colours count once, and what is flat says nothing.
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
from .region import Frequencies
from .term import Term

HARMONICS = 9
MIN_PIXEL_ALPHA = 0.98  # least alpha of an inner pixel and its neighbours
PIXELS = "basis", "target", "clipped", "shown", "density", "posterior"  # what Surfaces have of each pixel
WINDOW_INSIDE = 0.9  # share of a blur's window that must lie inside


class Likelihoods(NamedTuple):
    """N surfaces, each in one light, compared with M pixels."""

    residual: Tensor  # (N, C, M), scaled, of the surface as it is or in a shadow, whichever is seen
    weight: Tensor  # (N, M), of its square in −log likelihood, if the pixel shows the surface
    likely: Tensor  # (N, M), log likelihood ratio of the surface to what the picture itself predicts
    visible: Tensor  # (N, h, w), probability that nothing covers the pixel
    wanted: Tensor  # (N, C, M), scaled, and weights by which the next light is fitted to it
    robust: Tensor  # (N, M)
    deviation: Tensor  # (N,), of scaled differences


class Surfaces(NamedTuple):
    """N surfaces, and M pixels of a picture in which any of them is seen."""

    at: Tensor  # (M,), numbers of the pixels of images (h, w)
    inside: Tensor  # (N, h, w), 1 where the surface is
    basis: Tensor  # (N, C, n, M), scaled radiance in a light that is each of the harmonics
    target: Tensor  # (N, C, M), the picture's, scaled
    clipped: Tensor  # (N, C, M) bool
    shown: Tensor  # (N, M), weights of pixels
    density: Tensor  # (N, M), log density of the pixels' colours among those inside nearby
    posterior: Tensor  # (N, M), probability that they are the object's by the colours on both sides of the silhouette
    width: float  # pixels: the standard deviation of windows in which pixels decide together

    def image(self, values: Tensor) -> Tensor:
        """Return images (…, h, w) of pixels (…, M), zero elsewhere."""
        h, w = self.inside.shape[1:]
        shape = values.shape[:-1]
        return values.new_zeros(*shape, h * w).index_copy(-1, self.at, values).reshape(*shape, h, w)

    def near(self, values: Tensor) -> Tensor:
        """Return the means (…, M) of pixels (…, M) of the surfaces nearby."""
        images = self.image(values)
        found = smoothed(images.flatten(0, -3), self.width).flatten(1)[:, self.at].reshape(values.shape)
        return found / self.windows.flatten(1)[:, self.at].reshape(len(values), *[1] * (values.dim() - 2), -1)

    @property
    def windows(self) -> Tensor:
        """The share (N, h, w) of each window that shows the surface."""
        return smoothed(self.inside, self.width).clamp(min=1e-3)

    def halved(self) -> Surfaces:
        """Return every other pixel of every other row."""
        w = self.inside.shape[2]
        rows, columns = self.at // w, self.at % w
        kept = ((rows % 2 == 0) & (columns % 2 == 0)).nonzero()[:, 0]
        at = rows[kept] // 2 * ((w + 1) // 2) + columns[kept] // 2
        pixels = {name: getattr(self, name)[..., kept] for name in PIXELS}
        return self._replace(at=at, inside=self.inside[:, ::2, ::2], width=self.width / 2.0, **pixels)

    def ridge(self, curvature: Tensor) -> Tensor:
        """Return a prior's part (N, C, n) of the diagonal of the normal equations (N, C, n, n) for the light."""
        found = (POSE.light_ridge * curvature[..., :1, 0]).repeat(1, 1, curvature.shape[-1]) + 1e-9
        found[..., 0] = 1e-9 + 1e-3 * found[..., 0]
        return found

    def light(self, weights: Tensor, wanted: Tensor) -> Tensor:
        """Return the light (N, C, n) that fits best."""
        weighted = self.basis * weights[:, None, None]
        curvature = weighted @ self.basis.mT
        prior = torch.diag_embed(self.ridge(curvature))
        return torch.linalg.solve(curvature + prior, weighted @ wanted[..., None])[..., 0]

    def likelihoods(
        self, light: Tensor, deviation: float | None, before: Likelihoods | None = None, shaded: bool = False
    ) -> Likelihoods:
        """Compare the surfaces in a light (N, C, n) with the picture; `before` has what was visible in another light. Of fewer
        pixels, it has the deviation, too. `shaded`: the surfaces may be in a shadow, and pixels may continue their neighbours."""
        C, e = self.target.shape[1], math.log(POSE.shaded)
        fitted = (light[:, :, None] @ self.basis)[:, :, 0]
        wanted = torch.where(self.clipped, torch.maximum(self.target, fitted), self.target)
        residual = fitted - wanted
        size = length(residual)
        if before is not None and before.visible.shape != self.inside.shape:
            own = before.deviation
        else:
            seen = self.shown if before is None else self.shown * before.visible.flatten(1)[:, self.at]
            own = (weighted_median(size, seen) / _median_length(C)).clamp(min=POSE.min_light_noise)
        used = own if deviation is None else torch.full_like(own, deviation)
        tail = (1.0 + (size / (POSE.tail * own[:, None])).square()).pow(-2)
        surface, reference, weight = _log_normal(size, used, C), self.density, torch.ones_like(size)
        if shaded:
            # In a shadow, or in a highlight, the surface is darker or brighter by a factor that changes slowly.
            gain = self.near((fitted * self.target).sum(1)) / self.near(fitted.square().sum(1)).clamp(min=1e-6)
            gain = gain.clamp(0.0, POSE.brightest)
            other = gain[:, None] * fitted - wanted
            lit, dim = surface, _log_normal(length(other), used, C) + e
            surface = torch.logaddexp(lit, dim)
            # Without the mesh, a pixel has one of the colours nearby, or continues its neighbours.
            even = _log_normal(length(self.near(self.target) - self.target), used, C) + e
            reference = torch.maximum(reference, even)
            # Both squares as one: that of a residual which is their weighted mean, up to a constant.
            share = (lit - surface).exp()
            weight = share + (1.0 - share) * gain.square()
            residual = share[:, None] * residual + ((1.0 - share) * gain)[:, None] * other
            residual = residual / weight.clamp(min=1e-6)[:, None]
        likely = surface - reference
        visible = self._visible(likely)
        robust = self.shown * visible.flatten(1)[:, self.at] * tail
        return Likelihoods(residual, weight, likely, visible, wanted, robust, used)

    def _visible(self, likely: Tensor) -> Tensor:
        """Return the probability (N, h, w) that a pixel inside shows the surface, by the mean log likelihood ratio around it."""
        clamped = self.inside * self.image(likely.clamp(-POSE.max_pixel_nats, POSE.max_pixel_nats))
        evidence = smoothed(clamped, self.width) / self.windows
        return self.inside * torch.sigmoid(evidence + math.log(1.0 / POSE.occluded - 1.0))


class FittedLight(NamedTuple):
    """N surfaces, each in the light that fits a picture best."""

    surfaces: Surfaces
    known: Tensor  # (N,) bool: enough of the surface is seen to show its light
    coefficients: Tensor  # (N, C, n), of harmonics
    found: Likelihoods
    predicted: Tensor  # (N, C, h, w), linear radiance, blurred
    visible: Tensor  # (N, h, w), probability that nothing covers the pixel, with a margin around the surface
    whole: Tensor  # (N, M), weights of the pixels that are compared
    scale: Tensor  # (N, C, M)
    slopes: Tensor  # (2, N, C, M)

    @staticmethod
    def from_picture(
        picture: PictureLevel, seen: RenderedPoses, harmonic_count: int, colors: Frequencies, deviation: float | None,
        blur: float = 0.0,
    ) -> FittedLight | None:  # fmt: skip
        """Fit so many harmonics to the picture of a box; 1 is an exposure alone.

        colors     frequencies of the pixels' colours nearby
        deviation  of differences, where that is known; None: each pose's own
        blur       of the picture, in pixels

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
        as_blurred = math.hypot(POSE.light_blur, blur)
        basis = smoothed(lit.flatten(0, 2), as_blurred).flatten(1)[:, at].reshape(N, C, n, -1)
        soft = under if blur == 0.0 else smoothed(share, as_blurred)
        basis, flat = basis / soft.clamp(min=1e-3).flatten(1)[:, None, None, at], share.flatten(1)[:, at]
        shown = pictured.flatten(2)[..., at]
        # The scale is about the slope of the display's curve, by which noise and errors are uniform.
        middle = (shown * flat[:, None]).sum((1, 2)) / (C * flat.sum(1)).clamp(min=1.0)
        scale = (shown + 0.02 + 0.1 * middle[:, None, None]).clamp(min=1e-3).rsqrt() * flat[:, None]
        clipped = (shown > POSE.clipped) & bool(picture.radiance.max() <= 1.0)
        kernel = POSE.color_kernel * math.sqrt(2.0 * math.pi)
        density = colors.inside.flatten(1)[:, at].clamp(min=1e-6).log() - C * math.log(kernel)
        count = (picture.weight * share).flatten(1)[:, at]
        surfaces = Surfaces(
            at, share, basis * scale[:, :, None], shown * scale, clipped, count, density,
            colors.posterior.flatten(1)[:, at], POSE.occluder_width,
        )  # fmt: skip
        some = surfaces if len(at) < POSE.light_pixels else surfaces.halved()
        # What covers a part of the object mostly goes on outside of it: its colours hardly count in the first light.
        light, found = some.light(some.shown * some.posterior.square(), some.target), None
        for _ in range(POSE.light_rounds - 1):
            found = some.likelihoods(light, deviation, found)
            light = some.light(found.robust, found.wanted)
        found = some.likelihoods(light, deviation, found)
        found = surfaces.likelihoods(light, deviation, found, True)
        predicted = surfaces.image((light[:, :, None] @ basis)[:, :, 0])
        slopes = slope(0.5 * (predicted + pictured)).flatten(3)[..., at]
        # Near the silhouette a blur reaches fewer pixels, and slopes are too low.
        whole = count * (under > WINDOW_INSIDE).flatten(1)[:, at] * known[:, None]
        # Along the silhouette a blur mixes the contours of object and occluder, so a margin counts as occluded.
        hidden = torch.where(inside, 1.0 - found.visible, 0.0) * known[:, None, None]
        margin = F.max_pool2d(hidden[:, None], 5, 1, 2)[:, 0]
        visible = 1.0 - torch.where(inside, hidden, margin)
        return FittedLight(surfaces, known, light, found, predicted, visible, whole, scale, slopes)

    @property
    def inside(self) -> Tensor:
        """Where the surfaces are, (N, h, w) bool."""
        return self.surfaces.inside > 0.0

    @property
    def deviation(self) -> Tensor:
        """The standard deviation (N,) of scaled differences."""
        return self.found.deviation

    def lit(self, seen: RenderedPoses) -> Tensor:
        """Return the radiance (N, C, h, w) of the surfaces in their light, times alpha."""
        assert seen.color is not None and seen.normal is not None
        Y = harmonics_of(seen.normal, self.coefficients.shape[2])
        return (seen.color * torch.einsum("nck,nkhw->nchw", self.coefficients, Y)).clamp(min=0.0)

    def term(self, flow: Tensor, tangents: Tensor, others: Tensor) -> Term:
        """Return the term of the surfaces, whose points move by `flow` (D, N, 2, h, w), and their silhouettes by `tangents`
        (D, N, h, w), with the light's numbers eliminated. `others` (N, h, w) are the gains of other terms in pixels that are
        seen, relative to this one's: they count as far as these are visible, which depends on the pose, too.

        With the probability q that a window is seen, the cost is the variational free energy −Σ q (gain + others) + KL(q, 1 −
        ε), of which the others' terms have their part.
        """
        e, s = POSE.occluded, self.surfaces
        seen = self.visible.flatten(1)[:, s.at]
        q = seen.clamp(1e-6, 1.0 - 1e-6)
        divergence = q * (q / (1.0 - e)).log() + (1.0 - q) * ((1.0 - q) / e).log()
        own = self.found.likely + math.log(1.0 - e)
        gain = seen * torch.logaddexp(own, torch.full_like(own, math.log(e))) - divergence
        cost = -(self.whole * gain).sum(1)
        # The cost's derivative by a difference is the difference times this, the mixture's posterior.
        robust = self.whole * seen * torch.sigmoid(own - math.log(e)) * self.found.weight
        # A larger likelihood of a pixel makes its window visible, in which others gain.
        decided = smoothed(others * self.visible * (1.0 - self.visible) * s.inside / s.windows, s.width)
        counts = (self.found.likely.abs() < POSE.max_pixel_nats) & (self.whole > 0.0)
        coupled = decided.flatten(1)[:, s.at] * counts * self.found.weight
        D, (N, C) = len(flow), self.scale.shape[:2]
        x, y = flow.flatten(3)[..., s.at].movedim(0, 1).unbind(2)  # (N, D, M)
        gradient, curvature = torch.zeros(N, D, dtype=torch.float32), torch.zeros(N, D, D, dtype=torch.float32)
        # Of each channel: derivatives without what the light makes up for, and weighted residuals.
        kept: list[tuple[Tensor, Tensor]] = []
        for c in range(C):
            moved = -(x * self.slopes[0, :, None, c] + y * self.slopes[1, :, None, c]) * self.scale[:, None, c]
            J = torch.cat([moved, s.basis[:, c]], 1)
            A = (J * robust[:, None]) @ J.mT
            prior = s.ridge(A[:, None, D:, D:])[:, 0]
            eliminated = torch.linalg.solve(A[:, D:, D:] + torch.diag_embed(prior), A[:, D:, :D])
            curvature += A[:, :D, :D] - A[:, :D, D:] @ eliminated
            rows, residual = moved - eliminated.mT @ s.basis[:, c], self.found.residual[:, c]
            gradient += (rows @ ((robust + coupled) * residual)[..., None])[..., 0]
            gradient -= (eliminated.mT @ (prior * self.coefficients[:, c])[..., None])[..., 0]
            kept.append((rows, robust * residual))
        information = 1.0 / self.deviation.double().square()
        gradient = information[:, None] * gradient - self._growth(gain, tangents)

        def summands() -> Tensor:
            total = sum(rows * residual[:, None] for rows, residual in kept)
            assert isinstance(total, Tensor)
            return s.image(information[:, None, None].float() * total)

        return Term(cost.double(), gradient, information[:, None, None] * curvature, summands)

    def _growth(self, gain: Tensor, tangents: Tensor) -> Tensor:
        """Return by how much the gain (N, M) of pixels grows (N, D) as the silhouette, which moves by `tangents` (D, N, h, w),
        takes in others that are like those along it."""
        s = self.surfaces
        near = smoothed(s.image(self.whole * gain), s.width)
        # Where a window has next to no compared pixels, the silhouette takes in nothing that is known.
        mean = near / smoothed(s.image((self.whole > 0.0).float()), s.width).clamp(min=0.02)
        return (mean * tangents).sum((2, 3)).T


def length(values: Tensor) -> Tensor:
    """Return the lengths (N, M) of differences (N, C, M)."""
    return values.square().sum(1).sqrt()


def harmonics_of(normals: Tensor, count: int) -> Tensor:
    """Return the first harmonics (N, count, h, w), up to factors, of directions (N, 3, h, w) of any length."""
    one, y, z, x, *second = harmonics(F.normalize(normals, dim=1, eps=1e-6).movedim(1, -1), UNSCALED)
    return torch.stack([one, x, y, z, *second], 1)[:, :count]


def slope(image: Tensor) -> Tensor:
    """Return central differences (2, …, h, w), by columns and rows, of images (…, h, w)."""
    p = F.pad(image.flatten(0, -3)[None], (1, 1, 1, 1), mode="replicate")[0]
    found = 0.5 * torch.stack([p[:, 1:-1, 2:] - p[:, 1:-1, :-2], p[:, 2:, 1:-1] - p[:, :-2, 1:-1]])
    return found.reshape(2, *image.shape)


def inner_pixels(alpha: Tensor) -> Tensor:
    """Return which pixels of silhouettes (N, h, w) are covered with all their neighbours."""
    return F.max_pool2d((alpha < MIN_PIXEL_ALPHA).float()[:, None], 3, 1, 1)[:, 0] == 0.0


def _log_normal(size: Tensor, deviation: Tensor, channels: int) -> Tensor:
    """Return log N(r; σ) of differences with these lengths (N, M)."""
    sigma = deviation[:, None]
    return -0.5 * (size / sigma).square() - channels * (sigma * math.sqrt(2.0 * math.pi)).log()


def weighted_median(values: Tensor, weights: Tensor) -> Tensor:
    """Return the medians (N,) of rows (N, M) with weights."""
    ordered, order = torch.where(weights > 0.0, values, math.inf).sort(1)
    below = weights.gather(1, order).cumsum(1)
    middle = torch.searchsorted(below, 0.5 * below[:, -1:]).clamp(max=values.shape[1] - 1)
    found = ordered.gather(1, middle)[:, 0]
    return torch.where(found.isfinite(), found, 1.0)


def _median_length(channels: int) -> float:
    """Return the median length of so many normal numbers of variance 1 (Wilson and Hilferty, The Distribution of Chi-Square,
    1931)."""
    return math.sqrt(channels * (1.0 - 2.0 / (9.0 * channels)) ** 3)
