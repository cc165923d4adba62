"""A ball with smooth colours, and light that matte surfaces reflect."""

import torch
import trimesh

import edgegrad as eg

LIGHT = torch.tensor([
    [0.8, 0.1, 0.2, 0.15, 0.05, -0.04, 0.02, 0.03, -0.05],
    [0.6, -0.1, 0.15, 0.2, 0.02, 0.06, 0.03, -0.03, 0.04],
    [0.5, 0.05, 0.25, 0.1, -0.03, 0.02, -0.02, 0.05, 0.02],
])  # fmt: skip


def ball_and_camera(size=64):
    sphere = trimesh.creation.icosphere(subdivisions=4)
    verts = torch.tensor(sphere.vertices.copy())
    waves = torch.tensor([[5.0, 1.0, 2.0], [-1.0, 6.0, 2.0], [2.0, -3.0, 5.0]]).double()
    colors = (0.5 + 0.3 * torch.sin(verts @ waves.T)).float()
    view = eg.Camera.look_at((0.0, 0.0, 3.2), (0, 0, 0), fov_y=45.0, size=(size, size)).to(torch.float64)
    return eg.Mesh(verts, torch.tensor(sphere.faces.copy()), colors=colors), view
