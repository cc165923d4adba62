"""A tiny data set in BOP's layout: a painted box without symmetries and a grey-belted one with a half turn, rendered."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import trimesh

import edgegrad as eg
from edgegrad import bop
from edgegrad.scene.symmetry_axis import about

SIZE = (72, 96)
K = torch.tensor([[120.0, 0.0, 47.5], [0.0, 120.0, 35.5], [0.0, 0.0, 1.0]])
PALETTE = torch.tensor(
    [[0.8, 0.1, 0.1], [0.1, 0.7, 0.2], [0.1, 0.2, 0.8], [0.9, 0.8, 0.1], [0.1, 0.8, 0.8], [0.8, 0.2, 0.8]]
)
# sRGB of 8 bits, as PLY files hold colours, so that what is read is what was rendered.
PALETTE = eg.image.srgb_to_linear((eg.image.linear_to_srgb(PALETTE) * 255).round() / 255)


def pose(turn: tuple[float, ...], shift: tuple[float, ...]) -> torch.Tensor:
    """Return a pose of a rotation vector in radians, and a shift in mm."""
    vector = torch.tensor(turn, dtype=torch.float64)
    M = torch.eye(4, dtype=torch.float64)
    M[:3, :3] = about(vector / vector.norm(), vector.norm()[None])[0]
    M[:3, 3] = torch.tensor(shift)
    return M


def meshes() -> dict[int, eg.Mesh]:
    """Return meshes in mm. The sides of object 1 have different colours; opposite sides of object 5 are alike, so it
    has three half turns."""
    found = {}
    for obj_id, sides in ((1, (60.0, 90.0, 40.0)), (5, (50.0, 70.0, 30.0))):
        box = trimesh.creation.box(sides)
        side = np.argmax(np.abs(box.face_normals), 1)
        colour = side if obj_id == 5 else 2 * side + (box.face_normals.sum(1) > 0)
        found[obj_id] = eg.Mesh(
            torch.tensor(box.vertices, dtype=torch.float32), torch.tensor(np.array(box.faces)),
            face_colors=PALETTE[torch.tensor(colour)],
        )  # fmt: skip
    return found


TRUTHS = [
    [(1, pose((0.5, 0.6, 0.2), (-20.0, 5.0, 400.0))), (5, pose((-0.7, 0.4, 0.3), (65.0, -10.0, 420.0)))],
    [(5, pose((0.3, -0.8, 0.1), (-60.0, 15.0, 380.0))), (5, pose((0.9, 0.3, -0.4), (55.0, 5.0, 400.0)))],
]


def camera() -> eg.Camera:
    one = torch.eye(3, dtype=torch.float64)
    return eg.Camera.from_opencv(one, one.new_zeros(3), K.double(), SIZE)


def make(folder: Path, scene_id: int = 3) -> Path:
    models = meshes()
    bop.files.write_models(folder, models, {5: eg.Symmetries.find(models[5])})
    bop.files.write_scene(folder, scene_id, [bop.files.Shot(camera(), objects) for objects in TRUTHS], models, spp=32)
    return folder


def estimates(moved: torch.Tensor | None = None) -> list[bop.files.Estimate]:
    """Return the true poses, each followed by a motion in the camera's axes."""
    moved = torch.eye(4, dtype=torch.float64) if moved is None else moved
    return [
        bop.files.Estimate(3, im_id, obj_id, 0.9 - 0.1 * i, moved @ truth, 1.5)
        for im_id, objects in enumerate(TRUTHS)
        for i, (obj_id, truth) in enumerate(objects)
    ]
