"""Images of small lit scenes by brute force in float64: textbook formulas, and lights by quadrature.

    L(y, v) = emission + Σ_k f(v, l_k) max(0, n·l_k) V(y, l_k) E_k(y)

with the points k of each light on a regular grid: nothing is drawn at random, and nothing is shared with the code that it checks
but which face is seen, which the twin in tests/oracles/reference.py finds. For images alone: shadows have no derivative here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from edgegrad.camera.camera import Camera
from edgegrad.scene.environment import Environment
from edgegrad.scene.lights import DirectionalLight, Light, PointLight, SpotLight
from edgegrad.scene.mesh import Mesh
from edgegrad.scene.scene import Scene

from .reference import closest_faces

F64 = torch.float64
BLOCK = 1 << 14  # points whose shadow rays are tested against all faces at once


class LightPoint(NamedTuple):
    """One point of a light, as N surface points see it."""

    l: Tensor  # (N, 3) unit directions to it
    distance: Tensor  # (N, 1); infinite for a direction
    irradiance: Tensor  # (N, C) or (N, 1), head-on, without what hides it
    faces: Tensor  # (K,) of the scene, which cannot hide it


def lit_image(scene: Scene, camera: Camera, grid: int = 8, fine: int = 12) -> Tensor:
    """Return the image (H, W, C), float64, from grid × grid points a pixel and about fine² of each light with an extent.

    Materials with constants alone, normals of faces or interpolated ones; a single perspective camera; no alpha, and no
    environment in the background.
    """
    H, W = camera.size
    y, x = ((torch.arange(n * grid, dtype=F64) + 0.5) / grid for n in (H, W))
    points = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)
    faces = closest_faces(scene, camera, points)
    C = scene.channels
    behind = torch.zeros(C, dtype=F64) if scene.background is None else scene.background.double()
    image = behind.expand(len(points), C).clone()
    rows = (faces >= 0).nonzero()[:, 0]
    image[rows] = _surface(scene, camera, points[rows], faces[rows], fine)
    return image.reshape(H, grid, W, grid, C).mean((1, 3))


def _surface(scene: Scene, camera: Camera, points: Tensor, faces: Tensor, fine: int) -> Tensor:
    """Return the radiance (N, C) of faces (N,) at image points (N, 2)."""
    triangles = torch.cat([mesh.verts.double()[mesh.faces.long()] for mesh in scene.meshes])  # (F, 3, 3)
    M, K = camera.world_to_camera.double(), camera.K.double()
    ray = torch.linalg.solve(K, torch.cat([points, torch.ones_like(points[:, :1])], 1).mT).mT @ M[:3, :3]
    eye = -M[:3, :3].mT @ M[:3, 3]
    a, b, c = triangles[faces].unbind(1)
    g = normalize(torch.linalg.cross(b - a, c - a), dim=1)
    depth = _dot(a - eye, g) / _dot(ray, g)
    place, v = eye + depth * ray, -normalize(ray, dim=1)
    front = _dot(g, v) >= 0
    weights = _weights(place, a, b, c)
    g = torch.where(front, g, -g)
    out = torch.zeros((len(points), scene.channels), dtype=F64)
    first = 0
    for mesh in scene.meshes:
        rows = ((faces >= first) & (faces < first + len(mesh.faces))).nonzero()[:, 0]
        n = g[rows]
        if mesh.normals is not None:
            own = mesh.normals.double()[mesh.faces.long()[faces[rows] - first]]
            n = normalize((weights[rows][:, :, None] * own).sum(1), dim=1)
            n = torch.where(_dot(n, g[rows]) < 0, -n, n)
        surface = Surface(place[rows], v[rows], g[rows], n, faces[rows])
        radiance = _mesh_radiance(scene, mesh, surface, triangles, weights[rows], faces[rows] - first, fine)
        material = mesh.material
        shown = torch.ones_like(front[rows]) if material is None or material.two_sided else front[rows]
        out[rows] = torch.where(shown, radiance, 0.0)
        first += len(mesh.faces)
    return out


class Surface(NamedTuple):
    place: Tensor  # (N, 3)
    v: Tensor  # (N, 3) unit directions to the viewer
    g: Tensor  # (N, 3) normals of the faces, on the viewer's side
    n: Tensor  # (N, 3) those that shade
    face: Tensor  # (N,)


def _mesh_radiance(
    scene: Scene, mesh: Mesh, at: Surface, triangles: Tensor, weights: Tensor, face: Tensor, fine: int
) -> Tensor:
    material = mesh.material
    color = torch.ones((1, 1), dtype=F64)
    if mesh.colors is not None:
        color = (weights[:, :, None] * mesh.colors.double()[mesh.faces.long()[face]]).sum(1)
    if material is None:
        return color

    def constant(value: object, default: float) -> Tensor:
        return torch.as_tensor(default if value is None else value).detach().double().reshape(1, -1)

    base = color * constant(material.base_color, 1.0)
    total = constant(material.emission, 0.0).expand(len(face), -1)
    rough = None
    if material.metallic is not None or material.roughness is not None:
        rough = constant(material.metallic, 0.0), constant(material.roughness, 1.0)
    for light in (*scene.lights, *scene.meshes):
        for point in _points(scene, light, at, fine):
            nl, gl = _dot(at.n, point.l), _dot(at.g, point.l)
            lit = ((nl > 0) & (gl > 0))[:, 0].nonzero()[:, 0]
            hidden = torch.zeros_like(nl)
            hidden[lit, 0] = _hidden(at.place[lit], at.face[lit], point, lit, triangles).double()
            shade = _scattered(base, rough, at.v, at.n, point.l) * nl * point.irradiance * (1.0 - hidden)
            if mesh.normals is not None:  # the terminator of Chiang, Li and Burley (2019)
                G = (gl / (_dot(at.g, at.n) * nl).clamp(min=1e-12)).clamp(0, 1)
                shade = shade * (G + G**2 - G**3)
            total = total + torch.where((nl > 0) & (gl > 0), shade, 0.0)
    return total


def _scattered(base: Tensor, rough: tuple[Tensor, Tensor] | None, v: Tensor, n: Tensor, l: Tensor) -> Tensor:
    """f (N, C): Lambert, or the model of glTF 2.0, appendix B."""
    if rough is None:
        return base / math.pi
    metallic, roughness = rough
    alpha = (roughness**2).clamp(min=1e-4)
    h = normalize(v + l, dim=1)
    nh, nv, nl, vh = (x.clamp(min=1e-9) for x in (_dot(n, h), _dot(n, v), _dot(n, l), _dot(v, h)))
    D = alpha**2 / (math.pi * (nh**2 * (alpha**2 - 1) + 1) ** 2)

    def smith(c: Tensor) -> Tensor:
        return (-1 + (1 + alpha**2 * (1 / c**2 - 1)).sqrt()) / 2

    G = 1 / (1 + smith(nl) + smith(nv))
    F0 = 0.04 * (1 - metallic) + base * metallic
    F = F0 + (1 - F0) * (1 - vh) ** 5
    return (1 - F) * base * (1 - metallic) / math.pi + F * D * G / (4 * nl * nv)


def _points(scene: Scene, light: Light | Mesh, at: Surface, fine: int) -> list[LightPoint]:
    none = torch.empty(0, dtype=torch.int64)
    if isinstance(light, Mesh):
        if light.material is None or light.material.emission is None:
            return []
        return _panel(scene, light, at, fine)
    if isinstance(light, Environment):
        return _sky(light, at, fine)
    power = torch.as_tensor(light.intensity).double() * (1.0 if light.color is None else light.color.double())  # type: ignore[attr-defined]
    power = power.detach().reshape(1, -1)
    if isinstance(light, DirectionalLight):
        l = normalize(-light.direction.detach().double(), dim=0).expand_as(at.place)
        return [LightPoint(l, torch.full_like(l[:, :1], math.inf), power.expand(len(l), -1), none)]
    assert isinstance(light, (PointLight, SpotLight))
    away = light.position.detach().double() - at.place
    distance = away.norm(dim=1, keepdim=True)
    l = away / distance.clamp(min=1e-300)
    if isinstance(light, SpotLight):
        inner, outer = (math.cos(float(angle)) for angle in (light.inner_angle, light.outer_angle))
        cosine = -l @ normalize(light.direction.detach().double(), dim=0)
        power = power * ((cosine - outer) / max(inner - outer, 1e-3)).clamp(0, 1)[:, None] ** 2
    return [LightPoint(l, distance, power / distance**2, none)]


def _panel(scene: Scene, mesh: Mesh, at: Surface, fine: int) -> list[LightPoint]:
    """Return the middles of fine² triangles of each face."""
    material = mesh.material
    assert material is not None
    radiance = torch.as_tensor(material.emission).detach().double().reshape(1, -1)
    first = sum(len(m.faces) for m in scene.meshes[: [m is mesh for m in scene.meshes].index(True)])
    own = torch.arange(first, first + len(mesh.faces))
    middles = [
        ((i + k / 3) / fine, (j + k / 3) / fine)
        for i in range(fine) for j in range(fine - i) for k in ((1, 2) if j < fine - i - 1 else (1,))
    ]  # fmt: skip
    found = []
    for a, b, c in mesh.verts.detach().double()[mesh.faces.long()]:
        normal = torch.linalg.cross(b - a, c - a) / 2
        for s, t in middles:
            away = a + s * (b - a) + t * (c - a) - at.place
            distance = away.norm(dim=1, keepdim=True)
            l = away / distance.clamp(min=1e-300)
            facing = -l @ normal[:, None]
            facing = facing.abs() if material.two_sided else facing.clamp(min=0)
            found.append(LightPoint(l, distance, radiance * facing / distance**2 / fine**2, own))
    return found


def _sky(light: Environment, at: Surface, fine: int) -> list[LightPoint]:
    """Return directions of equal solid angles around the axis of the image."""
    found = []
    none = torch.empty(0, dtype=torch.int64)
    R = torch.eye(3, dtype=F64) if light.rotation is None else light.rotation.detach().double()
    for i in range(fine):
        for j in range(2 * fine):
            y, phi = (2 * i + 1) / fine - 1, math.pi * (j + 0.5) / fine - math.pi
            r = math.sqrt(1 - y * y)
            d = torch.tensor([r * math.sin(phi), y, -r * math.cos(phi)], dtype=F64)
            radiance = light.radiance.detach().double()
            if radiance.dim() == 3:
                radiance = _texel(radiance, math.acos(y) / math.pi, phi / (2 * math.pi) + 0.5)
            l = (R @ d).expand_as(at.place)
            angle = 4 * math.pi / (2 * fine * fine)
            found.append(LightPoint(l, torch.full_like(l[:, :1], math.inf), angle * radiance[None], none))
    return found


def _texel(image: Tensor, down: float, right: float) -> Tensor:
    """Look a colour (C,) up bilinearly at a place in [0, 1]², periodic in longitude."""
    h, w = image.shape[:2]
    row, column = down * h - 0.5, right * w - 0.5
    i, j = math.floor(row), math.floor(column)
    total = torch.zeros(image.shape[2], dtype=F64)
    for di in (0, 1):
        for dj in (0, 1):
            weight = (1 - abs(row - i - di)) * (1 - abs(column - j - dj))
            total = total + weight * image[min(max(i + di, 0), h - 1), (j + dj) % w]
    return total


def _hidden(place: Tensor, face: Tensor, point: LightPoint, rows: Tensor, triangles: Tensor) -> Tensor:
    """Return (N,) whether a face other than the point's own lies between (Möller and Trumbore 1997)."""
    a, b, c = triangles.unbind(1)
    e1, e2 = b - a, c - a
    others = torch.ones(len(triangles), dtype=torch.bool)
    others[point.faces] = False
    found = []
    for some in torch.arange(len(place)).split(max(1, BLOCK * 16 // len(triangles))):
        d, o = point.l[rows[some]], place[some]
        far = point.distance[rows[some]]
        p = torch.linalg.cross(d[:, None].expand(-1, len(e2), -1), e2[None].expand(len(d), -1, -1))
        det = (p * e1).sum(-1)
        inverse = 1.0 / torch.where(det == 0, 1.0, det)
        s = o[:, None] - a
        u = (s * p).sum(-1) * inverse
        q = torch.linalg.cross(s, e1[None].expand_as(s))
        w = (q * d[:, None]).sum(-1) * inverse
        t = (q * e2).sum(-1) * inverse
        meets = (det != 0) & (u >= 0) & (w >= 0) & (u + w <= 1) & (t > 1e-9 * s.norm(dim=-1)) & (t < far * (1 - 1e-9))
        meets &= others & (torch.arange(len(triangles)) != face[some][:, None])
        found.append(meets.any(1))
    return torch.cat(found) if found else torch.empty(0, dtype=torch.bool)


def _weights(place: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Return barycentrics (N, 3)."""
    normal = torch.linalg.cross(b - a, c - a)
    squared = _dot(normal, normal)
    parts = [_dot(torch.linalg.cross(q - p, place - p), normal) / squared for p, q in ((b, c), (c, a), (a, b))]
    return torch.cat(parts, 1)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1, keepdim=True)
