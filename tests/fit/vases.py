"""A vase as a solid of revolution by its radii."""

from __future__ import annotations

import math

import torch

import edgegrad as eg

RADII = torch.tensor([0.55, 0.75, 0.35, 0.5])
AROUND = 24
VIEW = eg.Camera.look_at((0.3, 1.4, 4.0), (0.0, 0.0, 0.0), fov_y=40.0, size=(96, 96))


def vase(radii):
    """Return a solid of revolution about the y axis."""
    angle = torch.arange(AROUND) * (2.0 * math.pi / AROUND)
    r = torch.cat([torch.full((1,), 1e-3), radii, torch.full((1,), 1e-3)])
    y = torch.tensor([-0.9, -0.9, -0.3, 0.3, 0.9, 0.9])
    verts = torch.stack([r[:, None] * angle.cos(), y[:, None].expand(-1, AROUND), r[:, None] * angle.sin()], -1)
    a = torch.arange(5)[:, None] * AROUND + torch.arange(AROUND)
    b = torch.arange(5)[:, None] * AROUND + (torch.arange(AROUND) + 1) % AROUND
    faces = torch.cat([torch.stack([a, a + AROUND, b], -1), torch.stack([b, a + AROUND, b + AROUND], -1)]).reshape(
        -1, 3
    )
    return eg.Mesh(verts.reshape(-1, 3), faces)
