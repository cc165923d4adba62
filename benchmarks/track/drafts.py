"""Kinds of films, and what is drawn of each from a seed: objects, motion, light, background, occluder, exposure, noise.

Objects are 0.2 m large. Seeds below 1,000 are for tuning and training; results are reported on those from 1,000, which have
other objects and photographs.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial.transform import Rotation
from torch import Tensor

import edgegrad as eg
from benchmarks.poses.cases import sun_and_sky
from benchmarks.poses.objects import Sources

from . import photographs, shapes
from .films import Draft, Film, Length, Occluder, Studio, load, render, save
from .motion import NEAR, Absence, Motion, Visit

SIZE = 0.2  # metres, of objects
FOCAL = 600.0 / 640.0  # of the picture's width
TEXTURED = "stone", "carton", "cushion", "vase", "knot", "mug"
DENSE = 150_000  # least number of faces
BLUR, NOISE, QUALITY = (0.5, 1.2), (0.005, 0.02), (75, 95)  # pixels, sRGB values, of JPEG
COVERED = 0.35, 0.5  # by a hand, in the middle of its visit
REACH_STEPS = 5  # of bisections: within some 5 %
START = 2.0, 0.01  # largest error of the start: degrees and share of the size
LAYER = 1.1  # sizes from one of several objects to the next in depth: they never meet
ASIDE = (
    0.62,
    0.4,
)  # sizes that each of several objects is aside, at the first one's distance: they cover one another in part
GAP = 0.6  # sizes from an object's centre to what passes before it: half a size, and how thick that is


@dataclass(frozen=True)
class Recipe:
    """What distinguishes films of a kind.

    Attributes
    ----------
    shapes : of which the object's is drawn: "textured", "dense" (that in some 200,000 faces), "block", "bolt"
    count : number of objects; all are followed
    speed : least and most; at 1 an object turns by some 2.5° and moves by some 6 pixels a frame
    shutter : share of a frame that the shutter is open
    distance : least and most, in sizes of the object
    occluder : "hand", which covers about half, or "board", which covers all; ""
    away : whether the object leaves the picture and comes back elsewhere
    white : whether object and background are nearly white
    depth : whether there are depth images
    """

    shapes: tuple[str, ...] = ("textured", "block", "bolt")
    count: int = 1
    speed: tuple[float, float] = (0.4, 1.2)
    shutter: float = 0.0
    distance: tuple[float, float] = (2.4, 2.9)
    occluder: str = ""
    away: bool = False
    white: bool = False
    depth: bool = False


KINDS = {
    "textured": Recipe(("textured",)),
    "hand": Recipe(("textured",), occluder="hand"),
    "block": Recipe(("block",)),
    "bolt": Recipe(("bolt",)),
    "block_hand": Recipe(("block",), occluder="hand"),
    "fast": Recipe(("textured", "block"), speed=(1.8, 2.2), shutter=0.5),
    "far": Recipe(("textured",), distance=(5.5, 6.5), white=True),
    "away": Recipe(away=True),
    "covered": Recipe(occluder="board"),
    "depth": Recipe(depth=True),
    "dense": Recipe(("dense",)),
    "three": Recipe(("textured",), count=3, speed=(0.3, 0.8), distance=(2.6, 2.8)),
}
# Films before photographs of a folder, and the two frames of a real one (photographs.py).
REAL = ("squirrel", "cracker", "gelatin", "bottle", "bottle_frames", "bottle_frames_depth")
SOURCES = (
    "drafts.py",
    "films.py",
    "motion.py",
    "photographs.py",
    "shapes.py",
    "../poses/cases.py",
    "../poses/objects.py",
)


def drawn(kind: str, seed: int, sources: Sources, length: Length) -> Draft:
    """Return the draft of a film."""
    recipe, rng = KINDS[kind], np.random.default_rng([zlib.crc32(kind.encode()), seed])
    shape = recipe.shapes[int(rng.integers(len(recipe.shapes)))]
    photos = sources.photographs(seed)
    found = [_object(shape, seed, sources, rng, k) for k in range(recipe.count)]
    names, meshes = tuple(name for name, _ in found), [shapes.centred(mesh, SIZE) for _, mesh in found]
    H, W = length.size
    f = FOCAL * W
    camera = opencv(torch.tensor([[f, 0.0, W / 2], [0.0, f, H / 2], [0.0, 0.0, 1.0]]), length.size)
    distance, speed = SIZE * rng.uniform(*recipe.distance), rng.uniform(*recipe.speed)
    motions = _motions(rng, distance, speed, recipe.count)
    if recipe.away:
        motions = (replace(motions[0], absence=_absence(camera, SIZE, distance, length, rng)),)
    behind = cropped(photos[int(rng.integers(len(photos)))], length.size, rng)
    if recipe.white:
        meshes, behind = [shapes.whitened(mesh) for mesh in meshes], 0.65 + 0.2 * behind
    given = tuple(meshes)
    draft = Draft(
        kind, seed, names, given, given, motions, camera, behind, lights(rng), balance(rng), wear(rng),
        (START[0] * rng.uniform(), START[1] * rng.uniform()), shutter=recipe.shutter,
        wall=(rng.uniform(0.9, 2.0), *rng.uniform(-0.3, 0.3, 2)) if recipe.depth else None,
    )  # fmt: skip
    if not recipe.occluder:
        return draft
    occluder = _occluder(recipe.occluder, photos, length, rng)
    if recipe.occluder == "hand":
        occluder = _reaching(draft, occluder, float(rng.uniform(*COVERED)))
    return replace(draft, occluder=occluder)


def opencv(K: Tensor, size: tuple[int, int]) -> eg.Camera:
    """Return a camera at the origin."""
    return eg.Camera.from_opencv(torch.eye(3), torch.zeros(3), K, size)


def _object(shape: str, seed: int, sources: Sources, rng: np.random.Generator, k: int) -> tuple[str, eg.Mesh]:
    """Return the k-th object of a film, and its name."""
    if shape in ("block", "bolt"):
        return shape, shapes.block(rng) if shape == "block" else shapes.bolt(rng)
    mine = sources if sources.meshes else replace(sources, meshes=TEXTURED)
    names = mine.names(seed)
    name = str(names[(seed + k) % len(names)])
    mesh = mine.mesh(name, seed, rng)
    return Path(name.split(",")[0]).stem, shapes.subdivided(mesh, DENSE) if shape == "dense" else mesh


def _motions(rng: np.random.Generator, distance: float, speed: float, count: int) -> tuple[Motion, ...]:
    """Return a motion about a place on the axis, or about places around it, of which the next one is farther away."""
    angle, found = rng.uniform(0.0, 2.0 * math.pi), []
    for k in range(count):
        first, z = Rotation.from_matrix(_random_rotation(rng)), distance + LAYER * SIZE * k
        way = angle + 2.0 * math.pi * k / count
        aside = np.array([ASIDE[0] * math.cos(way), ASIDE[1] * math.sin(way)]) * SIZE if count > 1 else np.zeros(2)
        swing = z / NEAR / (1.0 if count == 1 else 1.5)  # Several objects move less.
        found.append(Motion.drawn(rng, first, np.r_[aside * z / distance, z], swing, speed))
    return tuple(found)


def _random_rotation(rng: np.random.Generator) -> np.ndarray:
    q = rng.normal(size=4)
    return Rotation.from_quat(q / np.linalg.norm(q)).as_matrix()


def _absence(camera: eg.Camera, size: float, distance: float, length: Length, rng: np.random.Generator) -> Absence:
    """Return when an object leaves and comes back, about a third of the film later."""
    T, (H, W), f = length.frames, length.size, float(camera.K[0, 0])
    half = np.array([W, H]) / (2.0 * f) * (1.25 * distance)

    def beyond() -> np.ndarray:
        angle = rng.uniform(0.0, 2.0 * math.pi)
        way = np.array([math.cos(angle), math.sin(angle)])
        # Farther than half the picture, half the size, and its swings about the middle.
        reach = np.min((half + np.array([1.0, 0.9]) * size) / np.maximum(abs(way), 1e-9))
        return np.r_[reach * way, 0.0]

    begin, ramp = T * rng.uniform(0.2, 0.25), 0.14 * T
    end = begin + 2.0 * ramp + T * rng.uniform(0.02, 0.1)
    turn = math.radians(rng.uniform(25.0, 60.0)) * Rotation.from_matrix(_random_rotation(rng)).apply([1.0, 0.0, 0.0])
    return Absence(begin, end, ramp, beyond(), beyond(), turn)


def _occluder(name: str, photos: Sequence[Tensor], length: Length, rng: np.random.Generator) -> Occluder:
    """Return a hand from the side, or a board that hides the first object for some 10 to 20 of 100 frames."""
    T, angle = length.frames, rng.uniform(0.0, 2.0 * math.pi)
    way = np.array([math.cos(angle), math.sin(angle), 0.0])
    if name == "hand":
        rotation = Rotation.from_rotvec([0.0, 0.0, angle]) * Rotation.from_rotvec([rng.uniform(-0.4, 0.4), 0.0, 0.0])
        mesh, stay, ramp, away = shapes.hand(rng), rng.uniform(0.3, 0.45), 0.12, 1.4
    else:
        rotation = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-0.3, 0.3)])
        mesh = shapes.board(0.62, cropped(photos[int(rng.integers(len(photos)))], (256, 256), rng))
        stay, ramp, away = rng.uniform(0.05, 0.14), 0.12, 2.8
    begin = T * rng.uniform(0.25, 0.35)
    visit = Visit(begin, begin + stay * T, ramp * T, away * SIZE * way)
    return Occluder(mesh.replace(verts=SIZE * mesh.verts), rotation.as_matrix(), GAP * SIZE, visit)


def _reaching(draft: Draft, occluder: Occluder, covered: float) -> Occluder:
    """Return the occluder as far before the object as covers this share of it in the middle of its visit."""
    near, far, visit = -0.3 * SIZE, 1.2 * SIZE, occluder.visit
    for _ in range(REACH_STEPS):
        middle = (near + far) / 2
        tried = replace(occluder, short=middle)
        seen = Studio(replace(draft, occluder=tried)).visible((visit.begin + visit.end) / 2)[0]
        near, far = (middle, far) if seen < 1.0 - covered else (near, middle)
    return replace(occluder, short=(near + far) / 2)


def cropped(photograph: Tensor, size: tuple[int, int], rng: np.random.Generator) -> Tensor:
    """Return the largest part of a photograph of this shape, at a random place, as (*size, 3) without blocks of equal pixels."""
    H, W = photograph.shape[:2]
    scale = min(H / size[0], W / size[1])
    h, w = min(H, round(scale * size[0])), min(W, round(scale * size[1]))
    top, left = int(rng.integers(0, H - h + 1)), int(rng.integers(0, W - w + 1))
    part = photograph[top : top + h, left : left + w].movedim(-1, 0)[None]
    part = F.interpolate(part, size=size, mode="bilinear", antialias=True, align_corners=False)
    return part[0].movedim(0, -1).contiguous()


def lights(rng: np.random.Generator) -> Sequence[eg.lights.DirectionalLight | eg.lights.Environment]:
    """Return a sun from above, where −y is, and a sky."""
    sun, sky = sun_and_sky(False, rng)
    return [replace(sun, direction=sun.direction * torch.tensor([1.0, -1.0, 1.0])), sky]


def balance(rng: np.random.Generator) -> np.ndarray:
    """Return factors (3,) of radiance: the exposure and the white balance."""
    return 2.0 ** rng.uniform(-0.7, 0.3) * rng.uniform(0.85, 1.15, 3)


def wear(rng: np.random.Generator) -> tuple[float, float, int]:
    """Return the lens's blur, the noise, and the quality of JPEG."""
    return float(rng.uniform(*BLUR)), float(rng.uniform(*NOISE)), int(rng.integers(*QUALITY))


def film(kind: str, seed: int, sources: Sources, length: Length, cache: Path, folder: Path | None = None) -> Film:
    """Return a film, from the cache if it is there. `folder` has the photographs of REAL."""
    if kind.startswith("bottle_frames"):
        return photographs.frames(kind, seed, length.frames, folder or Path())
    draft = photographs.drawn(kind, seed, folder or Path()) if kind in REAL else drawn(kind, seed, sources, length)
    path = (
        cache
        / f"{kind}-{seed}-{length.frames}-{draft.camera.size[0]}x{draft.camera.size[1]}-{_fingerprint(sources, folder):08x}.npz"
    )
    if path.exists():
        return load(draft, path)
    made = render(draft, length.frames)
    save(made, path)
    return made


def _fingerprint(sources: Sources, folder: Path | None) -> int:
    """Return a number that changes with the code and with what films are made of, so that the cache has none of an older code."""
    here = Path(__file__).parent
    code = b"".join((here / name).read_bytes() for name in SOURCES)
    return zlib.crc32(repr((sources, folder)).encode(), zlib.crc32(code))
