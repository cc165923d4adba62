"""Films with known poses: a draft (drafts.py) is rendered as a camera takes it, and kept in a file.

A frame is made in this order: linear radiance of matte objects in the light of a sun and a sky, with their shadows, mean over the
time that the shutter is open, exposure and white balance, blur of the lens (Gaussian), sRGB, noise, 8 bits, JPEG.

Depth images have the noise of a structured-light sensor by Nguyen et al. (3DIMPVT 2012): a standard deviation of
0.0012 + 0.0019 (z - 0.4)² metres at z metres, which grows at angles of more than 60° to the surface. Neighbouring errors are
independent, which those of a sensor are not. Nothing is measured at steeper angles than 80° and where a pixel sees two surfaces.
"""

from __future__ import annotations

import io
import math
import os
import tempfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

import edgegrad as eg
from benchmarks.poses.cases import direction, photographed, turned

from .motion import Motion, Visit

DEPTH_UNIT = 1e-4  # metres
SAMPLES, INSTANTS, BLURRED_SAMPLES = 16, 4, 4  # of a pixel; with motion blur so many at each of so many times
# Two rays to lights at each point: of a bolt, the median error of sRGB is 0.006, and 0.016 with one, for 0.22 s and 0.16 s.
SAMPLING = eg.Sampling(lights=2)
STEEP, STEEPEST = math.radians(60.0), math.radians(80.0)
COARSE = 4  # The whole silhouette is counted in pixels that are so many times as long.


@dataclass(frozen=True)
class Length:
    """How many frames, and of which size."""

    frames: int = 100
    size: tuple[int, int] = (480, 640)


@dataclass(frozen=True, eq=False)
class Occluder:
    """A mesh that passes before the first object."""

    mesh: eg.Mesh
    rotation: np.ndarray  # (3, 3)
    nearer: float  # than the object's centre, world units
    visit: Visit

    short: float = 0.0  # world units by which it stays behind the object's centre, in the direction that it comes from

    def at(self, centre: np.ndarray, time: float) -> np.ndarray:
        """Return its pose (4, 4) where the object's centre is at a place."""
        M = np.eye(4)
        M[:3, :3] = self.rotation
        M[:3, 3] = centre * (1.0 - self.nearer / centre[2]) + self.visit.offset(time)
        M[:3, 3] += self.short / np.linalg.norm(self.visit.away) * self.visit.away
        return M


@dataclass(frozen=True, eq=False)
class Draft:
    """What is drawn of a film before it is rendered. The camera is at the origin (x right, y down, z forward)."""

    kind: str
    seed: int
    names: tuple[str, ...]  # of objects
    meshes: tuple[eg.Mesh, ...]  # as they are seen
    given: tuple[eg.Mesh, ...]  # as trackers know them
    motions: tuple[Motion, ...]
    camera: eg.Camera
    behind: Tensor  # (H, W, 3) linear
    lights: Sequence[Any]
    balance: np.ndarray  # (3,) factors of radiance
    wear: tuple[float, float, int]  # blur in pixels, noise in sRGB values, quality of JPEG
    start_error: tuple[float, float]  # degrees and share of the size
    occluder: Occluder | None = None
    shutter: float = 0.0  # frames that the shutter is open
    wall: tuple[float, float, float] | None = (
        None  # depth of the background, a plane: at the centre, and slopes; None: no depth
    )

    def poses(self, time: float) -> np.ndarray:
        """Return the poses (n, 4, 4), mesh to world."""
        found = np.stack([motion.at(time) for motion in self.motions])
        for M, mesh in zip(found, self.given, strict=True):
            M[:3, 3] -= M[:3, :3] @ measure(mesh)[0]
        return found


@dataclass(frozen=True, eq=False)
class Film:
    """Frames with their true poses, and what a tracker is given."""

    kind: str
    seed: int
    names: tuple[str, ...]
    meshes: tuple[eg.Mesh, ...]
    camera: eg.Camera
    files: tuple[bytes, ...]  # of pictures, a frame each
    poses: np.ndarray  # (T, n, 4, 4) mesh to world, in the middle of the exposure
    visible: np.ndarray  # (T, n) share of each object's silhouette that is seen
    start: np.ndarray  # (n, 4, 4) poses near those of the first frame
    depths: np.ndarray | None = None  # (T, H, W) uint16, DEPTH_UNIT; 0: unknown

    def __len__(self) -> int:
        return len(self.files)

    def frame(self, k: int) -> np.ndarray:
        """Return a frame (H, W, 3), uint8 sRGB."""
        return np.array(Image.open(io.BytesIO(self.files[k])).convert("RGB"))

    def depth(self, k: int) -> Tensor | None:
        """Return the depth (H, W) of a frame in metres, NaN where unknown."""
        if self.depths is None:
            return None
        metres = torch.from_numpy(self.depths[k].astype(np.float32)) * DEPTH_UNIT
        return torch.where(metres > 0.0, metres, torch.nan)

    @cached_property
    def measures(self) -> list[tuple[np.ndarray, float]]:
        """The centre (3,) and the size of each mesh."""
        return [measure(mesh) for mesh in self.meshes]


def measure(mesh: eg.Mesh) -> tuple[np.ndarray, float]:
    """Return the centre (3,) and the diagonal of a mesh's bounding box."""
    low, high = mesh.verts.double().aminmax(dim=0)
    return ((low + high) / 2).numpy(), float((high - low).norm())


def render(draft: Draft, frames: int) -> Film:
    """Return the film of a draft."""
    lit, files, visible, depths = Studio(draft), [], [], []
    for k in range(frames):
        rng = np.random.default_rng([zlib.crc32(draft.kind.encode()), draft.seed, 1 + k])
        radiance, seen = lit.exposed(k)
        exposure = (1.0 + 0.08 * math.sin(0.2 * k)) * draft.balance
        files.append(photographed(radiance * torch.from_numpy(exposure).float(), *draft.wear, rng))
        visible.append(lit.visible(float(k), seen["mesh_id"]))
        if draft.wall is not None:
            depths.append(_measured(seen, draft.wall, draft.camera, rng))
    poses = np.stack([draft.poses(k) for k in range(frames)])
    return Film(
        draft.kind, draft.seed, draft.names, draft.given, draft.camera, tuple(files), poses, np.array(visible),
        _perturbed(draft), np.stack(depths) if depths else None,
    )  # fmt: skip


def _perturbed(draft: Draft) -> np.ndarray:
    """Return the first poses, somewhat off."""
    rng, found = np.random.default_rng([zlib.crc32(b"start"), draft.seed]), draft.poses(0.0)
    for M, mesh in zip(found, draft.given, strict=True):
        (middle, size), before = measure(mesh), M.copy()
        M[:3, :3] = turned(draft.start_error[0], rng).numpy() @ before[:3, :3]
        centre = before[:3, :3] @ middle + before[:3, 3] + draft.start_error[1] * size * direction(rng).numpy()
        M[:3, 3] = centre - M[:3, :3] @ middle
    return found


class Studio:
    """Renders of a draft at any time."""

    def __init__(self, draft: Draft) -> None:
        self.draft = draft
        self.shown = [mesh.replace(material=eg.Material()) for mesh in draft.meshes]
        self.bare = [eg.Mesh(mesh.verts, mesh.faces) for mesh in draft.meshes]

    def exposed(self, k: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Return radiance (H, W, 3) of a frame, and the channels in the middle of its exposure."""
        shutter, measured = self.draft.shutter, self.draft.wall is not None
        channels = ["mesh_id", *(("depth", "alpha", "shading_normal") if measured else ())]
        if shutter == 0.0:
            seen = self._seen(float(k), SAMPLES, INSTANTS * k, ["image", *channels])
            return seen["image"], seen
        offsets = [(part + 0.5) / INSTANTS - 0.5 for part in range(INSTANTS)]
        parts = [
            self._seen(k + shutter * offset, BLURRED_SAMPLES, INSTANTS * k + part, ["image"])["image"]
            for part, offset in enumerate(offsets)
        ]
        return torch.stack(parts).mean(0), self._seen(float(k), 1, 0, channels)

    def _seen(self, time: float, spp: int, seed: int, channels: list[str]) -> dict[str, Tensor]:
        draft, poses = self.draft, self.draft.poses(time)
        meshes = [_moved(mesh, M) for mesh, M in zip(self.shown, poses, strict=True)]
        if draft.occluder is not None:
            M = draft.occluder.at(draft.motions[0].at(time)[:3, 3], time)
            meshes.append(_moved(draft.occluder.mesh.replace(material=eg.Material()), M))
        scene = eg.Scene(meshes, background=draft.behind, lights=list(draft.lights))
        with torch.no_grad():
            return eg.render_aovs(scene, draft.camera, channels, spp, seed, sampling=SAMPLING)

    def visible(self, time: float, mesh_id: Tensor | None = None) -> list[float]:
        """Return the share of each object's whole silhouette, with what lies outside the picture, that is seen."""
        shares = []
        if mesh_id is None:
            mesh_id = self._seen(time, 1, 0, ["mesh_id"])["mesh_id"]
        for n, (mesh, M) in enumerate(zip(self.bare, self.draft.poses(time), strict=True)):
            count = int((mesh_id == n).sum())
            if count == 0:
                shares.append(0.0)
                continue
            placed = _moved(mesh, M)
            low, high = self.draft.camera.project(placed.verts).aminmax(dim=0)
            (left, top), (width, height) = low.floor().int().tolist(), (high - low).ceil().int().add(2).tolist()
            size = math.ceil(height / COARSE), math.ceil(width / COARSE)
            part = self.draft.camera.crop(top, left, COARSE * size[0], COARSE * size[1]).resized(size)
            alpha = eg.render_aovs(placed, part, ["alpha"], 16, 0)["alpha"]
            shares.append(min(1.0, count / (COARSE**2 * float(alpha.sum()))))
        return shares


def _moved(mesh: eg.Mesh, M: np.ndarray) -> eg.Mesh:
    T = torch.from_numpy(M).float()
    return mesh.transformed(T[:3, :3], T[:3, 3])


def _measured(
    seen: dict[str, Tensor], wall: tuple[float, float, float], camera: eg.Camera, rng: np.random.Generator
) -> np.ndarray:
    """Return what a depth sensor measures (H, W), uint16."""
    K, (H, W) = camera.K.double().numpy(), camera.size
    x = (np.arange(W) + 0.5 - K[0, 2]) / K[0, 0]
    y = (np.arange(H)[:, None] + 0.5 - K[1, 2]) / K[1, 1]
    alpha, depth = (seen[name][..., 0].double().numpy() for name in ("alpha", "depth"))
    behind = wall[0] / (1.0 - wall[1] * x - wall[2] * y)
    z = np.where(alpha > 0.999, depth / np.maximum(alpha, 1e-9), behind)
    rays = np.stack([x + 0.0 * y, y + 0.0 * x, np.ones((H, W))], -1)
    normal = seen["shading_normal"].double().numpy()
    cosine = (
        abs((normal * rays).sum(-1)) / np.linalg.norm(rays, axis=-1) / np.maximum(np.linalg.norm(normal, axis=-1), 1e-9)
    )
    angle = np.where(alpha > 0.999, np.arccos(cosine.clip(0.0, 1.0)), 0.0)
    steep = np.where(angle > STEEP, 1e-4 / np.sqrt(z) * angle**2 / (math.pi / 2 - angle.clip(max=STEEPEST)) ** 2, 0.0)
    z = z + (0.0012 + 0.0019 * (z - 0.4) ** 2 + steep) * rng.normal(size=z.shape)
    known = ((alpha > 0.999) | (alpha < 0.001)) & (angle < STEEPEST) & (z > 0.0)
    return np.where(known, (z / DEPTH_UNIT).round().clip(0, 65535), 0).astype(np.uint16)


def cache_folder() -> Path:
    """Return the folder where films are kept by default."""
    return Path(tempfile.gettempdir()) / "edgegrad-films"


def save(film: Film, path: Path) -> None:
    """Write what was rendered of a film."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, np.ndarray] = {
        "bytes": np.frombuffer(b"".join(film.files), np.uint8), "lengths": np.array([len(file) for file in film.files]),
        "visible": film.visible,
    }  # fmt: skip
    if film.depths is not None:
        arrays["depths"] = film.depths
    temporary = path.with_name(f"{path.stem}-{os.getpid()}.tmp.npz")
    np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]
    temporary.replace(path)  # Another process never reads half of a file.


def load(draft: Draft, path: Path) -> Film:
    """Return the film of a draft from its file."""
    with np.load(path) as kept:
        ends = kept["lengths"].cumsum()
        whole, depths = kept["bytes"].tobytes(), kept.get("depths")
        files = tuple(whole[end - n : end] for end, n in zip(ends.tolist(), kept["lengths"].tolist(), strict=True))
        visible = kept["visible"]
    poses = np.stack([draft.poses(k) for k in range(len(files))])
    return Film(
        draft.kind, draft.seed, draft.names, draft.given, draft.camera, files, poses, visible, _perturbed(draft), depths
    )
