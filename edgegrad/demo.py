"""The demo: an airliner above a photograph of the Earth, found again from a wrong pose.

The target is rendered at a known pose with seeds of its own. fit_pose gets the mesh, the picture, the camera, the background
and the start, and nothing else; the errors are taken afterwards. The light on the airliner is part of its colours.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from .camera.camera import Camera
from .camera.poses import rotation
from .files.image import read_image
from .fit import FitOptions, fit_pose
from .fit.pose.result import PoseFit
from .optional import require
from .render import render
from .scene.mesh import Mesh
from .scene.scene import Scene

SIZE = 256  # pixels
TARGET_SPP = 256
MOST_TURN, MOST_SHIFT = 20.0, 15.0  # degrees, percent of the object's size: how far a start is from the truth
FOUND_WITHIN = 0.5  # degrees and percent: what counts as found


class Errors(NamedTuple):
    """The distance of a pose from the true one."""

    degrees: float  # angle of the rotation between them
    percent: float  # distance of the object's centres, in percent of its size, the diagonal of its bounding box


class Run(NamedTuple):
    start: Errors
    end: Errors
    fit: PoseFit


def airliner() -> Mesh:
    """Return the airliner that the pyvista wheel carries, painted, in the light of a high sun and a blue sky."""
    examples = require("pyvista.examples", "edgegrad[demo]", "the demo")
    surface = examples.load_airplane().compute_normals(feature_angle=40.0, split_vertices=True)
    verts = torch.from_numpy(np.array(surface.points, np.float64))
    faces = torch.from_numpy(np.array(surface.regular_faces, np.int64))
    normals = torch.from_numpy(np.array(surface.point_data["Normals"], np.float64))

    # The file's axes: x along the wings, y from the nose to the tail, z up.
    low, high = verts.aminmax(dim=0)
    middle = ((verts - (low + high) / 2) / (high - low).norm())[faces].mean(1)
    side, back, up = middle[:, 0].abs(), middle[:, 1], middle[:, 2]
    paint = torch.tensor([0.62, 0.62, 0.64]).double().repeat(len(faces), 1)
    paint[(back > 0.22) & ((side > 0.02) | (up > 0.02))] = torch.tensor([0.72, 0.06, 0.05]).double()  # tail
    paint[side > 0.31] = torch.tensor([0.72, 0.06, 0.05]).double()  # wing tips
    paint[back < -0.285] = torch.tensor([0.05, 0.06, 0.08]).double()  # nose

    sun = F.normalize(torch.tensor([-0.35, 0.45, 0.82]).double(), dim=0)
    sunlight = (normals @ sun).clamp(min=0.0)[:, None] * torch.tensor([1.0, 0.95, 0.85]).double()
    above = 0.5 + 0.5 * normals[:, 2:]  # the part of the sky that a point sees; the rest is ground
    light = sunlight + above * torch.tensor([0.25, 0.32, 0.42]) + (1.0 - above) * torch.tensor([0.16, 0.13, 0.09])
    return Mesh(verts, faces, corner_colors=(light[faces] * paint[:, None]).float())


def earth() -> Tensor:
    """Return (SIZE, SIZE, 3) linear radiance: Europe, Africa and Arabia, from the photograph map that the pyvista wheel
    carries."""
    examples = require("pyvista.examples", "edgegrad[demo]", "the demo")
    view = read_image(examples.mapfile, channels=3)[130:530, 960:1360]
    return F.interpolate(view.movedim(-1, 0)[None], size=(SIZE, SIZE), mode="area")[0].movedim(0, -1).contiguous()


def run(mesh: Mesh, background: Tensor, seed: int, progress: bool = True) -> Run:
    """Render one target at a random pose, and fit it from one start near it."""
    rng = np.random.default_rng(seed)
    low, high = mesh.verts.aminmax(dim=0)
    center, size = (low + high) / 2, float((high - low).norm())
    up = torch.tensor([0.0, 0.0, 1.0]).double()
    camera = Camera.look_at(center + 1.35 * size * up, center, (0.0, 1.0, 0.0), fov_y=40.0, size=(SIZE, SIZE))

    heading, tilt = rng.uniform(0.0, 2.0 * math.pi), math.radians(rng.uniform(0.0, 40.0))
    axis = rng.uniform(0.0, 2.0 * math.pi)
    leaning = rotation(tilt * torch.tensor([math.cos(axis), math.sin(axis), 0.0]).double())
    R_true = leaning @ rotation(torch.tensor([0.0, 0.0, heading]).double())
    center_true = center + size * torch.from_numpy(rng.uniform(-0.1, 0.1, 3))
    posed = mesh.transformed(R_true, center_true - R_true @ center)
    target = render(Scene([posed], background), camera, spp=TARGET_SPP, seed=int(rng.integers(2**40, 2**41)))

    turn = math.radians(rng.uniform(0.5, 1.0) * MOST_TURN)
    R_start = rotation(torch.from_numpy(turn * direction(rng))) @ R_true
    center_start = center_true + torch.from_numpy(rng.uniform(0.5, 1.0) * MOST_SHIFT / 100.0 * size * direction(rng))
    start = torch.eye(4, dtype=torch.float64)
    start[:3, :3], start[:3, 3] = R_start, center_start - R_start @ center

    options = FitOptions(seed=seed, progress=progress)
    fit = fit_pose(Scene([mesh], background), target, camera, init=start, options=options)

    def errors(R: Tensor, t: Tensor) -> Errors:
        # The arc cosine alone loses half the digits of a small angle.
        apart = R @ R_true.T
        sine = (
            0.5 * torch.stack([apart[2, 1] - apart[1, 2], apart[0, 2] - apart[2, 0], apart[1, 0] - apart[0, 1]]).norm()
        )
        degrees = math.degrees(math.atan2(float(sine), 0.5 * (float(apart.trace()) - 1.0)))
        return Errors(degrees, 100.0 * float((R @ center + t - center_true).norm()) / size)

    return Run(errors(start[:3, :3], start[:3, 3]), errors(fit.R, fit.t), fit)


def direction(rng: np.random.Generator) -> np.ndarray:
    """Return a direction (3,) of length 1, uniform over the sphere."""
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)
