"""Films with real photographs of a folder (benchmarks/poses/photographs.py says what is in it).

In `squirrel`, `cracker`, `gelatin` and `bottle`, the object is rendered in motion before its photograph, which has the real one
elsewhere. `bottle_frames` are two frames of a real film with a reference pose, which are shown by turns: camera and bottle stand
still, and the start is off, so errors say where a tracker comes to rest.
"""

from __future__ import annotations

import io
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

import edgegrad as eg
from benchmarks.poses import photographs
from benchmarks.poses.cases import Case
from edgegrad.files.image import linear_to_srgb

from . import drafts
from .films import DEPTH_UNIT, Draft, Film, measure
from .motion import NEAR, Motion

SPEED = 0.4, 1.0
FRAMES = 200, 201  # of the bottle's film
START = 4.0, 0.02  # degrees and share of the size by which the start is off where the object stands still


def drawn(kind: str, seed: int, folder: Path) -> Draft:
    """Return the draft of a film before a photograph."""
    if kind == "squirrel":
        case = photographs.squirrel(folder)
    elif kind == "cracker":
        case = photographs.cracker_box(folder)
    else:
        case = (
            photographs.gelatin_box(folder, False)
            if kind == "gelatin"
            else photographs.bottle(folder, FRAMES[0], False)
        )
    rng = np.random.default_rng([zlib.crc32(kind.encode()), seed])
    given, shown = (case.mesh.replace(material=None),) * 2
    if given.channels is None:  # Trackers know no colour; it is seen in one.
        colour = torch.from_numpy(rng.uniform(0.1, 0.6, 3)).float()
        shown = given.replace(colors=colour.expand(len(given.verts), 3).contiguous())
    if shown.normals is None:
        shown = shown.replace(normals=shown.vertex_normals())
    first = Rotation.from_matrix(case.truth.R.double().numpy())
    place = case.truth.R.double().numpy() @ measure(given)[0] + case.truth.t.double().numpy()
    # Nearer the middle than in the photograph, so that swings stay in the picture.
    middle = np.r_[0.5 * place[:2], place[2]]
    motion = Motion.drawn(rng, first, middle, place[2] / NEAR, rng.uniform(*SPEED))
    return Draft(
        kind, seed, (case.name,), (shown,), (given,), (motion,), _at_origin(case), case.picture, drafts.lights(rng),
        drafts.balance(rng) * 0.8, drafts.wear(rng), (drafts.START[0] * rng.uniform(), drafts.START[1] * rng.uniform()),
    )  # fmt: skip


def frames(kind: str, seed: int, count: int, folder: Path) -> Film:
    """Return the real film, in which the two frames come by turns."""
    depth, rng = kind.endswith("depth"), np.random.default_rng([zlib.crc32(kind.encode()), seed])
    cases = [photographs.bottle(folder, frame, depth) for frame in FRAMES]
    files = tuple(_png(cases[k % 2]) for k in range(2))
    case = cases[0].started(*START, rng)
    assert case.start is not None
    truth = np.broadcast_to(case.truth.matrix.numpy(), (count, 1, 4, 4))
    depths = [
        np.nan_to_num(one.depth.numpy() / DEPTH_UNIT).round().astype(np.uint16)
        for one in cases
        if one.depth is not None
    ]
    return Film(
        kind, seed, (case.name,), (case.mesh.replace(material=None),), _at_origin(case),
        tuple(files[k % 2] for k in range(count)), truth, np.ones((count, 1)), case.start.matrix.numpy()[None],
        np.stack([depths[k % 2] for k in range(count)]) if depths else None,
    )  # fmt: skip


def _at_origin(case: Case) -> eg.Camera:
    assert torch.equal(case.camera.world_to_camera, torch.eye(4)), "cameras of photographs are at the origin"
    return replace(case.camera)


def _png(case: Case) -> bytes:
    file, srgb = io.BytesIO(), linear_to_srgb(case.picture)
    Image.fromarray((255.0 * srgb.numpy()).round().astype(np.uint8)).save(file, "PNG")
    return file.getvalue()
