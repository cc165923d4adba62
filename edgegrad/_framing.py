"""A view of a whole scene, for pictures that nobody described."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from .camera import Camera
from .scene import Scene


def framing(
    scene: Scene,
    size: tuple[int, int],
    fov: float = 40.0,
    eye: Sequence[float] | None = None,
    target: Sequence[float] | None = None,
    up: Sequence[float] = (0.0, 1.0, 0.0),
) -> Camera:
    """The whole scene, seen from (0.5, 0.4, 0.77) of the middle of its box as far as nothing else is said."""
    verts = torch.cat([mesh.verts for mesh in scene.meshes]).double()
    low, high = verts.aminmax(dim=0)
    middle = (low + high) / 2 if target is None else torch.tensor(target).double()
    radius = float((verts - middle).norm(dim=1).max())
    if not 0.0 < fov < 180.0:
        raise ValueError(f"--fov: expected degrees between 0 and 180, got {fov:g}")
    narrow = math.atan(math.tan(math.radians(fov) / 2) * min(1.0, size[1] / size[0]))  # half the smaller field of view
    direction = torch.tensor([0.5, 0.4, 0.77]).double()
    distance = 1.02 * max(radius, 1e-30) / math.sin(narrow)
    place = middle + distance * direction / direction.norm() if eye is None else torch.tensor(eye).double()
    return Camera.look_at(place, middle, torch.tensor(up).double(), fov, size)
