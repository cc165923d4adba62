"""A painted stone that rotates before clutter, in light that its mesh does not have, while a hand passes over it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from scenes import icosphere
from torch import Tensor

import edgegrad as eg
from edgegrad.camera.poses import rotation
from edgegrad.files.image import linear_to_srgb, srgb_to_linear
from edgegrad.fit.placement import angle

SKIN = 0.82, 0.58, 0.46  # sRGB
NOISE = 0.01  # of a picture, sRGB values
DISTANCE = 3.4


def stone(subdivisions: int = 3) -> eg.Mesh:
    """Return a body without symmetry, 1.8 units across, with smooth patches of colours."""
    ball = icosphere(subdivisions)
    x, y, z = ball.verts.double().unbind(-1)
    radius = 1.0 + 0.25 * x * y + 0.2 * torch.sin(3.0 * z + x) + 0.15 * torch.cos(4.0 * y - z)
    verts = radius[:, None] * torch.stack([x, 0.75 * y, 1.15 * z], -1)
    low, high = verts.aminmax(dim=0)
    verts = (verts - 0.5 * (low + high)) * (1.8 / (high - low).norm())
    waves = torch.tensor([[5.0, 2.0, -3.0], [-2.0, 6.0, 3.0], [4.0, -3.0, 5.0]]).double()
    colors = 0.4 + 0.35 * torch.sin(torch.stack([x, y, z], -1) @ waves.T + torch.tensor([0.0, 1.0, 2.5]))
    return eg.Mesh(verts.float(), ball.faces, colors=colors.float())


def camera_of(size: int) -> eg.Camera:
    return eg.Camera.look_at((0, 0.4, -DISTANCE), (0, 0, 0), (0, 1, 0), fov_y=40.0, size=(size, size))


def clutter(size: int, seed: int = 0) -> Tensor:
    """Return sRGB values (size, size, 3) of blots of many sizes, and rectangles."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.full((1, 3, size, size), 0.45)
    for cells, contrast in ((4, 0.3), (9, 0.25), (24, 0.15), (60, 0.1)):
        blots = torch.rand(1, 3, cells, cells, generator=generator) - 0.5
        image = image + contrast * 2.0 * F.interpolate(blots, (size, size), mode="bicubic")
    for _ in range(14):
        top, left, h, w = (
            (torch.rand(4, generator=generator) * torch.tensor([0.9, 0.9, 0.3, 0.3]) * size).long().tolist()
        )
        image[..., top : top + h + 2, left : left + w + 2] = torch.rand(1, 3, 1, 1, generator=generator)
    return image[0].movedim(0, -1).clamp(0.02, 0.98)


@dataclass(frozen=True)
class Film:
    """Poses of the mesh, and their pictures."""

    mesh: eg.Mesh
    camera: eg.Camera
    poses: list[Tensor]  # (4, 4)
    background: Tensor  # (H, W, 3), sRGB values
    hand: tuple[int, int] | None = None  # from which frame to which it passes
    gone: tuple[int, int] | None = None  # frames without the object
    spp: int = 16

    @staticmethod
    def turning(size: int, count: int, degrees: float = 3.0, mesh: eg.Mesh | None = None, **others: object) -> Film:
        """Return a film whose mesh rotates by so many degrees a frame about an axis that wanders, along a curve."""
        poses, R = [], rotation(torch.tensor([0.3, -0.5, 0.2]).double())
        for k in range(count):
            axis = torch.tensor([math.cos(0.05 * k), 1.0, math.sin(0.03 * k)]).double()
            R = rotation(math.radians(degrees) * axis / axis.norm()) @ R
            M = torch.eye(4, dtype=torch.float64)
            M[:3, :3] = R
            way = 0.25 * math.sin(0.06 * k), 0.15 * math.sin(0.045 * k), 0.3 * math.sin(0.035 * k)
            M[:3, 3] = torch.tensor(way).double()
            poses.append(M)
        return Film(mesh or stone(), camera_of(size), poses, clutter(size), **others)  # type: ignore[arg-type]

    def __len__(self) -> int:
        return len(self.poses)

    def __iter__(self) -> Iterator[Tensor]:
        return (self.frame(k) for k in range(len(self)))

    def frame(self, k: int) -> Tensor:
        """Return linear radiance (H, W, 3) of 8 bits."""
        size = self.camera.size[0]
        if self.gone is not None and self.gone[0] <= k < self.gone[1]:
            picture = self.background
        else:
            M = self.poses[k].float()
            mesh = self.mesh.transformed(M[:3, :3], M[:3, 3])
            mesh = mesh.replace(material=eg.Material(), normals=mesh.vertex_normals())
            lights = [
                eg.lights.DirectionalLight(torch.tensor([0.6, -0.8, 0.7]), 2.4),
                eg.lights.Environment(torch.tensor([0.5, 0.45, 0.4]), visible=False),
            ]
            scene = eg.Scene([mesh], background=srgb_to_linear(self.background), lights=lights)
            with torch.no_grad():
                picture = linear_to_srgb(
                    eg.render(scene, self.camera, spp=self.spp, sampling=eg.Sampling(lights=1), seed=k).clamp(0.0, 1.0)
                )
        if self.hand is not None and self.hand[0] <= k < self.hand[1]:
            picture = _before(picture, (k - self.hand[0]) / (self.hand[1] - self.hand[0]))
        generator = torch.Generator().manual_seed(k)
        noisy = picture + NOISE * torch.randn(size, size, 3, generator=generator)
        return srgb_to_linear((noisy.clamp(0.0, 1.0) * 255.0).round() / 255.0)


def _before(picture: Tensor, way: float) -> Tensor:
    """Return the picture behind an arm, a sixth of its width wide, that moves from left to right as `way` grows to
    1."""
    size = picture.shape[0]
    v, u = torch.meshgrid((torch.arange(size) + 0.5) / size, (torch.arange(size) + 0.5) / size, indexing="ij")
    x, y = u - (1.5 * way - 0.25), v - 0.75
    a, b = 0.9 * x + 0.3 * y, 0.95 * y - 0.3 * x
    edge = (0.085 - (a.square() + (0.085 / 0.45 * b).square()).sqrt()) * size
    cover = (edge + 0.5).clamp(0.0, 1.0)[..., None]
    shade = 1.0 - 3.5 * a.abs() + 0.06 * torch.sin(60.0 * a) * torch.sin(45.0 * b)
    return (1.0 - cover) * picture + cover * (torch.tensor(SKIN) * shade[..., None]).clamp(0.0, 1.0)


def errors(film: Film, index: int, R: Tensor, t: Tensor) -> tuple[float, float]:
    """Return by how many degrees, and percent of the object's size, a pose is off."""
    M, verts = film.poses[index], film.mesh.verts.double()
    low, high = verts.aminmax(dim=0)
    c = 0.5 * (low + high)
    off = (R @ c + t - M[:3, :3] @ c - M[:3, 3]).norm() / (high - low).norm()
    return math.degrees(angle(M[:3, :3], R)), 100.0 * float(off)


def worst(found: Sequence[tuple[float, float]]) -> tuple[float, float]:
    return max(a for a, _ in found), max(b for _, b in found)
