"""A path tracer of a few lines, slow and in float64: directions all over the hemisphere, one point of a light by area at each
point of a path, rays against all triangles (Möller and Trumbore 1997). It shares no draw, ray or density with the kernel."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

import edgegrad as eg
from edgegrad.light.bsdf import Scattering
from edgegrad.scene.environment import Environment
from edgegrad.scene.lights import PointLight

F64 = torch.float64


class PathOracle:
    """Paths of a scene whose materials are constants. `indirect()` is what light brings to a point after at least two
    scatterings."""

    def __init__(self, scene: eg.Scene, seed: int = 0) -> None:
        self._draw = torch.Generator().manual_seed(seed)
        self._lights = scene.lights
        corners, self._of_face, self._materials = [], [], []
        for k, mesh in enumerate(scene.meshes):
            corners.append(mesh.verts.double()[mesh.faces.long()])
            self._of_face += [k] * len(mesh.faces)
            m = mesh.material
            assert m is not None
            base, emission = (
                torch.as_tensor(0.0 if x is None else x).double().expand(3) for x in (m.base_color, m.emission)
            )
            parameters = [
                torch.as_tensor(d if x is None else x).double() for x, d in ((m.metallic, 0.0), (m.roughness, 1.0))
            ]
            self._materials.append((base, emission, *parameters, m.is_glossy, m.two_sided))
        self._corner = torch.cat(corners)
        edges = self._corner[:, 1:] - self._corner[:, :1]
        cross = torch.linalg.cross(edges[:, 0], edges[:, 1])
        self._area, self._normal = cross.norm(dim=1) / 2, normalize(cross, dim=1)
        self._of_face = torch.tensor(self._of_face)

    def _uniform(self, n: int, k: int) -> Tensor:
        return torch.rand(n, k, dtype=F64, generator=self._draw)

    def _hits(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """(N,) the nearest face, −1: none, and its distance."""
        q0, e1, e2 = (
            self._corner[:, 0],
            self._corner[:, 1] - self._corner[:, 0],
            self._corner[:, 2] - self._corner[:, 0],
        )
        best, face = torch.full((len(origin),), math.inf, dtype=F64), torch.full((len(origin),), -1)
        for f in range(len(q0)):
            p = torch.linalg.cross(direction, e2[f].expand_as(direction))
            s = origin - q0[f]
            q = torch.linalg.cross(s, e1[f].expand_as(s))
            scale = 1 / (p @ e1[f])
            u, v, t = (s * p).sum(1) * scale, (direction * q).sum(1) * scale, (q @ e2[f]) * scale
            nearer = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9) & (t < best)
            best, face = torch.where(nearer, t, best), torch.where(nearer, f, face)
        return face, best

    def _scatter(self, face: Tensor, v: Tensor, n: Tensor, l: Tensor) -> Tensor:
        f = torch.zeros(len(face), 3, dtype=F64)
        for k, (base, _, metallic, roughness, glossy, _) in enumerate(self._materials):
            some = (self._of_face[face] == k).nonzero()[:, 0]
            parameters = (metallic[None, None], roughness[None, None]) if glossy else (None, None)
            f[some] = Scattering(base[None], *parameters).evaluate(v[some], n[some], l[some]).expand(len(some), 3)
        return f

    def _direct(self, face: Tensor, y: Tensor, v: Tensor, n: Tensor) -> Tensor:
        total = torch.zeros(len(face), 3, dtype=F64)
        for light in self._lights:
            if isinstance(light, PointLight):
                d = light.position - y
                reaches = float(torch.as_tensor(light.intensity)) / (d * d).sum(1, keepdim=True)
                total += self._lit(face, y, v, n, normalize(d, dim=1), d.norm(dim=1)) * reaches
            elif isinstance(light, Environment):
                l, _ = self._above(n)
                total += self._lit(face, y, v, n, l, torch.full((len(face),), math.inf)) * 2 * math.pi * light.radiance
        emission = torch.stack([material[1] for material in self._materials])[self._of_face]  # (F, 3)
        weight = self._area * (emission.sum(1) > 0)
        if float(weight.sum()) > 0:
            at = torch.multinomial(weight, len(face), replacement=True, generator=self._draw)
            u = self._uniform(len(face), 2)
            root = u[:, :1].sqrt()
            b = torch.cat([1 - root, root * (1 - u[:, 1:]), root * u[:, 1:]], 1)
            d = (b[:, :, None] * self._corner[at]).sum(1) - y
            l, r = normalize(d, dim=1), d.norm(dim=1)
            facing = -(self._normal[at] * l).sum(1)
            both = torch.tensor([material[5] for material in self._materials])[self._of_face[at]]
            facing = torch.where(both, facing.abs(), facing.clamp(min=0))
            reaches = emission[at] * (facing / r**2 * weight.sum())[:, None]
            total += self._lit(face, y, v, n, l, r - 1e-9) * reaches
        return total

    def _lit(self, face: Tensor, y: Tensor, v: Tensor, n: Tensor, l: Tensor, end: Tensor) -> Tensor:
        cosine = (n * l).sum(1)
        _, t = self._hits(y, l)
        there = (cosine > 0) & ((t >= end) | ~torch.isfinite(t))
        out = torch.zeros(len(face), 3, dtype=F64)
        out[there] = self._scatter(face[there], v[there], n[there], l[there]) * cosine[there, None]
        return out

    def _above(self, n: Tensor) -> tuple[Tensor, Tensor]:
        """Unit directions, uniform above the normals, and their cosines."""
        u = self._uniform(len(n), 2)
        z, phi = 1 - 2 * u[:, 0], 2 * math.pi * u[:, 1]
        across = (1 - z * z).sqrt()
        l = torch.stack([across * phi.cos(), across * phi.sin(), z], 1)
        cosine = (l * n).sum(1)
        return torch.where(cosine[:, None] < 0, -l, l), cosine.abs()

    def indirect(self, face: int, y: Tensor, v: Tensor, bounces: int, paths: int) -> tuple[Tensor, Tensor]:
        """(3,) the radiance that the point y of a face sends along the unit direction v, and its standard error."""
        faces = torch.full((paths,), face)
        y, v = y.double().expand(paths, 3), v.double().expand(paths, 3)
        through, total = torch.ones(paths, 3, dtype=F64), torch.zeros(paths, 3, dtype=F64)
        rows = torch.arange(paths)
        for _ in range(bounces - 1):
            n = self._normal[faces]
            n = torch.where((n * v).sum(1, keepdim=True) < 0, -n, n)
            l, cosine = self._above(n)
            through = through * self._scatter(faces, v, n, l) * (2 * math.pi * cosine)[:, None]
            faces, t = self._hits(y, l)
            met = (faces >= 0).nonzero()[:, 0]
            rows, faces, through = rows[met], faces[met], through[met]
            y, v = y[met] + t[met, None] * l[met], -l[met]
            n = self._normal[faces]
            n = torch.where((n * v).sum(1, keepdim=True) < 0, -n, n)
            total.index_add_(0, rows, through * self._direct(faces, y, v, n))
        return total.mean(0), total.std(0) / math.sqrt(paths)
