"""Views of an object as templates: how likely parts of a picture show them, in unknown light.

A view predicts a part of a picture by the mesh's colours in the light that fits best there. With the basis B of colours times
harmonics inside the silhouette, the squared error is Σy² − bᵀA⁻¹b, with b = Σ B y and A = Σ B Bᵀ (a matched subspace filter,
Scharf and Friedlander 1994). A does not depend on the place, and b is a correlation, so all places are computed at once.

A view competes with one colour for the whole part, while it has one for its surroundings, and with pixels drawn from the
colours of the whole picture. The first finds contours and patterns, the second rare colours.
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

    def __init__(self, views: TemplateViews, rare: float) -> None:
        """`rare` weights the ratio to the picture's colours against that to one colour."""
        self.rare = rare
        alpha, colors, normals = views.alpha, views.colors, views.normals
        self.C = colors.shape[-1]
        self.alpha = alpha
        self.inside = torch.where(alpha > 0.5, alpha, torch.zeros_like(alpha))
        near = F.max_pool2d((alpha > 0.02).float()[:, None], 2 * views.ring + 1, 1, views.ring)[:, 0]
        self.around = near * (alpha < 0.02)
        Y = torch.cat([torch.ones_like(normals[..., :1]), normals], -1)
        basis = colors[..., None] * Y[..., None, :]  # (n, T, T, C, 4)
        weighted = basis * self.inside[..., None, None]
        A = torch.einsum("nijck,nijcl->nckl", weighted, basis)
        self.inverse = torch.linalg.inv(_with_prior(A.double())).float()  # (n, 4C, 4C)
        self.filters = weighted.permute(0, 3, 4, 1, 2)  # (n, C, 4, T, T)

    def everywhere(self, picture: Tensor, stride: int) -> Tensor:
        """Return log likelihood ratios (n, h, w), of a picture (C + 1, H, W) whose last channel is surprise()."""
        parts = []
        sides = torch.stack([self.inside, self.around], 1)
        colors, surprise = picture[:-1], picture[-1]
        for at in range(0, len(self.inside), 2 * TEMPLATES.batch):
            rows = slice(at, at + 2 * TEMPLATES.batch)
            n = len(self.inside[rows])
            b, sums = [], []
            for c in range(self.C):
                both = torch.cat([self.filters[rows, c], sides[rows]], 1).flatten(0, 1)[:, None]
                out = F.conv2d(colors[None, c : c + 1], both, stride=stride)[0]
                out = out.reshape(n, 6, *out.shape[1:])
                b.append(out[:, :4])
                sums.append(out[:, 4:])
            squares = F.conv2d(colors.square().sum(0)[None, None], sides[rows].flatten(0, 1)[:, None], stride=stride)
            squares = squares[0].reshape(n, 2, *squares.shape[2:])
            rare = F.conv2d(surprise[None, None], self.inside[rows, None], stride=stride)[0]
            parts.append(self._ratios(torch.cat(b, 1), torch.stack(sums, 2), squares, rare, rows))
        return torch.cat(parts)

    def near(self, crops: Tensor, masked: bool) -> Tensor:
        """Return the scores (n, k, k) of a crop (n, C + 1, T + k − 1, T + k − 1) for each view, at k × k shifts. The last
        channel is surprise(), or a mask. With a mask, the score is the likelihood of colours and mask, for a view of the same
        size."""
        parts = []
        for at in range(0, len(crops), TEMPLATES.batch):
            rows = slice(at, at + TEMPLATES.batch)
            colors, last = crops[rows, :-1], crops[rows, -1:]
            sides = torch.stack([self.inside[rows], self.around[rows]], 1)
            n, k = len(sides), crops.shape[-1] - sides.shape[-1] + 1
            filters = torch.cat([self.filters[rows], sides[:, None].expand(-1, self.C, -1, -1, -1)], 2)
            out = _one_by_one(colors.flatten(0, 1), filters.flatten(0, 1)).reshape(n, self.C, 6, k, k)
            b, sums = out[:, :, :4].reshape(n, 4 * self.C, k, k), out[:, :, 4:].transpose(1, 2)
            squares = _one_by_one(colors.square().sum(1), sides)
            if masked:  # Σ(m − α)² = Σm² − 2Σmα + Σα²
                alpha = self.alpha[rows, None]
                of_masks = _one_by_one(last[:, 0].square(), torch.ones_like(alpha))
                shape = of_masks - 2.0 * _one_by_one(last[:, 0], alpha) + alpha.square().sum((2, 3), keepdim=True)
                error = self._error(b, squares[:, 0], rows) + TEMPLATES.mask_weight * shape[:, 0].clamp(min=0.0)
                parts.append(
                    -torch.log(error / self.alpha[rows].sum((1, 2)).clamp(min=1.0)[:, None, None] + TEMPLATES.noise**2)
                )
                continue
            rare = _one_by_one(last[:, 0], sides[:, :1])[:, 0]
            parts.append(self._ratios(b, sums, squares, rare, rows))
        return torch.cat(parts)

    def _error(self, b: Tensor, squares: Tensor, rows: slice) -> Tensor:
        """Return the squared error (n, h, w) inside."""
        return (squares - (b * torch.einsum("nkl,nlhw->nkhw", self.inverse[rows], b)).sum(1)).clamp(min=0.0)

    def _ratios(self, b: Tensor, sums: Tensor, squares: Tensor, rare: Tensor, rows: slice) -> Tensor:
        """Return the ratios from b (n, 4C, h, w); sums (n, 2, C, h, w) and squares (n, 2, h, w) inside and around; rare (n,
        h, w)."""
        inside, around = (x[rows].sum((1, 2)).clamp(min=1e-3)[:, None, None] for x in (self.inside, self.around))
        error = self._error(b, squares[:, 0], rows)
        outside = (squares[:, 1] - sums[:, 1].square().sum(1) / around).clamp(min=0.0)
        even = (squares.sum(1) - sums.sum(1).square().sum(1) / (inside + around)).clamp(min=0.0)
        noise = TEMPLATES.noise**2 * self.C * (inside + around)
        to_one = 0.5 * self.C * (inside + around) * torch.log((even + noise) / (error + outside + noise))
        variance = error / (self.C * inside) + TEMPLATES.noise**2
        to_all = rare - 0.5 * self.C * inside * (variance.log() + math.log(2.0 * math.pi) + 1.0)
        return to_one + self.rare * to_all


def _one_by_one(pictures: Tensor, filters: Tensor) -> Tensor:
    """Return the correlations (n, f, k, k) of each picture (n, h, w) with its own filters (n, f, T, T)."""
    if not len(pictures):  # Masks without colours have no pictures.
        k = pictures.shape[-1] - filters.shape[-1] + 1
        return pictures.new_zeros(*filters.shape[:2], k, k)
    found = F.conv2d(pictures[None], filters.flatten(0, 1)[:, None], groups=len(pictures))
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
