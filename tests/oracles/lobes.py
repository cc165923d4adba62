"""Directions drawn by how glossy surfaces scatter: mirrored at normals of microfacets that the viewer sees
(csrc/shading/lit/bsdf_sampling.h, which names the sources)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from edgegrad.light.bsdf import LEAST_ALPHA, dot, ggx
from edgegrad.light.sampling import WIDEST_LOBE
from edgegrad.points.sobol import sobol


class Lobes(NamedTuple):
    """The lobes of N points, without derivatives, in float64. Directions drawn by wide lobes only cost."""

    v: Tensor  # (N, 3) unit, above the surface
    n: Tensor  # (N, 3) unit
    alpha: Tensor  # (N, 1)
    bound: Tensor  # (N, 1), of the cap of normals whose mirrored directions are above
    narrow: Tensor  # (N,) bool

    @classmethod
    @torch.no_grad()
    def of(cls, v: Tensor, n: Tensor, roughness: Tensor) -> Lobes:
        """Make the lobes of unit directions to the viewer, normals (N, 3), and roughnesses (N, 1) or (1, 1)."""
        v, n = v.detach().double(), n.detach().double()
        roughness = roughness.detach().double().expand(len(n), 1)
        narrow = (roughness <= WIDEST_LOBE)[:, 0]
        nv = dot(n, v)
        v = torch.where(nv >= 0, v, normalize(v - nv * n, dim=-1))
        nv = nv.clamp(min=0)
        alpha = (roughness * roughness).clamp(min=LEAST_ALPHA)
        a2, s = alpha * alpha, 1 + (1 - nv * nv).clamp(min=0).sqrt()
        return cls(v, n, alpha, (1 - a2) * s * s / (s * s + a2 * nv * nv), narrow)

    def select(self, rows: Tensor) -> Lobes:
        return Lobes(*(part[rows] for part in self))

    def repeated(self, times: int) -> Lobes:
        """Each so many times."""
        return Lobes(*(part.repeat_interleave(times, 0) for part in self))

    def mirrored(self) -> Tensor:
        """(N, 3) where flat mirrors would look."""
        return normalize(2 * dot(self.n, self.v).clamp(min=0) * self.n - self.v, dim=-1)

    def solid_angle(self) -> Tensor:
        """(N, 1): one over the density there; of wide lobes all above the surface."""
        own = (2 * math.pi * self.alpha * self.alpha * self._spread()).clamp(max=2 * math.pi)
        return torch.where(self.narrow[:, None], own, 2 * math.pi)

    def _spread(self) -> Tensor:
        a2, nv = self.alpha * self.alpha, dot(self.n, self.v).clamp(min=0)
        return self.bound * nv + (a2 + (1 - a2) * nv * nv).sqrt()

    def density(self, l: Tensor) -> Tensor:
        """(N,) by solid angle, of unit directions (N, 3): D(h) / 2 (k n·v + √(α² + (1 − α²) (n·v)²)), k the bound."""
        D = ggx(self.n, normalize(self.v + l, dim=-1), self.alpha * self.alpha)
        return (D / (2 * self._spread()))[:, 0]

    def draw(self, u: Tensor) -> Tensor:
        """(N, 3) unit directions from numbers (N, 2) in [0, 1)."""
        axes = axes_around(self.n)
        own = (axes @ self.v[:, :, None])[:, :, 0]
        stretch = torch.cat([self.alpha, self.alpha, torch.ones_like(self.alpha)], 1)
        wide = normalize(torch.cat([own[:, :2], own[:, 2:].clamp(min=0)], 1) * stretch, dim=-1)
        b, phi = self.bound[:, 0] * wide[:, 2], 2 * math.pi * u[:, 0]
        z = (1 - u[:, 1]) * (1 + b) - b
        across = (1 - z * z).clamp(0, 1).sqrt()
        m = torch.stack([across * phi.cos(), across * phi.sin(), z], 1) + wide
        h = (normalize(m * stretch, dim=-1)[:, None] @ axes)[:, 0]
        return normalize(2 * dot(self.v, h) * h - self.v, dim=-1)


def axes_around(n: Tensor) -> Tensor:
    """(N, 3, 3): two unit vectors across n (N, 3), and n (Duff et al. 2017, "Building an orthonormal basis, revisited")."""
    x, y, z = n.unbind(-1)
    sign = torch.copysign(torch.ones_like(z), z)
    a = -1 / (sign + z)
    b = x * y * a
    rows = [1 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y, x, y, z]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def sobol_parts(seed: Tensor, key: int, parts: int) -> Tensor:
    """Return sobol() of all parts of each seed (N · parts, 2)."""
    every = torch.arange(parts, device=seed.device)
    own = (seed[:, None] * parts + every & 0xFFFFFFFF) | (seed[:, None] >> 32 << 32)
    return sobol(own.reshape(-1), key)
