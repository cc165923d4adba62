"""Points of lights with an extent, drawn by what they give to glossy surfaces where nothing lies between, the target: of
candidates that the light and the lobe have drawn some are kept in proportion to target / density (resampled importance sampling,
Talbot et al. 2005). csrc/shading/lit/light_sample.h does the same in the kernel."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from edgegrad.light.bsdf import DIELECTRIC, LEAST_ALPHA, Scattering, dot, ggx, masking
from edgegrad.light.sampling import CANDIDATES_FOR_ONE, DARK, MOST_SETS, SET_SIZE, SETS
from edgegrad.points.sobol import key_of, sobol
from edgegrad.scene.environment import Environment
from edgegrad.scene.lights import Light, LightPoints

from .antithetic import antithetic_set, seen_aside
from .lobes import Lobes, sobol_parts
from .mesh_light_sampling import EmissiveMeshSampler

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
        h = normalize(self.v + l, dim=-1)
        nl = dot(self.n, l)
        specular = ggx(self.n, h, a2) * masking(dot(self.n, self.v).clamp(min=0), nl, a2)
        fresnel = self.head_on + (1 - self.head_on) * (1 - dot(self.v, h)).clamp(0, 1) ** 5
        f = (1 - fresnel).abs() * self.diffuse / math.pi + fresnel.abs() * specular
        return torch.where((nl > 0) & (dot(self.g, l) > 0), nl * f, 0.0)[:, 0]


def resampled(
    light: Light,
    stream: int,
    surfaces: Glossy,
    count: int,
    meets: EmissiveMeshSampler | None = None,
    antithetic: bool = False,
) -> list[LightPoints]:
    """`count` points for each surface, from random numbers of a stream. Where nothing arrives their density is infinite.
    Surfaces `meets` a mesh that emits; an environment is everywhere the same.

    antithetic   directions to an environment in antithetic sets instead (antithetic.py; csrc/shading/lit/derivative_points.h):
               what is drawn, weighted and kept are all four of them; SETS for each point that is asked for, MOST_SETS where
               seen_aside()
    """
    with torch.no_grad():
        lobes = Lobes.of(surfaces.v, surfaces.n, surfaces.roughness)
        N, every = len(surfaces.n), torch.arange(len(surfaces.n), device=surfaces.n.device)
        together, keeps = 1, torch.full_like(every, count)
        if antithetic:
            aside = seen_aside(surfaces.v, surfaces.n, surfaces.g)
            together, keeps, count = SET_SIZE, count * torch.where(aside, MOST_SETS, SETS), count * MOST_SETS
        index = torch.zeros((N, count, together), dtype=torch.int64, device=surfaces.n.device)
        uv, density = surfaces.n.new_zeros((N, count, together, 2)), surfaces.n.new_full((N, count, together), math.inf)
        asked = lobes.narrow if meets is None else meets.is_drawn_by(lobes)
        interchangeable = torch.zeros_like(asked) if meets is None else meets.interchangeable(lobes)
        by_ball = torch.zeros_like(asked) if meets is None else meets.is_drawn_by_ball(lobes)
        for kept, few, ask_lobe, ball in itertools.product(keeps.unique().tolist(), *[(False, True)] * 3):
            all = kept if few else CANDIDATES_FOR_ONE * kept
            rows_ = every[(keeps == kept) & (interchangeable == few) & (asked == ask_lobe) & (by_ball == ball)]
            for rows in rows_.split(max(1, AT_ONCE // (all * together))) if len(rows_) else ():
                some = None if meets is None else meets.select(rows)
                drawn = _Drawn(light, stream, surfaces.select(rows), lobes.select(rows), some, ball, together)
                pool = drawn.candidates(all, all // 2 if ask_lobe else 0)
                points = pool.kept(stream, surfaces.seed[rows], kept)
                index[rows, :kept], uv[rows, :kept], density[rows, :kept] = points
                density[rows] *= kept / count  # they stand for all
        return [
            LightPoints(index[:, s, k], uv[:, s, k], density[:, s, k]) for s in range(count) for k in range(together)
        ]


class _Shares(NamedTuple):
    """How many candidates are drawn by each."""

    light: int
    lobe: int


class _Drawn(NamedTuple):
    """How candidates for N points are drawn."""

    light: Light
    stream: int
    surfaces: Glossy
    lobes: Lobes
    meets: EmissiveMeshSampler | None
    by_ball: bool  # around the mesh
    together: int  # K directions in each

    def candidates(self, all: int, by_lobe: int) -> _Candidates:
        N, shares = len(self.surfaces.n), _Shares(all - by_lobe, by_lobe)
        seed = self.surfaces.seed
        every = torch.arange(N, device=seed.device)
        rows, u = every.repeat_interleave(shares.light), sobol_parts(seed, key_of(self.stream, 0), shares.light)
        if self.by_ball:
            assert self.meets is not None
            towards = self.meets.select(rows)
            ray, drawn = towards.towards(towards.draw_by_ball(u))
            rows = rows[ray]
        else:
            drawn = self.light.draw(u)
        kinds = [self._weighted(rows, drawn, shares)]
        if by_lobe:
            l = self.lobes.repeated(by_lobe).draw(sobol_parts(seed, key_of(self.stream, 1), by_lobe))
            if self.meets is None:
                assert isinstance(self.light, Environment)
                rows, points = every.repeat_interleave(by_lobe), self.light.points_at(l)
            else:
                ray, points = self.meets.repeated(by_lobe).towards(l)
                rows, l = ray // by_lobe, self.meets.select(ray // by_lobe).directions(self.light.place(points))
            kinds.append(self._weighted(rows, points, shares, l))
        index, uv, measure, target, weight = (torch.cat(part, 1) for part in zip(*kinds, strict=True))
        return _Candidates(index, uv, measure, target, weight.cumsum(1))

    def _weighted(self, rows: Tensor, points: LightPoints, shares: _Shares, l: Tensor | None = None) -> list[Tensor]:
        """Index, uv, measure, target and weight of points of the surfaces `rows`, ascending, in rows as long as the longest.
        Directions l are those that the lobe has drawn."""
        surfaces, of_lobe, K = self.surfaces.select(rows), l is not None, self.together
        all = [points]
        if self.meets is not None:
            meets = self.meets.select(rows)
            if self.by_ball:
                all = [points := meets.with_ball_density(points)]
            L = meets.directions(self.light.place(points))[:, None] if l is None else l[:, None]
            measure, brightness = meets.solid_angles(points)[:, None], meets.brightness(points)[:, None]
        else:
            assert isinstance(self.light, Environment)
            l = self.light.place(points) if l is None else l
            L, measure = l[:, None], torch.ones_like(l[:, :1])
            if K > 1:
                alpha = (surfaces.roughness * surfaces.roughness).clamp(min=LEAST_ALPHA)
                L, measure = antithetic_set(surfaces.v, surfaces.n, alpha, l)
                all += [self.light.points_at(other) for other in L.unbind(1)[1:]]
            brightness = torch.stack([self.light.brightness_at(each) for each in all], 1)
        index, uv, density = (torch.stack(part, 1) for part in zip(*all, strict=True))
        flat, each = L.reshape(-1, 3), surfaces.repeated(K)
        scattered = each.scattered(flat).reshape(measure.shape)
        target = torch.where(measure > 0, scattered * brightness * measure, 0.0).sum(1)
        # The density of lobes is known above the surface alone: what they draw below is dropped.
        above = (dot(each.n, flat)[:, 0] > 0).reshape(measure.shape)
        if of_lobe:
            target = target.where(above[:, 0], 0.0)
        # A mesh's own density counts area already.
        light = shares.light * (density if self.meets is not None else density * measure).sum(1)
        lobe = torch.zeros_like(light)
        if shares.lobe:
            lobes = self.lobes.select(rows).repeated(K).density(flat).reshape(measure.shape)
            lobe = shares.lobe * (lobes.where(above, 0.0) * measure).sum(1)
        # The power heuristic (Veach and Guibas 1995).
        weight = torch.where(target > 0, target * (lobe if of_lobe else light) / (light**2 + lobe**2), 0.0)
        if self.meets is not None:
            measure = torch.ones_like(measure)
        N = len(self.surfaces.n)
        many = torch.bincount(rows, minlength=N)
        place = torch.arange(len(rows), device=rows.device) - (many.cumsum(0) - many)[rows]
        J = max(1, int(many.max()))  # one that is nothing where all directions miss

        def padded(part: Tensor) -> Tensor:
            return part.new_zeros((N, J, *part.shape[1:])).index_put((rows, place), part)

        return [padded(part) for part in (index, uv, measure, target, weight)]


class _Candidates(NamedTuple):
    """J for each of N points, each of K directions."""

    index: Tensor  # pyright: ignore[reportIncompatibleMethodOverride]: (N, J, K)
    uv: Tensor  # (N, J, K, 2)
    measure: Tensor  # (N, J, K) the measure that each stands for, over that of the first
    target: Tensor  # (N, J) of all K
    running: Tensor  # (N, J) the running sum of their weights, target / density

    def kept(self, stream: int, seed: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the index, uv and density of `count` times K points, drawn with one random number each (systematic
        resampling)."""
        total = self.running[:, -1:]
        u = sobol(seed, key_of(stream, 2))[:, :1]
        at = (torch.arange(count, device=u.device) + u) / count * total
        j = torch.searchsorted(self.running, at, right=True).clamp(max=self.running.shape[1] - 1)
        rows = torch.arange(len(j), device=j.device)[:, None]
        stands_for = self.measure[rows, j] * self.measure.shape[2] * total[..., None]
        density = torch.where(stands_for > 0, self.target[rows, j][..., None] / stands_for, math.inf)
        return self.index[rows, j], self.uv[rows, j], density
