"""A strip between two faces, of which one is lit and the other sees it: how the border of what is seen moves, without samples.

The image is ∫ k(x − c) ∫ h(y₁, y₂) V dα dβ dx, with y₁ on the face that is seen at x, and y₂ at the barycentrics α, β of the face
that sends light. What the strip hides of that face from y₁ is the projection of its two triangles, four-sided in α, β too. So
what the border alone changes is −∮ h (v × ds) around that (Reynolds), with its sides' velocity v and the integrand as it is.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

import edgegrad as eg
from edgegrad.light.bsdf import Scattering
from edgegrad.light.bsdf import dot as cosine

F64 = torch.float64


class Strip(NamedTuple):
    """Vertices of the three meshes: the receiver and the reflector are triangles, the strip is two, or, for the oracle alone, any
    polygon of which nothing hides another part."""

    receiver: Tensor
    reflector: Tensor
    strip: Tensor
    camera: eg.Camera
    light: Tensor  # the place of a point light of 4 W/sr

    @classmethod
    def standard(cls, dtype: torch.dtype = F64) -> Strip:
        place = torch.tensor([0.5, 0.1, 0.7], dtype=dtype)
        target, up, size = (1.0, 0.0, 0.1), (0.0, 1.0, 0.0), (6, 8)
        camera = eg.Camera.look_at(place, target, up, fov_y=40.0, size=size)
        return cls(
            torch.tensor([[1.0, -4.0, 4.0], [1.1, -4.0, -6.0], [0.9, 5.0, 0.1]], dtype=dtype),
            torch.tensor([[-1.0, -5.0, -5.2], [-1.1, -5.4, 6.6], [-0.9, 5.8, 0.6]], dtype=dtype),
            torch.tensor([[0.1, -0.25, -0.2], [0.15, 0.3, -0.2], [-0.05, 0.3, 0.2], [0.05, -0.2, 0.25]], dtype=dtype),
            camera,
            torch.tensor([-0.3, 0.5, 0.2], dtype=dtype),
        )

    def scene(self, receiver: dict[str, Any], reflector: dict[str, Any]) -> eg.Scene:
        one, two = torch.tensor([[0, 1, 2]]), torch.tensor([[0, 1, 2], [0, 2, 3]])
        meshes = [
            eg.Mesh(self.receiver, one, material=eg.Material(**receiver)),
            eg.Mesh(self.reflector, one, material=eg.Material(**reflector)),
            eg.Mesh(self.strip, two, material=eg.Material(torch.zeros(3, dtype=F64))),
        ]
        return eg.Scene(meshes, lights=[eg.lights.PointLight(self.light, 4.0)])

    @property
    def tensors(self) -> dict[str, Tensor]:
        return {
            "receiver": self.receiver, "reflector": self.reflector, "strip": self.strip,
            "pose": self.camera.world_to_camera, "K": self.camera.K,
        }  # fmt: skip


def border(
    moving: Strip,
    receiver: dict[str, Any],
    reflector: dict[str, Any],
    weights: Tensor,
    finer: tuple[int, int] = (1, 1),
    side: int | None = None,
) -> Tensor:
    """Zero, with the derivative of Σ weights · image by the tensors of `moving`, as far as it is that of the border, or of one
    side of it alone. `finer`: how many times as many points of quadrature there are on each axis of a pixel, and along the
    border."""
    still = Strip(
        moving.receiver.detach(), moving.reflector.detach(), moving.strip.detach(), moving.camera.detach(), moving.light
    )
    pixel, x = _pixels(moving.camera.size, 3 * finer[0])
    y, y_still = _seen(moving, x), _seen(still, x)
    # (N, corners, 2): the last two barycentrics of the reflector behind the corners, around which they run.
    shadow = torch.stack([_behind(moving, y, corner) for corner in moving.strip], 1)
    own = weights.reshape(-1, 3)[pixel] / len(x) * len(weights.reshape(-1, 3))
    total, around = weights.new_zeros(()), torch.zeros_like(x[:, 0])
    for k in range(len(moving.strip)):
        a, b = shadow[:, k], shadow[:, (k + 1) % len(moving.strip)]
        along = (b - a).detach()
        around = around + (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).detach()
        if side not in (None, k):
            continue
        for s, weight in zip(*_gauss(12 * finer[1]), strict=True):
            place = (1 - s) * a + s * b
            h = (own * _integrand(still, y_still, place.detach(), receiver, reflector)).sum(1)
            moved = place - place.detach()
            total = total + weight * h @ (along[:, 0] * moved[:, 1] - along[:, 1] * moved[:, 0])
    assert bool((around > 0).all()) or bool((around < 0).all())
    return total * torch.sign(around[0])


def sent_from_line(
    strip: Strip, a: Tensor, b: Tensor, receiver: dict[str, Any], reflector: dict[str, Any], weights: Tensor
) -> Tensor:
    """Σ weights · image for light that the reflector scatters from a line between two places (2,) in its last two barycentrics,
    without
    the strip, per unit of the other barycentrics: ∫ h ds, ds = |b − a| dt."""
    pixel, x = _pixels(strip.camera.size, 3)
    y, total = _seen(strip, x), weights.new_zeros(())
    own = weights.reshape(-1, 3)[pixel] / len(x) * len(weights.reshape(-1, 3))
    for s, weight in zip(*_gauss(24), strict=True):
        place = ((1 - s) * a + s * b).expand(len(x), 2)
        total = total + weight * (b - a).norm() * (own * _integrand(strip, y, place, receiver, reflector)).sum()
    return total


def _gauss(n: int) -> tuple[Tensor, Tensor]:
    """Points in [0, 1], and weights."""
    x, w = np.polynomial.legendre.leggauss(n)
    return torch.from_numpy((x + 1) / 2), torch.from_numpy(w / 2)


def _pixels(size: tuple[int, int], n: int) -> tuple[Tensor, Tensor]:
    """(N,) pixels and (N, 2) places in them, of equal weights."""
    height, width = size
    inside = (torch.arange(n).double() + 0.5) / n
    i, j, dy, dx = torch.meshgrid(
        torch.arange(height).double(), torch.arange(width).double(), inside, inside, indexing="ij"
    )
    return (i * width + j).long().reshape(-1), torch.stack([j + dx, i + dy], -1).reshape(-1, 2)


def _seen(strip: Strip, x: Tensor) -> Tensor:
    """(N, 3) what is seen of the receiver at places x (N, 2)."""
    pose, K = strip.camera.world_to_camera, strip.camera.K
    n = torch.cat([x, torch.ones_like(x[:, :1])], 1) @ torch.linalg.inv(K).T
    back, t = torch.linalg.inv(pose[:3, :3]), pose[:3, 3]
    origin, along = -(back @ t).expand(len(x), 3), n @ back.T
    return origin + _meet(strip.receiver, origin, along)[0] * along


def _meet(face: Tensor, origin: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
    """(N, 1) the distance in lengths of `along`, and (N, 2) the last two barycentrics where rays meet the plane of a face."""
    e1, e2 = face[1] - face[0], face[2] - face[0]
    m = torch.linalg.cross(e1, e2)
    distance = ((face[0] - origin) @ m / (along @ m))[:, None]
    d = origin + distance * along - face[0]
    u = torch.linalg.cross(d, e2.expand_as(d)) @ m / (m @ m)
    v = torch.linalg.cross(e1.expand_as(d), d) @ m / (m @ m)
    return distance, torch.stack([u, v], 1)


def _behind(strip: Strip, y: Tensor, corner: Tensor) -> Tensor:
    return _meet(strip.reflector, y, corner - y)[1]


def _integrand(strip: Strip, y1: Tensor, b: Tensor, receiver: dict[str, Any], reflector: dict[str, Any]) -> Tensor:
    """(N, 3) by barycentrics b (N, 2) of the reflector."""
    e1, e2 = strip.reflector[1] - strip.reflector[0], strip.reflector[2] - strip.reflector[0]
    y2 = strip.reflector[0] + b[:, :1] * e1 + b[:, 1:] * e2
    pose = strip.camera.world_to_camera
    to_viewer = normalize(-(pose[:3, :3].T @ pose[:3, 3]) - y1, dim=1)
    d, e = y2 - y1, strip.light - y2
    l, to_light = normalize(d, dim=1), normalize(e, dim=1)
    n1 = _normal(strip.receiver, to_viewer)
    n2 = _normal(strip.reflector, -l)
    L2 = _scattered(reflector, -l, n2, to_light) * cosine(n2, to_light) * 4.0 / cosine(e, e)
    solid = cosine(n2, -l) / cosine(d, d) * torch.linalg.cross(e1, e2).norm()
    return _scattered(receiver, to_viewer, n1, l) * cosine(n1, l) * solid * L2


def _normal(face: Tensor, towards: Tensor) -> Tensor:
    n = normalize(torch.linalg.cross(face[1] - face[0], face[2] - face[0]), dim=0).expand_as(towards)
    return torch.where(cosine(n, towards) < 0, -n, n)


def _scattered(material: dict[str, Any], v: Tensor, n: Tensor, l: Tensor) -> Tensor:
    base = torch.as_tensor(material["base_color"])[None]
    glossy = "roughness" in material
    parameters = [torch.full((1, 1), material.get(name, 0.0), dtype=F64) for name in ("metallic", "roughness")]
    return Scattering(base, *(parameters if glossy else (None, None))).evaluate(v, n, l).expand(len(v), 3)
