"""Cases of pose fits: a picture as a camera takes it, the true pose, and a start, all drawn from a kind and a seed.

Objects stand in the light of a sun and a sky before a photograph, with an exposure and a white balance; the picture is blurred,
noisy and compressed. A fit knows the mesh, the picture and the camera, and in some kinds a mask or no start.
"""

from __future__ import annotations

import io
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from scipy.ndimage import gaussian_filter
from torch import Tensor

import edgegrad as eg
from edgegrad.camera.poses import rotation
from edgegrad.files.image import linear_to_srgb, srgb_to_linear

from .objects import REPORTED, Sources, clutter, crop

SIDES = 192, 321  # pixels of the picture's height and of its width
FIELD = 30.0, 55.0  # degrees of the shorter side
ACROSS = 0.65, 0.9  # the object's size as a share of the shorter side
BLUR, NOISE, QUALITY = (0.5, 1.5), (0.005, 0.03), (60, 95)  # pixels, sRGB values, of JPEG
COVERED = 0.25  # share of the object's pixels
SMALLER, APART = 0.75, 0.32  # of several objects: their size, and how far they are from the middle
OVERLAP = 0.55, 0.8  # visible share of the object that is seen least
BESIDE = 0.9  # visible share of the plain object beside others
EQUAL = 0.02  # of its size: a rotation that moves a plain mesh by less changes nothing that is seen
FOCAL = 1.06  # The focal length is off by this factor or its inverse.


@dataclass(frozen=True)
class Placed:
    """A pose, mesh to world."""

    R: Tensor  # (3, 3)
    t: Tensor  # (3,)

    @staticmethod
    def from_matrix(matrix: Any) -> Placed:
        M = torch.as_tensor(matrix, dtype=torch.float64)
        return Placed(M[:3, :3], M[:3, 3])

    @property
    def matrix(self) -> Tensor:
        """The pose as a matrix (4, 4)."""
        M = torch.eye(4, dtype=torch.float64)
        M[:3, :3], M[:3, 3] = self.R, self.t
        return M


@dataclass(frozen=True)
class Case:
    """The input of a fit, and the true pose."""

    name: str
    mesh: eg.Mesh
    picture: Tensor  # (H, W, 3) linear
    camera: eg.Camera
    truth: Placed
    start: Placed | None = None
    mask: Tensor | None = None  # (H, W, 1)
    depth: Tensor | None = None  # (H, W)
    symmetries: eg.Symmetries | None = None  # Poses that they make equal count as one.
    real: bool = False  # a photograph, of which `truth` may be off

    @property
    def center(self) -> Tensor:
        """Centre (3,) of the bounding box, in the mesh's units."""
        low, high = self.mesh.verts.double().aminmax(dim=0)
        return (low + high) / 2

    @property
    def size(self) -> float:
        """Diagonal of the bounding box."""
        low, high = self.mesh.verts.double().aminmax(dim=0)
        return float((high - low).norm())

    def alpha(self, pose: Placed, camera: eg.Camera | None = None) -> Tensor:
        """Return the silhouette (H, W) at a pose, seen by the case's camera or another one."""
        placed = self.mesh.transformed(pose.R.float(), pose.t.float())
        bare = eg.Mesh(placed.verts, placed.faces)
        return eg.render_aovs(bare, camera or self.camera, ["alpha"], 16, seed=0)["alpha"][..., 0]

    def perturbed(self, pose: Placed, degrees: float, shift: float, rng: np.random.Generator) -> Placed:
        """Return the pose rotated by an angle and shifted by a length, both in random directions."""
        R = turned(degrees, rng) @ pose.R.double()
        center = pose.R.double() @ self.center + pose.t.double() + shift * direction(rng)
        return Placed(R, center - R @ self.center)

    def started(self, degrees: float, share: float, rng: np.random.Generator) -> Case:
        """Return the case with a start that is so far off, the shift as a share of the object's size."""
        return replace(self, start=self.perturbed(self.truth, degrees, share * self.size, rng))

    def apart(self, a: Placed, b: Placed) -> tuple[float, float]:
        """Return the degrees between two poses, and how far the object's centres are apart as a share of its size; symmetric
        poses are compared with the nearest one."""
        if self.symmetries is not None:
            a = Placed.from_matrix(self.symmetries.closest(a.matrix, b.matrix))
        M = a.R.double() @ b.R.double().T
        sine = 0.5 * torch.stack([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]]).norm()
        centers = [pose.R.double() @ self.center + pose.t.double() for pose in (a, b)]
        degrees = math.degrees(math.atan2(float(sine), 0.5 * (float(M.trace()) - 1.0)))
        return degrees, float((centers[0] - centers[1]).norm()) / self.size


@dataclass(frozen=True)
class Recipe:
    """What distinguishes the pictures of a kind from a textured mesh alone, seen as a whole, with a start 15° and 5 % off.

    Attributes
    ----------
    only : name of the one object; None: any
    count : number of objects, of each of which the pose is sought
    fixed : one object, pose, light, photograph and camera for all seeds, slightly blurred and compressed
    shadow, covered, boards : whether a bar casts its shadow on the object, another photograph covers a quarter of it, and
        boards take the place of photographs
    plain : whether the fit has no colours
    others : number of objects that stand beside it, of which the fit has no meshes
    mask : whether the fit has a mask
    start : least and largest angle in degrees, and largest shift as a share of the size; None: there is no start
    """

    only: str | None = None
    count: int = 1
    fixed: bool = False
    shadow: bool = False
    covered: bool = False
    boards: bool = False
    plain: bool = False
    others: int = 0
    mask: bool = False
    start: tuple[float, float, float] | None = (15.0, 15.0, 0.05)


def drawn(kind: str, recipe: Recipe, seed: int, sources: Sources) -> list[Case]:
    """Return the cases of one picture, one for each object that is sought."""
    rng = np.random.default_rng(0 if recipe.fixed else [zlib.crc32(kind.encode()), seed])
    names = [recipe.only or str(name) for name in rng.permutation(sources.names(seed))]
    number = recipe.count + recipe.others
    names = (sources.names(0) if recipe.fixed else [names[k % len(names)] for k in range(number)])[:number]
    meshes = [sources.mesh(name, seed, rng) for name in names]
    photographs = sources.photographs(REPORTED if recipe.fixed else seed)
    if recipe.boards:
        photographs = [clutter(k) for k in rng.integers(1 << 30, size=2).tolist()]
    camera = _camera(recipe, rng)
    behind, cover = (crop(photographs[k], camera.size, rng) for k in _two(len(photographs), recipe, rng))
    poses = _poses(recipe, meshes, camera, rng)
    placed = [mesh.transformed(pose.R, pose.t) for mesh, pose in zip(meshes, poses, strict=True)]
    lights = sun_and_sky(recipe.fixed, rng)
    shade = [_bar(lights[0].direction, rng, placed[0].channels or 3)] if recipe.shadow else []
    image = _lit([*placed, *shade], camera, behind, lights)
    if not recipe.fixed:
        image = image * torch.from_numpy(2.0 ** rng.uniform(-1.0, 1.0) * rng.uniform(0.8, 1.2, 3)).float()
    alpha = eg.render_aovs(eg.Mesh(placed[0].verts, placed[0].faces), camera, ["alpha"], 16, seed=0)["alpha"]
    if recipe.covered:
        image = _covered(image, alpha, cover, rng)
    wear = (0.7, 0.0, 85) if recipe.fixed else (rng.uniform(*BLUR), rng.uniform(*NOISE), int(rng.integers(*QUALITY)))
    picture = _worn(image, *wear, rng)
    cases = []
    for name, mesh, pose in list(zip(names, meshes, poses, strict=True))[: recipe.count]:
        given = eg.Mesh(mesh.verts, mesh.faces) if recipe.plain else mesh
        equal = eg.Symmetries.find(given, EQUAL) if recipe.plain else None
        mask = (alpha >= 0.5).float() if recipe.mask else None
        cases.append(Case(Path(name.split(",")[0]).stem, given, picture, camera, pose, mask=mask, symmetries=equal))
    if recipe.start is None:
        return cases
    low, high, shift = recipe.start
    rng = np.random.default_rng([zlib.crc32(b"start"), round(high), seed])
    return [case.started(rng.uniform(low, high), shift * (rng.uniform() if low < high else 1.0), rng) for case in cases]


def beside(kind: str, case: Case, seed: int) -> eg.Camera:
    """Return the camera to start from where the object stays: it sees it as the case's camera does at the case's start. In the
    kind `focal` its focal length is off."""
    assert case.start is not None
    moved = case.start.matrix @ torch.linalg.inv(case.truth.matrix)
    K = case.camera.K.clone()
    if kind == "focal":
        K[[0, 1], [0, 1]] *= FOCAL if seed % 2 else 1.0 / FOCAL
    return case.camera.replace(world_to_camera=(case.camera.world_to_camera.double() @ moved).float(), K=K)


def direction(rng: np.random.Generator) -> Tensor:
    """Return a uniformly random unit vector (3,)."""
    return F.normalize(torch.from_numpy(rng.normal(size=3)), dim=0)


def turned(degrees: float, rng: np.random.Generator) -> Tensor:
    """Return a rotation (3, 3) by an angle about a random axis."""
    return rotation(math.radians(degrees) * direction(rng))


def _two(count: int, recipe: Recipe, rng: np.random.Generator) -> list[int]:
    """Return numbers of two photographs, distinct where there are two."""
    first, second = (0, 0) if recipe.fixed else rng.integers(count, size=2).tolist()
    return [first, second if second != first else (first + 1) % count]


def _camera(recipe: Recipe, rng: np.random.Generator) -> eg.Camera:
    """Return a camera before which an object of size 1.8 fills a share of the picture."""
    if recipe.fixed:
        return eg.Camera.look_at((0, 0.4, -3.4), (0, 0, 0), (0, 1, 0), fov_y=40.0, size=(256, 256))
    H, W = rng.integers(*SIDES, size=2).tolist()
    slope, share = math.tan(math.radians(rng.uniform(*FIELD) / 2)), rng.uniform(*ACROSS)
    fov = math.degrees(2.0 * math.atan(slope * H / min(H, W)))
    place = F.normalize(torch.tensor([0.0, 0.1, -1.0]), dim=0) * 1.8 / (2.0 * slope * share)
    return eg.Camera.look_at(place, (0, 0, 0), (0, 1, 0), fov_y=fov, size=(H, W))


def _poses(recipe: Recipe, meshes: list[eg.Mesh], camera: eg.Camera, rng: np.random.Generator) -> list[Placed]:
    """Return true poses. Of several objects, whose meshes become smaller here, they cover one another in part."""
    if len(meshes) == 1:
        degrees = 30.0 if recipe.fixed else rng.uniform(0.0, 180.0)
        return [Placed(turned(degrees, rng), 0.05 * torch.from_numpy(rng.normal(size=3)))]
    meshes[:] = [mesh.replace(verts=mesh.verts * SMALLER) for mesh in meshes]
    while True:
        ways = rng.uniform(0.0, 2.0 * math.pi) + 2.0 * math.pi * np.arange(len(meshes)) / len(meshes)
        poses = [
            Placed(
                turned(rng.uniform(0.0, 180.0), rng),
                torch.tensor([APART * math.cos(way), APART * math.sin(way), rng.uniform(-0.5, 0.5)]).double(),
            )
            for way in ways
        ]
        shares = _shares([mesh.transformed(pose.R, pose.t) for mesh, pose in zip(meshes, poses, strict=True)], camera)
        if shares[0] >= BESIDE if recipe.others else OVERLAP[0] <= min(shares) <= OVERLAP[1]:
            return poses


def _shares(meshes: Sequence[eg.Mesh], camera: eg.Camera) -> list[float]:
    """Return the visible share of each mesh among the others."""
    labels = torch.eye(len(meshes))
    bare = [eg.Mesh(mesh.verts, mesh.faces) for mesh in meshes]
    painted = [mesh.replace(colors=label.expand(len(mesh.verts), -1)) for mesh, label in zip(bare, labels, strict=True)]
    seen = eg.render(eg.Scene(painted), camera, 4, seed=0).sum((0, 1))
    alone = [float(eg.render_aovs(mesh, camera, ["alpha"], 4, seed=0)["alpha"].sum()) for mesh in bare]
    return [float(one) / whole for one, whole in zip(seen, alone, strict=True)]


def sun_and_sky(fixed: bool, rng: np.random.Generator) -> tuple[eg.lights.DirectionalLight, eg.lights.Environment]:
    """Return a sun from above, from the camera's side, and a sky."""
    if fixed:
        way, power, sky = torch.tensor([0.6, -0.7, 0.8]), 3.0, torch.tensor([0.35, 0.4, 0.5])
    else:
        way = torch.from_numpy(rng.normal(size=3)).float()
        way[1], way[2] = -way[1].abs() - 0.3, 0.7 * way[2].abs()
        power, sky = float(rng.uniform(1.5, 3.5)), torch.from_numpy(rng.uniform(0.3, 0.6, 3)).float()
    sun = eg.lights.DirectionalLight(F.normalize(way, dim=0), power)
    return sun, eg.lights.Environment(sky, visible=False)


def _bar(way: Tensor, rng: np.random.Generator, channels: int) -> eg.Mesh:
    """Return a bar out of view whose shadow falls across the object."""
    across = F.normalize(torch.linalg.cross(way, torch.from_numpy(rng.normal(size=3)).float()), dim=0)
    along = torch.linalg.cross(way, across)
    place = -12.0 * way + float(rng.uniform(-0.3, 0.3)) * across
    ends = [place + a * across + b * along for a, b in ((-0.15, -3.0), (0.15, -3.0), (0.15, 3.0), (-0.15, 3.0))]
    return eg.Mesh(torch.stack(ends), torch.tensor([[0, 1, 2], [0, 2, 3]]), face_colors=torch.zeros(2, channels))


def _lit(meshes: Sequence[eg.Mesh], camera: eg.Camera, behind: Tensor, lights: Sequence[Any]) -> Tensor:
    """Return an image (H, W, 3) of matte meshes with the shadows they cast on themselves and on one another."""
    scene = eg.Scene([mesh.replace(material=eg.Material()) for mesh in meshes], background=behind, lights=list(lights))
    with torch.no_grad():
        return eg.render(scene, camera, spp=64, seed=0, sampling=eg.Sampling(lights=2))


def _covered(image: Tensor, alpha: Tensor, cover: Tensor, rng: np.random.Generator) -> Tensor:
    """Return the image with another one over it, up to a straight border that leaves three quarters of the object."""
    rows, columns = torch.nonzero(alpha[..., 0] > 0.5, as_tuple=True)
    angle, (H, W) = rng.uniform(0.0, 2.0 * math.pi), image.shape[:2]
    place = torch.arange(W) * math.cos(angle) + torch.arange(H)[:, None] * math.sin(angle)
    border = place[rows, columns].quantile(COVERED)
    return torch.where((place < border)[..., None], cover.flip(1), image)


def _worn(image: Tensor, blur: float, noise: float, quality: int, rng: np.random.Generator) -> Tensor:
    """Return the image after a lens, a sensor and a file."""
    file = io.BytesIO(photographed(image, blur, noise, quality, rng))
    return srgb_to_linear(torch.from_numpy(np.asarray(Image.open(file), np.float32) / 255.0))


def photographed(image: Tensor, blur: float, noise: float, quality: int, rng: np.random.Generator) -> bytes:
    """Return the JPEG file of a linear image after a lens, which blurs radiance, and a sensor."""
    blurred = gaussian_filter(image.clamp(0.0, 1.0).numpy(), (blur, blur, 0.0), mode="nearest")
    seen = linear_to_srgb(torch.from_numpy(blurred)).numpy()
    seen = seen + noise * rng.normal(size=seen.shape)
    file = io.BytesIO()
    Image.fromarray((255.0 * seen.clip(0.0, 1.0)).round().astype(np.uint8)).save(file, "JPEG", quality=quality)
    return file.getvalue()
