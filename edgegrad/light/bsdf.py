"""How surfaces scatter light: Lambert's law, and the metallic-roughness model of glTF."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

DIELECTRIC = 0.04  # reflectance head-on, of an index of refraction of 1.5
LEAST_ALPHA = 1e-4  # of the microfacet distribution: a perfect mirror has no density


class Scattering(NamedTuple):
    """The material of N points; a first axis of 1 stands for all of them."""

    base: Tensor  # (N, C) or (N, 1)
    metallic: Tensor | None  # (N, 1); None: Lambertian
    roughness: Tensor | None  # (N, 1)

    def select(self, rows: Tensor) -> Scattering:
        def some(part: Tensor) -> Tensor:
            return part if len(part) == 1 else part[rows]

        metallic, roughness = (None if part is None else some(part) for part in (self.metallic, self.roughness))
        return Scattering(some(self.base), metallic, roughness)

    @property
    def diffuse(self) -> Tensor:
        """Return the share that is scattered evenly."""
        return self.base if self.metallic is None else self.base * (1 - self.metallic)

    def evaluate(self, v: Tensor, n: Tensor, l: Tensor) -> Tensor:
        """Return f(v, l) (N, C), 1/sr, of unit directions (N, 3) to the viewer, of the normal and to the light, which is
        above."""
        if self.metallic is None or self.roughness is None:
            return self.base / math.pi
        h = normalize(v + l, dim=-1)
        a2 = (self.roughness * self.roughness).clamp(min=LEAST_ALPHA) ** 2
        specular = ggx(n, h, a2) * masking(dot(n, v).clamp(min=0), dot(n, l), a2)
        f0 = DIELECTRIC + (self.base - DIELECTRIC) * self.metallic
        grazing = (1 - dot(v, h)).clamp(0, 1)
        fresnel = f0 + (1 - f0) * grazing**5
        return (1 - fresnel) * self.diffuse / math.pi + fresnel * specular


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Return a · b (N, 1)."""
    return (a * b).sum(-1, keepdim=True)


def ggx(n: Tensor, h: Tensor, a2: Tensor) -> Tensor:
    """Return the density (N, 1) of microfacets with the normal h, α² = a2 (Walter et al. 2007). The sine is that of a cross
    product: 1 − cos² would round away what decides where α is small."""
    sine = torch.linalg.cross(n, h)
    d = dot(sine, sine) + a2 * dot(n, h) ** 2
    return a2 / (math.pi * d * d)


def masking(nv: Tensor, nl: Tensor, a2: Tensor) -> Tensor:
    """Return Smith's joint masking and shadowing with correlated heights over 4 (n·v)(n·l): (N, 1) (Heitz 2014, eq. 99)."""
    towards = nl * (a2 + (1 - a2) * nv * nv).sqrt()
    back = nv * (a2 + (1 - a2) * nl * nl).sqrt()
    return 0.5 / (towards + back)


def terminator(g: Tensor, n: Tensor, l: Tensor) -> Tensor:
    """Return a factor (N, 1) that takes the light on an interpolated normal n smoothly to zero where the light sets behind the
    face, whose normal is g (Chiang, Li and Burley 2019, "Taming the Shadow Terminator"). Both normals are on the light's side."""
    ratio = dot(g, l) / (dot(g, n).clamp(min=1e-6) * dot(n, l).clamp(min=1e-12))
    G = ratio.clamp(0, 1)
    return G + G * G - G * G * G
