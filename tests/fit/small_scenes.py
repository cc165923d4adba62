"""Cameras around the bracket, and an egg with its masks."""

import math

import pytest
import torch
from brackets import CENTER

import edgegrad as eg

QUIET = {"progress": False, "spp": 4}


def views(count=3, size=32):
    angles = [2.0 * math.pi * k / count + 0.3 for k in range(count)]
    eyes = [CENTER + 4.5 * torch.tensor([0.9 * math.sin(a), 0.3, 0.9 * math.cos(a)]).double() for a in angles]
    return [eg.Camera.look_at(eye, CENTER, fov_y=45.0, size=(size, size)) for eye in eyes]


def pictures(scene, cameras):
    return [eg.render(scene, view, spp=64, seed=1 << 20) for view in cameras]


def ball(subdivisions):
    trimesh = pytest.importorskip("trimesh")
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    return eg.Mesh(torch.tensor(shape.vertices).float(), torch.tensor(shape.faces))


def egg_views():
    egg = ball(3)
    egg = egg.replace(verts=egg.verts * torch.tensor([0.7, 1.1, 0.8]) + 0.05)
    axes = torch.tensor([[3.0, 0.2, 0], [0.2, 0, 3.0], [-2, 2, 0.5], [0.5, -3, 0.3]])
    cameras = [eg.Camera.look_at(eye, (0, 0, 0), (0.3, 0.5, 0.9), size=(64, 64)) for eye in axes]
    masks = [eg.render_aovs(egg, view, ["alpha"], spp=64, seed=5)["alpha"] for view in cameras]
    return cameras, masks
