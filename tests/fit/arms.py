"""A bar of some bones as a rig, with cameras around it."""

from __future__ import annotations

import math

import torch

import edgegrad as eg


def arm(bones: int = 2, colored: bool = False) -> eg.rig.Rig:
    """Return a flat bar along y with some bones of length 1."""
    n = 4 * bones
    y = torch.linspace(0.0, float(bones), n + 1, dtype=torch.float64)
    ring = [(0.22, 0.1), (-0.22, 0.1), (-0.22, -0.1), (0.22, -0.1)]
    verts = torch.stack(
        [torch.tensor([x * (1.2 - 0.3 * float(h) / bones), float(h), z]).double() for h in y for x, z in ring]
    )
    faces = [[4 * k + a, 4 * k + (a + 1) % 4, 4 * k + 4 + (a + 1) % 4] for k in range(n) for a in range(4)]
    faces += [[4 * k + a, 4 * k + 4 + (a + 1) % 4, 4 * k + 4 + a] for k in range(n) for a in range(4)]
    faces += [[0, 2, 1], [0, 3, 2], [4 * n, 4 * n + 1, 4 * n + 2], [4 * n, 4 * n + 2, 4 * n + 3]]
    weights = torch.zeros(len(verts), bones)
    for k in range(bones):
        up = (verts[:, 1] - k + 0.25).mul(2.0).clamp(0.0, 1.0) if k else torch.ones(len(verts))
        weights[:, : k or None] *= (1.0 - up)[:, None] if k else 1.0
        weights[:, k] = up
    joints = eg.rig.Joints(
        [f"bone {k}" for k in range(bones)], list(range(-1, bones - 1)),
        torch.tensor([[0.0, float(k > 0), 0.0] for k in range(bones)]), torch.zeros(bones, 3),
    )  # fmt: skip
    colors = 0.3 + 0.5 * torch.rand(len(verts), 3, generator=torch.Generator().manual_seed(0)) if colored else None
    return eg.rig.Rig.from_arrays(eg.Mesh(verts.float(), torch.tensor(faces), colors=colors), joints, weights)


def views(size: int = 48, count: int = 3) -> list[eg.Camera]:
    eyes = [(5.0 * math.sin(a), 1.8, 5.0 * math.cos(a)) for a in (0.3 + math.tau * k / count for k in range(count))]
    return [eg.Camera.look_at(eye, (0, 1, 0), up=(0, 1, 0), fov_y=40, size=(size, size)) for eye in eyes]


def shown(posed: eg.Mesh, cameras: list[eg.Camera], name: str = "alpha") -> list[torch.Tensor]:
    return [eg.render_aovs(posed, camera, [name], spp=64, seed=9)[name] for camera in cameras]


def degrees(found: torch.Tensor, truth: torch.Tensor) -> float:
    return math.degrees(float((found - truth).norm(dim=-1).max()))


TRUTH = torch.tensor([[0.1, 0.2, -0.3], [0.3, -0.2, 0.5]], dtype=torch.float64)
