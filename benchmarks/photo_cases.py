"""Pictures as a camera takes them, made here: an object in the light of a sun and a sky before a photograph, with an exposure and
a white balance, blurred, noisy and compressed. A fit knows the mesh and the camera alone."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

import edgegrad as eg
from edgegrad.camera.poses import rotation
from edgegrad.files.image import linear_to_srgb, srgb_to_linear
from edgegrad.fit.region import smoothed

Kind = Literal["easy", "lit", "shadow", "covered", "plain"]
SIZE = 256  # pixels
COVERED = 0.25  # of the object's pixels
SMALLER, APART = 0.75, 0.32  # of several objects: their size, and how far they are from the middle
OVERLAP = 0.55, 0.8  # share of the one that is seen least
ALIKE = 0.02  # of its size: what turns a plain mesh onto itself but for so much looks alike
BLUR, NOISE, QUALITY = 1.0, 0.02, 70  # pixels, sRGB values, of JPEG


@dataclass(frozen=True)
class Placed:
    """A pose, mesh to world."""

    R: Tensor  # (3, 3)
    t: Tensor  # (3,)

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
    depth: Tensor | None = None  # (H, W)
    symmetries: eg.Symmetries | None = None  # up to which poses look alike
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
        return eg.render_aovs(eg.Mesh(placed.verts, placed.faces), camera or self.camera, ["alpha"], 16)["alpha"][
            ..., 0
        ]

    def perturbed(self, pose: Placed, degrees: float, shift: float, rng: np.random.Generator) -> Placed:
        """Return the pose rotated by an angle and shifted by a length, both in random directions."""
        R = turned(degrees, rng) @ pose.R.double()
        center = pose.R.double() @ self.center + pose.t.double() + shift * direction(rng)
        return Placed(R, center - R @ self.center)

    def apart(self, a: Placed, b: Placed) -> tuple[float, float]:
        """Degrees between two poses, and how far apart the object's centres are, in the mesh's units; of those that look alike,
        between the nearest ones."""
        if self.symmetries is not None:
            M = self.symmetries.closest(a.matrix, b.matrix)
            a = Placed(M[:3, :3], M[:3, 3])
        M = a.R.double() @ b.R.double().T
        sine = 0.5 * torch.stack([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]]).norm()
        ways = [pose.R.double() @ self.center + pose.t.double() for pose in (a, b)]
        return math.degrees(math.atan2(float(sine), 0.5 * (float(M.trace()) - 1.0))), float((ways[0] - ways[1]).norm())


def direction(rng: np.random.Generator) -> Tensor:
    """Return a uniformly random unit vector (3,)."""
    return F.normalize(torch.from_numpy(rng.normal(size=3)), dim=0)


def turned(degrees: float, rng: np.random.Generator) -> Tensor:
    """Return a rotation (3, 3) by an angle about a random axis."""
    return rotation(math.radians(degrees) * direction(rng))


def rendered(name: str, mesh: eg.Mesh, photographs: Sequence[Tensor], kind: Kind, seed: int) -> Case:
    """Return a case of a kind.

    easy     one pose, light and photograph of a mesh for all seeds; colours as they are lit, hardly worn (QUALITY 85)
    lit      any pose, sun, sky, exposure ± 1 stop, white balance ± 20 %, worn
    shadow   as lit, and a bar that is out of view casts its shadow across the object
    covered  as lit, and a straight border covers a quarter of the object
    plain    as lit, but the fit has no colours
    """
    easy = kind == "easy"
    rng = np.random.default_rng(0 if easy else seed)
    mesh = _centred(mesh)
    camera = eg.Camera.look_at((0, 0.4, -3.4), (0, 0, 0), (0, 1, 0), fov_y=40.0, size=(SIZE, SIZE))
    truth = Placed(turned(30.0 if easy else rng.uniform(0.0, 180.0), rng), 0.05 * torch.from_numpy(rng.normal(size=3)))
    behind = _view(photographs[0 if easy else seed % len(photographs)], rng)
    image = _lit([mesh.transformed(truth.R, truth.t)], camera, behind, kind == "shadow", rng)
    if not easy:
        image = image * torch.from_numpy(2.0 ** rng.uniform(-1.0, 1.0) * rng.uniform(0.8, 1.2, 3)).float()
    if kind == "covered":
        alpha = eg.render_aovs(mesh.transformed(truth.R, truth.t), camera, ["alpha"], 16)["alpha"]
        image = _covered(image, alpha, _view(photographs[(seed + 1) % len(photographs)], rng), rng)
    picture = _worn(image, 0.7, 0.0, 85, rng) if easy else _worn(image, BLUR, NOISE, QUALITY, rng)
    seen = eg.Mesh(mesh.verts, mesh.faces) if kind == "plain" else mesh
    alike = eg.Symmetries.find(seen, ALIKE) if kind == "plain" else None
    return Case(name, seen, picture, camera, truth, symmetries=alike)


def several(meshes: Sequence[eg.Mesh], photographs: Sequence[Tensor], seed: int) -> list[Case]:
    """Return a case for each of several meshes in one `lit` picture, where one leaves OVERLAP of another visible."""
    rng = np.random.default_rng(seed)
    camera = eg.Camera.look_at((0, 0.4, -3.4), (0, 0, 0), (0, 1, 0), fov_y=40.0, size=(SIZE, SIZE))
    small = [mesh.replace(verts=mesh.verts * SMALLER) for mesh in map(_centred, meshes)]
    placed: list[Placed] = []
    shares = [0.0]
    while not (OVERLAP[0] <= min(shares) <= OVERLAP[1]):
        ways = rng.uniform(0.0, 2.0 * math.pi) + 2.0 * math.pi * np.arange(len(small)) / len(small)
        placed = [
            Placed(
                turned(rng.uniform(0.0, 180.0), rng),
                torch.tensor([APART * math.cos(way), APART * math.sin(way), rng.uniform(-0.5, 0.5)]).double(),
            )
            for way in ways
        ]
        shares = _shares([mesh.transformed(pose.R, pose.t) for mesh, pose in zip(small, placed, strict=True)], camera)
    moved = [mesh.transformed(pose.R, pose.t) for mesh, pose in zip(small, placed, strict=True)]
    image = _lit(moved, camera, _view(photographs[seed % len(photographs)], rng), False, rng)
    image = image * torch.from_numpy(2.0 ** rng.uniform(-1.0, 1.0) * rng.uniform(0.8, 1.2, 3)).float()
    picture = _worn(image, BLUR, NOISE, QUALITY, rng)
    found = zip(small, placed, strict=True)
    return [Case(f"{k + 1} of {len(small)}", mesh, picture, camera, pose) for k, (mesh, pose) in enumerate(found)]


def _shares(meshes: Sequence[eg.Mesh], camera: eg.Camera) -> list[float]:
    """Return the visible share of each mesh among the others."""
    labels = torch.eye(len(meshes))
    bare = [eg.Mesh(mesh.verts, mesh.faces) for mesh in meshes]
    painted = [mesh.replace(colors=label.expand(len(mesh.verts), -1)) for mesh, label in zip(bare, labels, strict=True)]
    seen = eg.render(eg.Scene(painted), camera, 4).sum((0, 1))
    alone = [float(eg.render_aovs(mesh, camera, ["alpha"], 4)["alpha"].sum()) for mesh in bare]
    return [float(one) / whole for one, whole in zip(seen, alone, strict=True)]


def clutter(seed: int, size: int = SIZE) -> Tensor:
    """(size, size, 3) linear: boards of many sizes and colours that lie on one another, each with a pattern of its own. For
    where no photograph is at hand."""
    rng = np.random.default_rng(seed)
    x = (np.arange(size) + 0.5) / size
    image = np.ones((size, size, 3)) * rng.uniform(0.2, 0.7, 3)
    for k in range(60):
        middle, angle = rng.uniform(0.0, 1.0, 2), rng.uniform(0.0, math.pi)
        half = rng.uniform(0.03, 0.45, 2) * (1.0 - k / 90)
        u = (x[None] - middle[0]) * math.cos(angle) + (x[:, None] - middle[1]) * math.sin(angle)
        v = -(x[None] - middle[0]) * math.sin(angle) + (x[:, None] - middle[1]) * math.cos(angle)
        waves = np.sin(2.0 * math.pi * rng.uniform(2.0, 25.0) * u + 3.0 * np.sin(rng.uniform(0.0, 15.0) * v))
        color = rng.uniform(0.05, 0.9, 3) * (1.0 + rng.uniform(0.0, 0.35) * waves[..., None])
        inside = (abs(u) < half[0]) & (abs(v) < half[1])
        image = np.where(inside[..., None], color * (1.0 + 0.5 * rng.uniform(-1.0, 1.0) * u[..., None]), image)
    return srgb_to_linear(torch.from_numpy(image).float().clamp(0.0, 1.0))


def _centred(mesh: eg.Mesh) -> eg.Mesh:
    """Return the mesh centred at the origin and scaled to the camera's view."""
    low, high = mesh.verts.aminmax(dim=0)
    return mesh.replace(verts=(mesh.verts - (low + high) / 2) / (high - low).norm() * 1.8, material=None)


def _view(photograph: Tensor, rng: np.random.Generator) -> Tensor:
    """Return the largest square of a photograph at a random place, as (SIZE, SIZE, 3)."""
    H, W = photograph.shape[:2]
    side = min(H, W)
    top, left = rng.integers(0, H - side + 1), rng.integers(0, W - side + 1)
    square = photograph[top : top + side, left : left + side].movedim(-1, 0)[None]
    return F.interpolate(square, size=(SIZE, SIZE), mode="area")[0].movedim(0, -1).contiguous()


def _lit(
    given: Sequence[eg.Mesh], camera: eg.Camera, behind: Tensor, shadow: bool, rng: np.random.Generator
) -> Tensor:  # fmt: skip
    """Return an image (SIZE, SIZE, 3) of matte meshes with the shadows they cast on themselves and on one another."""
    way = torch.from_numpy(rng.normal(size=3)).float()
    way[1], way[2] = -way[1].abs() - 0.3, 0.7 * way[2].abs()  # from above, and from the camera's side
    way = F.normalize(way, dim=0)
    lights = [
        eg.lights.DirectionalLight(way, float(rng.uniform(1.5, 3.5))),
        eg.lights.Environment(torch.from_numpy(rng.uniform(0.3, 0.6, 3)).float(), visible=False),
    ]
    meshes = [mesh.replace(material=eg.Material(), normals=mesh.vertex_normals()) for mesh in given]
    if shadow:
        across = F.normalize(torch.linalg.cross(way, torch.from_numpy(rng.normal(size=3)).float()), dim=0)
        along = torch.linalg.cross(way, across)
        place = -12.0 * way + float(rng.uniform(-0.3, 0.3)) * across
        ends = [place + a * across + b * along for a, b in ((-0.15, -3.0), (0.15, -3.0), (0.15, 3.0), (-0.15, 3.0))]
        bar = eg.Mesh(torch.stack(ends), torch.tensor([[0, 1, 2], [0, 2, 3]]))
        channels = meshes[0].channels or 3
        meshes.append(bar.replace(face_colors=torch.zeros(2, channels), material=eg.Material()))
    with torch.no_grad():
        return eg.render(
            eg.Scene(meshes, background=behind, lights=lights), camera, spp=64, sampling=eg.Sampling(lights=2)
        )


def _covered(image: Tensor, alpha: Tensor, cover: Tensor, rng: np.random.Generator) -> Tensor:
    rows, columns = torch.nonzero(alpha[..., 0] > 0.5, as_tuple=True)
    angle = rng.uniform(0.0, 2.0 * math.pi)
    place = torch.arange(SIZE) * math.cos(angle) + torch.arange(SIZE)[:, None] * math.sin(angle)
    border = place[rows, columns].quantile(COVERED)
    return torch.where((place < border)[..., None], cover.flip(1), image)


def _worn(image: Tensor, blur: float, noise: float, quality: int, rng: np.random.Generator) -> Tensor:
    """Through a lens, which blurs radiance, a sensor and a file."""
    seen = linear_to_srgb(smoothed(image.clamp(0.0, 1.0).movedim(-1, 0), blur).movedim(0, -1)).numpy()
    seen = seen + noise * rng.normal(size=seen.shape)
    file = io.BytesIO()
    Image.fromarray((255.0 * seen.clip(0.0, 1.0)).round().astype(np.uint8)).save(file, "JPEG", quality=quality)
    return srgb_to_linear(torch.from_numpy(np.asarray(Image.open(file), np.float32) / 255.0))
