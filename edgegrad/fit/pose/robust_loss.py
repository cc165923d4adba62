"""A robust loss for Gauss-Newton, in which what covers the object hardly counts.

A pixel whose channels differ by r in all costs ρ(r) = r² / (1 + r²/c²) (Geman and McClure 1987): the squared difference where
it is small against c, and at most c². A step minimises Σ w r² with w = (1 + r²/c²)⁻², which has ρ's gradient (iteratively
reweighted least squares). c follows the median difference on the render's edges: wide while the object lies wrong, narrow
once half of them match.

The unit of a picture's radiance, or its exposure, is unknown: in each picture the object has a gain, and so has the
background. The render is linear in them, so a pose's best gains have a closed form and are eliminated from the normal
equations (variable projection, Golub and Pereyra 1973, in Kaufman's form, 1975). Otherwise a brighter picture would match
best at a wrong pose.

Before an unknown background, pixels are compared only as far as the object covers them, image − α · picture, and (1 − α)²
c²/2 is added: to cover a pixel pays if that matches better than by chance.
"""

from __future__ import annotations

import math
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

from ..edge_support import edge_strength
from .task import PoseTask, PyramidLevel, TargetView

MIN_WIDTH = 0.1  # Least c, relative to the pictures' range.
WIDTH_MEDIANS = 2.5  # c, in medians
COVERAGE_REWARD = 0.5  # reward for covering a pixel, relative to c²
LOSS_NOISE = 0.03  # A loss that rises by a smaller share may have risen by sample noise.
COVERAGE_NOISE = 0.03  # Noise of the covered area, relative to LOSS_NOISE.
GAIN_ITERATIONS = 2
CORRELATED_BLOCK = 8  # pixels whose errors are taken to have one cause
GAIN_RIDGE = 1e-9  # Relative to the curvature of gains: keeps one that the picture does not show near 1.


class Comparison:
    """The differences between pictures and renders at one pose."""

    def __init__(self, task: PoseTask, level: PyramidLevel, layers: list[Tensor]) -> None:
        """`layers` (h, w, n) of each picture come from PoseTask.layers()."""
        self.task, self.level, self.layers = task, level, layers
        self.gains = [layer.new_ones(1 + task.backed) for layer in layers]
        self.renders: list[Tensor] = []  # (h, w, C) of each picture
        self.differences: list[Tensor] = []
        self.open: list[Tensor] = []
        self._width = math.inf  # width of the loss that the gains minimise
        self._compose()
        if self._has_gains:
            self._fit_gains(math.inf, 1)
            self._fit_gains(self.scale())

    @property
    def _has_gains(self) -> bool:
        return self.task.colors > 0 and not self.task.colorless

    def _compose(self) -> None:
        """Apply the gains to the renders, and take their differences to the pictures."""
        task, C = self.task, self.task.colors
        self.renders, self.differences, self.open = [], [], []
        for shot, layer, gains in zip(self.level.shots, self.layers, self.gains, strict=True):
            parts = [gain * part for gain, part in zip(gains, self._parts(layer), strict=True)] if C else []
            alpha = layer[..., len(parts) * C :]
            self.renders.append(torch.cat([sum(parts[1:], parts[0]), alpha], -1) if parts else alpha)
            if task.clutter:
                self.differences.append(self.renders[-1][..., :-1] - alpha * shot.target)
                self.open.append(1.0 - alpha)
            else:
                self.differences.append(self.renders[-1] - shot.target)

    def _parts(self, layer: Tensor) -> list[Tensor]:
        """Return the parts of a layer (…, h, w, C) that have a gain each."""
        C = self.task.colors
        return [layer[..., k * C : (k + 1) * C] for k in range(1 + self.task.backed)]

    def _fit_gains(self, c: float, rounds: int = GAIN_ITERATIONS) -> None:
        """Find the gains that minimise the loss of width c, by iteratively reweighted least squares, and apply them."""
        C, found = self.task.colors, []
        for shot, layer, gains, r in zip(self.level.shots, self.layers, self.gains, self.differences, strict=True):
            residual = r.detach().flatten(0, 1)
            rows = torch.stack([part.detach().flatten(0, 1) for part in self._parts(layer)])
            wanted = (gains[:, None, None] * rows).sum(0) - residual[:, :C]
            for _ in range(rounds):
                weighted = (rows * self._weights(shot, residual, c)).flatten(1)
                A, b = (weighted @ rows.flatten(1).T).double(), (weighted @ wanted.flatten()).double()
                ridge = GAIN_RIDGE * A.diagonal() + 1e-30
                gains = torch.linalg.solve(A + torch.diag(ridge), b + ridge).to(gains)
                residual = torch.cat([(gains[:, None, None] * rows).sum(0) - wanted, residual[:, C:]], 1)
            found.append(gains)
        self.gains, self._width = found, c
        self._compose()

    def _settle(self, c: float) -> None:
        """Fit the gains for the loss of width c."""
        if self._has_gains and c != self._width:
            self._fit_gains(c)

    def _weights(self, shot: TargetView, r: Tensor, c: float) -> Tensor:
        """Return the weights (…, 1) of differences r (…, C) of all pixels."""
        w = (1.0 + r.square().sum(-1, keepdim=True) / c**2).pow(-2)
        return w if shot.weight is None else w * shot.weight.reshape(w.shape)

    def _without_gains(self, k: int, w: Tensor, images: Tensor) -> Tensor:
        """Project images (…, h, w, n) onto what no change of picture k's gains makes, where each pixel counts w (h, w, 1)."""
        C = self.task.colors
        if not self._has_gains:
            return images
        moved = torch.stack([(w.sqrt() * part.detach()).flatten() for part in self._parts(self.layers[k])]).double()
        pinv = torch.linalg.pinv(moved @ moved.T, rtol=1e-9, hermitian=True)
        colors = images[..., :C]
        rows = colors.flatten(-3).double()
        projected = rows - (rows @ moved.T @ pinv) @ moved
        return torch.cat([projected.reshape(colors.shape).to(images), images[..., C:]], -1)

    @property
    def channels(self) -> int:
        return self.differences[0].shape[-1]

    @property
    def count(self) -> float:
        """The weighted number of values that are compared."""
        weights = (
            r.numel() // self.channels if shot.weight is None else float(shot.weight.sum())
            for r, shot in zip(self.differences, self.level.shots, strict=True)
        )  # fmt: skip
        return max(self.channels * sum(weights), 1e-30)

    def scale(self) -> float:
        """Return the width c that the median difference suggests."""
        size, order = torch.cat([r.detach().norm(dim=-1).flatten() for r in self.differences]).sort()
        share = self._edges[order].cumsum(0)
        middle = size[int(torch.searchsorted(share, 0.5 * share[-1]).clamp(max=len(size) - 1))]
        return max(WIDTH_MEDIANS * float(middle), MIN_WIDTH * self.task.extent, 1e-12)

    @cached_property
    def _edges(self) -> Tensor:
        """How much of an edge each pixel of the renders is, of all pictures."""
        found = []
        for shot, render in zip(self.level.shots, self.renders, strict=True):
            edge = edge_strength(render.detach()).sum(-1)
            if self.task.clutter:
                edge = edge * render.detach()[..., -1]
            found.append((edge if shot.weight is None else edge * shot.weight[..., 0]).flatten())
        return torch.cat(found)

    def loss(self, c: float) -> tuple[float, float]:
        """Return the mean over pixels and channels, and its possible rise by noise in another render."""
        self._settle(c)
        total = near = paid = spread = 0.0
        for k, r in enumerate(self.differences):
            square = r.detach().square().sum(-1, keepdim=True)
            weight = self.level.shots[k].weight
            w = torch.ones_like(square) if weight is None else weight
            total += float((w * square / (1.0 + square / c**2)).sum())
            close = w * square / (1.0 + square / c**2).square()  # Large differences do not depend on samples.
            near += float(close.sum())
            spread += float(close.square().sum())  # This is its variance where noise alone remains.
            if self.open:
                paid += float((w * (1.0 - self.open[k].detach().square())).sum()) * COVERAGE_REWARD * c**2
        return (total - paid) / self.count, (
            max(LOSS_NOISE * near, math.sqrt(spread)) + LOSS_NOISE * COVERAGE_NOISE * paid
        ) / self.count

    def residuals(self, c: float) -> list[Tensor]:
        """Return residuals whose squares sum to the loss's approximation for one step."""
        self._settle(c)
        found = []
        for k, (r, shot) in enumerate(zip(self.differences, self.level.shots, strict=True)):
            w = self._weights(shot, r.detach(), c)
            residual = self._without_gains(k, w, w.sqrt() * r)
            if self.open:
                open_ = self._open(shot, c)
                residual = torch.cat([residual, open_ * self.open[k]], -1)
            found.append(residual)
        return found

    def tangents(self, c: float, dots: list[Tensor]) -> list[Tensor]:
        """Return the tangents of the residuals, from those (D, h, w, n) of the layers."""
        found = []
        for k, (shot, dot, r) in enumerate(zip(self.level.shots, dots, self.differences, strict=True)):
            w = self._weights(shot, r.detach(), c)
            parts = self._parts(dot) if self.task.colors else []
            alpha = dot[..., len(parts) * self.task.colors :]
            colors = [gain * part for gain, part in zip(self.gains[k], parts, strict=False)]
            image = sum(colors[1:], colors[0]) if colors else alpha[..., :0]
            if self.open:
                image, alpha = image - alpha * shot.target, -self._open(shot, c) * alpha
                found.append(torch.cat([self._without_gains(k, w, w.sqrt() * image), alpha], -1))
            else:
                found.append(self._without_gains(k, w, w.sqrt() * torch.cat([image, alpha], -1)))
        return found

    def variance(self, c: float) -> float:
        """Return the variance of a residual on the renders' edges, as if all were independent. Errors of neighbouring pixels
        have common causes: the light, the lens, the mesh. So the residuals of a block are summed, and the squares of these
        sums stand for those of independent residuals."""
        total = count = 0.0
        for k, (shot, residual) in enumerate(zip(self.level.shots, self.residuals(c), strict=True)):
            H, W, C = residual.shape
            edges = edge_strength(self.renders[k].detach()).norm(dim=-1, keepdim=True)
            side = min(CORRELATED_BLOCK, H, W)
            sums = F.avg_pool2d(
                (edges * residual.detach()).movedim(-1, 0)[None], side, ceil_mode=True, divisor_override=1
            )
            total += float(sums.square().sum())
            count += C * float((edges.square() * self._weights(shot, self.differences[k].detach(), c)).sum())
        return total / max(count, 1e-30)

    def _open(self, shot: TargetView, c: float) -> Tensor:
        """Return the weight of uncovered shares in the residual of a picture."""
        count = torch.ones((), dtype=torch.float32) if shot.weight is None else shot.weight
        return count.sqrt() * math.sqrt(COVERAGE_REWARD) * c
