"""Points of environments, drawn by what they give to glossy surfaces where nothing lies between, the target: of candidates that
the light and the lobe have drawn some are kept in proportion to target / density (resampled importance sampling, Talbot et al.
2005). csrc/shading/lit/light_sample.h does the same in the kernel."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ..points.seeds import uniform
from ..scene.environment import Environment
from ..scene.lights import LightPoints
from .bsdf import DIELECTRIC, LEAST_ALPHA, Scattering, dot, ggx, masking
from .lobes import Lobes

EACH = 8  # candidates for one point that is kept, half of them by the lobe if it is narrow
# Where radiance has derivatives, points are drawn as if no surface were darker, for what is black has derivatives too.
DARK = 0.05
AT_ONCE = 1 << 19  # candidates


class Glossy(NamedTuple):
    """N points of glossy surfaces, without derivatives, in float64."""

    v: Tensor  # (N, 3) unit directions to the viewer
    n: Tensor  # (N, 3) unit shading normals
    g: Tensor  # (N, 3) unit normals of the faces
    roughness: Tensor  # (N, 1)
    diffuse: Tensor  # (N, 1), the mean of the channels
    head_on: Tensor  # (N, 1) the reflectance along the normal, the mean of the channels
    seed: Tensor  # (N,) int64

    @classmethod
    def of(cls, v: Tensor, n: Tensor, g: Tensor, scattering: Scattering, seed: Tensor) -> Glossy:
        base, metallic, roughness = scattering
        assert metallic is not None and roughness is not None
        base, metallic = base.detach().double(), metallic.detach().double()
        diffuse = (base * (1 - metallic)).abs().mean(1, keepdim=True).clamp(min=DARK)
        head_on = (DIELECTRIC * (1 - metallic) + base * metallic).abs().mean(1, keepdim=True).clamp(min=DARK)
        v, n, g = v.detach().double(), n.detach().double(), g.detach().double()
        roughness, diffuse, head_on = (x.detach().double().expand(len(n), 1) for x in (roughness, diffuse, head_on))
        return cls(v, n, g, roughness, diffuse, head_on, seed)

    def select(self, rows: Tensor) -> Glossy:
        return Glossy(*(part[rows] for part in self))

    def repeated(self, times: int) -> Glossy:
        """Each point so many times."""
        return Glossy(*(part.repeat_interleave(times, 0) for part in self))

    def scattered(self, l: Tensor) -> Tensor:
        """(N,) about f max(0, n·l), of unit directions (N, 3); zero only where nothing is scattered."""
        a2 = (self.roughness * self.roughness).clamp(min=LEAST_ALPHA) ** 2
        h = torch.nn.functional.normalize(self.v + l, dim=-1)
        nl = dot(self.n, l)
        specular = ggx(self.n, h, a2) * masking(dot(self.n, self.v).clamp(min=0), nl, a2)
        fresnel = self.head_on + (1 - self.head_on) * (1 - dot(self.v, h)).clamp(0, 1) ** 5
        f = (1 - fresnel).abs() * self.diffuse / math.pi + fresnel.abs() * specular
        return torch.where((nl > 0) & (dot(self.g, l) > 0), nl * f, 0.0)[:, 0]


def resampled(light: Environment, stream: int, surfaces: Glossy, count: int) -> list[LightPoints]:
    """`count` points for each surface, from random numbers of a stream. Where nothing arrives their density is infinite."""
    with torch.no_grad():
        lobes = Lobes.of(surfaces.v, surfaces.n, surfaces.roughness)
        N, every = len(surfaces.n), torch.arange(len(surfaces.n), device=surfaces.n.device)
        index = torch.zeros((N, count), dtype=torch.int64, device=surfaces.n.device)
        uv, density = surfaces.n.new_zeros((N, count, 2)), surfaces.n.new_zeros((N, count))
        at_once = max(1, AT_ONCE // (EACH * count))
        for some, by_lobe in ((every[lobes.narrow], EACH * count // 2), (every[~lobes.narrow], 0)):
            for rows in some.split(at_once):
                pool = _Candidates.of(light, stream, surfaces.select(rows), lobes.select(rows), EACH * count, by_lobe)
                index[rows], uv[rows], density[rows] = pool.kept(stream, surfaces.seed[rows], count)
        return [LightPoints(index[:, k], uv[:, k], density[:, k]) for k in range(count)]


class _Candidates(NamedTuple):
    """J for each of N points."""

    index: Tensor  # pyright: ignore[reportIncompatibleMethodOverride]: (N, J)
    uv: Tensor  # (N, J, 2)
    target: Tensor  # (N, J)
    running: Tensor  # (N, J) the running sum of their weights, target / density

    @classmethod
    def of(cls, light: Environment, stream: int, surfaces: Glossy, lobes: Lobes, all: int, by_lobe: int) -> _Candidates:
        N, by_light = len(surfaces.n), all - by_lobe
        drawn = light.draw(uniform(_parts(surfaces.seed, by_light), 3, stream))
        kinds = [(drawn, light.place(drawn), by_light)]
        if by_lobe:
            l = lobes.repeated(by_lobe).draw(uniform(_parts(surfaces.seed, by_lobe), 5, stream)[:, 3:])
            kinds.append((light.points_at(l), l, by_lobe))
        parts = []
        for k, (points, l, times) in enumerate(kinds):
            target = surfaces.repeated(times).scattered(l) * light.brightness_at(points)
            densities = by_light * points.density, by_lobe * lobes.repeated(times).density(l)
            # The power heuristic (Veach and Guibas 1995).
            weight = target * densities[k] / (densities[0] ** 2 + densities[1] ** 2)
            numbers = points.index, points.uv, target, torch.where(target > 0, weight, 0.0)
            parts.append([part.reshape(N, times, *part.shape[1:]) for part in numbers])
        index, uv, target, weight = (torch.cat(part, 1) for part in zip(*parts, strict=True))
        return cls(index, uv, target, weight.cumsum(1))

    def kept(self, stream: int, seed: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Of `count` points the index, uv and density, drawn with one random number each (systematic resampling)."""
        total = self.running[:, -1:]
        u = uniform(seed, 6, stream)[:, 5:]
        at = (torch.arange(count, device=u.device) + u) / count * total
        j = torch.searchsorted(self.running, at, right=True).clamp(max=self.running.shape[1] - 1)
        density = torch.where(total > 0, self.target.gather(1, j) / total, math.inf)
        return self.index.gather(1, j), self.uv.gather(1, j[..., None].expand(-1, -1, 2)), density


def _parts(seed: Tensor, parts: int) -> Tensor:
    """(N · parts,): see Hits.random."""
    return (seed[:, None] * parts + torch.arange(parts, device=seed.device)).reshape(-1)
