"""Views of an object as templates: how likely parts of a picture show them, in unknown light.

A view predicts a part of a picture by the mesh's colours in the light that fits best there, with a basis B of colours times
harmonics inside the silhouette. Neighbouring pixels correlate, in pictures as in what a view leaves of them: shadows, blur and
the distance to the next view. So the residual r = y − B L is a Gaussian Markov random field: r' Q r is the sum of the squared
differences of neighbours, and of λ r² (Rue and Held, Gaussian Markov Random Fields, 2005). Its least value over L is y' Q y −
b' A⁻¹ b, with b = B' Q y and A = B' Q B. A does not depend on the place, and b is a correlation, so all places are computed at
once (a matched subspace filter, Scharf and Friedlander 1994).

The picture without the object is such a field, too, about its mean. Across a contour, object and background are independent:
there a field would pay for each step. A part of the picture's pixels is drawn from its colours, which finds rare ones.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from ..settings import TEMPLATES
from .template_views import TemplateViews


class Templates:
    """Views as filters of pictures with the channels C, which may be none."""

    def __init__(self, views: TemplateViews) -> None:
        self.alpha, self.C, level = views.alpha, views.colors.shape[-1], TEMPLATES.residual_level
        inside = (views.alpha > 0.5).float()
        self.area = inside.sum((1, 2)).clamp(min=1.0)[:, None, None]
        # Pairs of neighbours, at the first one: both inside, and one of them.
        both = torch.stack([inside * _next(inside, axis) for axis in (2, 1)], 1)
        across = torch.stack([(inside - _next(inside, axis)).abs() for axis in (2, 1)], 1)
        harmonics = torch.cat([torch.ones_like(views.normals[..., :1]), views.normals], -1)
        basis = (views.colors[..., None] * harmonics[..., None, :]).permute(0, 3, 4, 1, 2) * inside[:, None, None]
        filters = level * basis  # Q B
        for k, axis in enumerate((4, 3)):
            steps = (_next(basis, axis) - basis) * both[:, None, None, k]
            filters = filters - steps + steps.roll(1, axis)
        A = torch.einsum("ncijk,ncljk->ncil", filters, basis)
        self.inverse = torch.linalg.inv(_with_prior(A.double())).float()  # (n, 4C, 4C)
        # Of each channel; of squares of differences and values; and of logarithms of both.
        self.filters = torch.cat([filters, inside[:, None, None].expand(-1, self.C, -1, -1, -1)], 2)[:, :, :, None]
        self.squares = torch.cat([both, level * inside[:, None]], 1)[:, None]
        self.linear = torch.cat([across, TEMPLATES.rare_weight * inside[:, None]], 1)[:, None]

    def scores(self, pictures: Tensor, stride: int = 1, masked: bool = False) -> Tensor:
        """Return log likelihood ratios (n, h, w) at the places of one picture (1, C + 1, H, W) or of one for each view.

        The last channel is surprise() or, with `masked`, a mask. Then the score is the likelihood of colours and mask.
        """
        colors, last = pictures[:, :-1], pictures[:, -1:]
        steps = [(_next(colors, axis) - colors).square().sum(1, keepdim=True) for axis in (3, 2)]
        squares = torch.cat([*steps, colors.square().sum(1, keepdim=True)], 1)
        variance, parts = max(self.C, 1) * TEMPLATES.noise**2, []
        # A field without a pair has a smaller determinant, by half in a lattice.
        edges = [0.5 * self.C * (torch.log1p(step / variance) - math.log(2.0)) for step in steps]
        linear = torch.cat([*edges, last], 1)
        for at in range(0, len(self.alpha), TEMPLATES.batch):
            rows = slice(at, at + TEMPLATES.batch)
            own = slice(0, 1) if len(pictures) == 1 else rows
            shown = [_correlated(colors[own, c, None], self.filters[rows, c], stride) for c in range(self.C)]
            whole = _correlated(squares[own], self.squares[rows], stride)[:, 0]
            area, even, error = self.area[rows], whole, whole
            if shown:
                b = torch.cat([one[:, :4] for one in shown], 1)
                error = whole - (b * torch.einsum("nkl,nlhw->nkhw", self.inverse[rows], b)).sum(1)
                sums = torch.stack([one[:, 4] for one in shown])
                even = whole - TEMPLATES.residual_level * sums.square().sum(0) / area
            error, even = error.clamp(min=0.0) + variance * area, even.clamp(min=0.0) + variance * area
            if masked:  # Σ(m − α)² = Σm² − 2Σmα + Σα²
                alpha = self.alpha[rows, None, None]
                ones = torch.ones_like(alpha)
                shape = _correlated(last[own].square(), ones, stride) - 2.0 * _correlated(last[own], alpha, stride)
                shape = (shape[:, 0] + alpha.square().sum((3, 4))).clamp(min=0.0)
                parts.append(-torch.log((error + TEMPLATES.mask_weight * shape) / area))
                continue
            colored = (error / (self.C * area)).log() + math.log(2.0 * math.pi) + 1.0
            ratio = (even / error).log() - TEMPLATES.rare_weight * colored
            parts.append(0.5 * self.C * area * ratio + _correlated(linear[own], self.linear[rows], stride)[:, 0])
        return torch.cat(parts)


def _next(values: Tensor, axis: int) -> Tensor:
    """Return for each pixel the next one along an axis; the last one for itself."""
    size = values.shape[axis]
    return values.index_select(axis, torch.arange(1, size + 1).clamp(max=size - 1))


def _correlated(pictures: Tensor, filters: Tensor, stride: int) -> Tensor:
    """Return the correlations (n, f, h, w) of filters (n, f, M, T, T) with one picture (1, M, H, W), or with one for each."""
    found = F.conv2d(pictures.flatten(0, 1)[None], filters.flatten(0, 1), stride=stride, groups=len(pictures))
    return found[0].unflatten(0, filters.shape[:2])


def surprise(picture: Tensor) -> Tensor:
    """Return −log of the density (H, W) of each pixel's colour in a picture (C, H, W)."""
    C, H, W = picture.shape
    pixels = picture.flatten(1).T
    some = pixels[torch.randperm(len(pixels), generator=torch.Generator().manual_seed(0))[: TEMPLATES.sampled_pixels]]
    log = (-0.5 * (torch.cdist(pixels, some) / TEMPLATES.color_bandwidth).square()).logsumexp(1) - math.log(len(some))
    return (C * math.log(TEMPLATES.color_bandwidth * math.sqrt(2.0 * math.pi)) - log).reshape(H, W)


def _with_prior(A: Tensor) -> Tensor:
    """Return (n, 4C, 4C) of (n, C, 4, 4): the light is about white, and its slopes are smaller than its constant."""
    n, C = A.shape[:2]
    full = torch.zeros(n, C, 4, C, 4, dtype=A.dtype)
    differ = torch.eye(C, dtype=A.dtype) - 1.0 / max(C, 1)
    full += (
        (TEMPLATES.noise / TEMPLATES.light_tint) ** 2
        * differ[None, :, None, :, None]
        * torch.eye(4, dtype=A.dtype)[None, None, :, None, :]
    )
    slopes = torch.tensor([1e-3, 1.0, 1.0, 1.0], dtype=A.dtype) * (TEMPLATES.noise / TEMPLATES.light_slope) ** 2
    for c in range(C):
        full[:, c, :, c] += A[:, c] + torch.diag(slopes)
    return full.reshape(n, 4 * C, 4 * C)
