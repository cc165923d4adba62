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
from .companions import COMPANIONS, companions
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


def resampled(
    light: Environment, stream: int, surfaces: Glossy, count: int, in_fours: bool = False
) -> list[LightPoints]:
    """`count` points for each surface, from random numbers of a stream. Where nothing arrives their density is infinite.

    in_fours   so many directions with their companions instead (companions.py; csrc/shading/lit/derivative_points.h): what is
               drawn, weighted and kept are all four of them
    """
    with torch.no_grad():
        lobes = Lobes.of(surfaces.v, surfaces.n, surfaces.roughness)
        N, every, together = len(surfaces.n), torch.arange(len(surfaces.n)), COMPANIONS if in_fours else 1
        index = torch.zeros((N, count, together), dtype=torch.int64)
        uv, density = surfaces.n.new_zeros((N, count, together, 2)), surfaces.n.new_zeros((N, count, together))
        at_once = max(1, AT_ONCE // (EACH * count * together))
        for some, by_lobe in ((every[lobes.narrow], EACH * count // 2), (every[~lobes.narrow], 0)):
            for rows in some.split(at_once):
                pool = _Candidates.of(
                    light,
                    stream,
                    surfaces.select(rows),
                    lobes.select(rows),
                    (EACH * count - by_lobe, by_lobe),
                    together,
                )
                index[rows], uv[rows], density[rows] = pool.kept(stream, surfaces.seed[rows], count)
        return [
            LightPoints(index[:, s, k], uv[:, s, k], density[:, s, k]) for s in range(count) for k in range(together)
        ]


class _Candidates(NamedTuple):
    """J for each of N points, each of K directions."""

    index: Tensor  # pyright: ignore[reportIncompatibleMethodOverride]: (N, J, K)
    uv: Tensor  # (N, J, K, 2)
    measure: Tensor  # (N, J, K) the solid angle that each stands for, over that of the first
    target: Tensor  # (N, J) of all K
    running: Tensor  # (N, J) the running sum of their weights, target / density

    @classmethod
    def of(
        cls, light: Environment, stream: int, surfaces: Glossy, lobes: Lobes, shares: tuple[int, int], together: int
    ) -> _Candidates:
        """As many by the light and by the lobe as the shares say."""
        N = len(surfaces.n)
        drawn = light.draw(uniform(_parts(surfaces.seed, shares[0]), 3, stream))
        kinds = [(drawn, light.place(drawn))]
        if shares[1]:
            l = lobes.repeated(shares[1]).draw(uniform(_parts(surfaces.seed, shares[1]), 5, stream)[:, 3:])
            kinds.append((light.points_at(l), l))
        parts = []
        for k, (points, l) in enumerate(kinds):
            seen = surfaces.repeated(shares[k])
            L, measure = l[:, None], l.new_ones((len(l), 1))
            all = [points]
            if together > 1:
                alpha = (seen.roughness * seen.roughness).clamp(min=LEAST_ALPHA)
                L, measure = companions(seen.v, seen.n, alpha, l)
                all += [light.points_at(direction) for direction in L.unbind(1)[1:]]
            index, uv, by_light = (torch.stack(part, 1) for part in zip(*all, strict=True))
            bright = torch.stack([light.brightness_at(points) for points in all], 1)
            flat, each = L.reshape(-1, 3), seen.repeated(together)
            target = (each.scattered(flat).reshape(measure.shape) * bright * measure).sum(1)
            # The density of lobes is known above the surface alone: what they draw below is dropped.
            above = dot(each.n, flat)[:, 0] > 0
            by_lobe = lobes.repeated(shares[k] * together).density(flat).where(above, 0.0).reshape(measure.shape)
            target = target.where(above.reshape(measure.shape)[:, 0] | (k == 0), 0.0)
            densities = shares[0] * (by_light * measure).sum(1), shares[1] * (by_lobe * measure).sum(1)
            # The power heuristic (Veach and Guibas 1995).
            weight = target * densities[k] / (densities[0] ** 2 + densities[1] ** 2)
            numbers = index, uv, measure, target, torch.where(target > 0, weight, 0.0)
            parts.append([part.reshape(N, shares[k], *part.shape[1:]) for part in numbers])
        index, uv, measure, target, weight = (torch.cat(part, 1) for part in zip(*parts, strict=True))
        return cls(index, uv, measure, target, weight.cumsum(1))

    def kept(self, stream: int, seed: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Of `count` times K points the index, uv and density, drawn with one random number (systematic resampling)."""
        total = self.running[:, -1:]
        u = uniform(seed, 6, stream)[:, 5:]
        at = (torch.arange(count, device=u.device) + u) / count * total
        j = torch.searchsorted(self.running, at, right=True).clamp(max=self.running.shape[1] - 1)
        rows = torch.arange(len(j), device=j.device)[:, None]
        stands_for = self.measure[rows, j] * self.measure.shape[2] * total[..., None]
        density = torch.where(stands_for > 0, self.target[rows, j][..., None] / stands_for, math.inf)
        return self.index[rows, j], self.uv[rows, j], density


def _parts(seed: Tensor, parts: int) -> Tensor:
    """(N · parts,): see Hits.random."""
    return (seed[:, None] * parts + torch.arange(parts, device=seed.device)).reshape(-1)
