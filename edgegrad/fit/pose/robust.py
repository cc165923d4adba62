"""A loss in which what covers the object hardly counts, for Gauss-Newton.

Of a pixel whose channels differ by r in all, ρ(r) = r² / (1 + r²/c²) (Geman and McClure 1987): the squared difference while it
is small beside c, and c² however large it is. A step minimises Σ w r² with w = (1 + r²/c²)⁻², which has ρ's gradient (iteratively
reweighted least squares). c follows the median difference on the render's edges: wide while the object lies wrong, and narrow
where at least half of them are found.

Where the background is not known, pixels are compared only as far as the object covers them, image − α · picture, and (1 − α)²
c²/2 is added: to cover a pixel pays if that matches better than by chance.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..verdict import edge_strength
from .task import Level, PoseTask

NARROWEST = 0.1  # c, as a part of the pictures' range
MEDIANS = 2.5  # c, in medians
PAYS = 0.5  # of c², what covering a pixel pays
NOISE = 0.03  # a loss that rises by a smaller part may have risen by the noise of its samples
FAINT = 0.03  # the noise of the area that is covered, beside it


class Comparison:
    """The differences between pictures and renders at one pose."""

    def __init__(self, task: PoseTask, level: Level, renders: list[Tensor]) -> None:
        self.task, self.level, self.renders = task, level, renders
        self.differences, self.open = [], []
        for shot, render in zip(level.shots, renders, strict=True):
            if task.clutter:
                image, alpha = render[..., :-1], render[..., -1:]
                self.differences.append(image - alpha * shot.target)
                self.open.append(1.0 - alpha)
            else:
                self.differences.append(render - shot.target)

    @property
    def channels(self) -> int:
        return self.differences[0].shape[-1]

    @property
    def count(self) -> float:
        """Of numbers that are compared, weighted."""
        weights = (
            r.numel() // self.channels if shot.weight is None else float(shot.weight.sum())
            for r, shot in zip(self.differences, self.level.shots, strict=True)
        )  # fmt: skip
        return max(self.channels * sum(weights), 1e-30)

    def scale(self) -> float:
        """c that the median difference suggests."""
        sizes, counts = [], []
        for k, (r, render) in enumerate(zip(self.differences, self.renders, strict=True)):
            sizes.append(r.detach().norm(dim=-1).flatten())
            edge = edge_strength(render.detach()).sum(-1)
            if self.task.clutter:
                edge = edge * render.detach()[..., -1]
            weight = self.level.shots[k].weight
            counts.append((edge if weight is None else edge * weight[..., 0]).flatten())
        size, order = torch.cat(sizes).sort()
        share = torch.cat(counts)[order].cumsum(0)
        middle = size[int(torch.searchsorted(share, 0.5 * share[-1]).clamp(max=len(size) - 1))]
        return max(MEDIANS * float(middle), NARROWEST * self.task.extent, 1e-12)

    def loss(self, c: float) -> tuple[float, float]:
        """The mean over pixels and channels, and by how much that of another render may be higher by its noise."""
        total = near = paid = spread = 0.0
        for k, r in enumerate(self.differences):
            square = r.detach().square().sum(-1, keepdim=True)
            weight = self.level.shots[k].weight
            w = torch.ones_like(square) if weight is None else weight
            total += float((w * square / (1.0 + square / c**2)).sum())
            close = w * square / (1.0 + square / c**2).square()  # what is far off is so in any samples
            near += float(close.sum())
            spread += float(close.square().sum())  # its variance, where all that is left is noise
            if self.open:
                paid += float((w * (1.0 - self.open[k].detach().square())).sum()) * PAYS * c**2
        return (total - paid) / self.count, (max(NOISE * near, math.sqrt(spread)) + NOISE * FAINT * paid) / self.count

    def residuals(self, c: float) -> list[Tensor]:
        """Whose squares sum up to the loss's approximation for one step."""
        found = []
        for k, (r, (w, open_)) in enumerate(zip(self.differences, self._factors(c), strict=True)):
            residual = w * r
            if self.open:
                residual = torch.cat([residual, open_ * self.open[k]], -1)
            found.append(residual)
        return found

    def tangents(self, c: float, dots: list[Tensor]) -> list[Tensor]:
        """Of the residuals, from those (D, h, w, C) of the renders."""
        found = []
        for shot, dot, (w, open_) in zip(self.level.shots, dots, self._factors(c), strict=True):
            if self.open:
                image, alpha = dot[..., :-1], dot[..., -1:]
                dot = torch.cat([w * (image - alpha * shot.target), -open_ * alpha], -1)
            else:
                dot = w * dot
            found.append(dot)
        return found

    def _factors(self, c: float) -> list[tuple[Tensor, Tensor]]:
        """Of the difference and of what is open, in the residual of each picture."""
        found = []
        for r, shot in zip(self.differences, self.level.shots, strict=True):
            w = (1.0 + r.detach().square().sum(-1, keepdim=True) / c**2).pow(-2)
            count = torch.ones_like(w) if shot.weight is None else shot.weight
            found.append(((w * count).sqrt(), count.sqrt() * math.sqrt(PAYS) * c))
        return found
