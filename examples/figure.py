"""A helper of examples/body.py: a figure of twenty joints, whose limbs, flattened ellipsoids, bend smoothly where they meet."""

from __future__ import annotations

import math

import torch
from torch import Tensor

import edgegrad as eg

# name, parent, where the joint is, where its limb ends, half width, half thickness; metres
BONES: list[tuple[str, int, tuple[float, float, float], tuple[float, float, float], float, float]] = [
    ("hips", -1, (0.0, 1.0, 0.0), (0.0, 1.15, 0.0), 0.18, 0.11),
    ("spine", 0, (0.0, 1.15, 0.0), (0.0, 1.32, 0.0), 0.16, 0.10),
    ("chest", 1, (0.0, 1.32, 0.0), (0.0, 1.55, 0.0), 0.20, 0.12),
    ("neck", 2, (0.0, 1.55, 0.0), (0.0, 1.64, 0.0), 0.06, 0.05),
    ("head", 3, (0.0, 1.64, 0.0), (0.0, 1.88, 0.04), 0.08, 0.12),
]
for side, s in (("left", 1.0), ("right", -1.0)):
    k = len(BONES)
    BONES += [
        (f"{side} shoulder", 2, (0.06 * s, 1.52, 0.0), (0.2 * s, 1.5, 0.0), 0.07, 0.06),
        (f"{side} arm", k, (0.2 * s, 1.5, 0.0), (0.42 * s, 1.32, 0.0), 0.055, 0.04),
        (f"{side} elbow", k + 1, (0.42 * s, 1.32, 0.0), (0.62 * s, 1.14, 0.02), 0.048, 0.033),
        (f"{side} hand", k + 2, (0.62 * s, 1.14, 0.02), (0.73 * s, 1.02, 0.04), 0.05, 0.02),
    ]
for side, s in (("left", 1.0), ("right", -1.0)):
    k = len(BONES)
    BONES += [
        (f"{side} hip", 0, (0.1 * s, 0.98, 0.0), (0.13 * s, 0.56, 0.0), 0.095, 0.07),
        (f"{side} knee", k, (0.13 * s, 0.56, 0.0), (0.15 * s, 0.12, -0.02), 0.065, 0.045),
        (f"{side} foot", k + 1, (0.15 * s, 0.12, -0.02), (0.17 * s, 0.03, 0.17), 0.05, 0.03),
    ]
BONES.append(("hat", 4, (0.0, 1.86, 0.0), (0.0, 2.0, -0.08), 0.1, 0.05))
BONES_ALONG = [tuple(b - a for a, b in zip(bone[2], bone[3], strict=True)) for bone in BONES]  # at rest
HEIGHT = 2.0


def limb(start: Tensor, end: Tensor, width: float, thick: float, n: int) -> tuple[Tensor, Tensor]:
    """Return vertices and faces of an ellipsoid from joint to end, with its width across."""
    theta = torch.arange(1, n) * math.pi / n
    phi = torch.arange(2 * n) * math.pi / n
    sine, cosine = theta.sin()[:, None], theta.cos()[:, None].expand(-1, 2 * n)
    ring = torch.stack([sine * phi.cos(), cosine, sine * phi.sin()], -1)
    unit = torch.cat([torch.tensor([[0.0, 1.0, 0.0]]), ring.reshape(-1, 3), torch.tensor([[0.0, -1.0, 0.0]])])
    faces, last = [], len(unit) - 1
    for j in range(2 * n):
        k = (j + 1) % (2 * n)
        faces += [[0, 1 + k, 1 + j], [last, 1 + (n - 2) * 2 * n + j, 1 + (n - 2) * 2 * n + k]]
        for i in range(n - 2):
            a, b = 1 + i * 2 * n, 1 + (i + 1) * 2 * n
            faces += [[a + j, a + k, b + k], [a + j, b + k, b + j]]
    along = end - start
    y = along / along.norm()
    z = torch.tensor([0.0, 0.0, 1.0]) if abs(float(y[2])) < 0.8 else torch.tensor([0.0, 1.0, 0.0])
    x = torch.linalg.cross(y, z)
    x = x / x.norm()
    axes = torch.stack([width * x, 0.58 * float(along.norm()) * y, thick * torch.linalg.cross(x, y)])
    return unit @ axes + 0.5 * (start + end), torch.tensor(faces)


def figure(fine: int = 6, colored: bool = False) -> eg.rig.Rig:
    """Return a figure of some 120 vertices a limb at 6. Where a limb meets its parent's, its vertices hang on both."""
    verts, faces, weights, colors, count = [], [], [], [], 0
    g = torch.Generator().manual_seed(3)
    for k, (_, parent, start, end, width, thick) in enumerate(BONES):
        a, b = torch.tensor(start), torch.tensor(end)
        v, f = limb(a, b, width, thick, fine)
        along = ((v - a) @ (b - a)) / (b - a).square().sum()
        own = torch.zeros(len(v), len(BONES))
        share = (0.5 + along / 0.3).clamp(0.0, 1.0) if parent >= 0 else torch.ones(len(v))
        own[:, k] = share
        own[:, max(parent, 0)] += 1.0 - share
        verts.append(v)
        faces.append(f + count)
        weights.append(own)
        colors.append((0.03 + 0.6 * torch.rand(3, generator=g)) * (0.5 + 0.5 * torch.rand(len(v), 1, generator=g)))
        count += len(v)
    starts = torch.tensor([bone[2] for bone in BONES])
    parents = [bone[1] for bone in BONES]
    local = torch.stack([starts[k] - (starts[p] if p >= 0 else 0.0) for k, p in enumerate(parents)])
    joints = eg.rig.Joints([bone[0] for bone in BONES], parents, local, torch.zeros(len(BONES), 3))
    mesh = eg.Mesh(torch.cat(verts), torch.cat(faces), colors=torch.cat(colors) if colored else None)
    return eg.rig.Rig.from_arrays(mesh, joints, torch.cat(weights))


def cameras(size: int, count: int = 4) -> list[eg.Camera]:
    """Return cameras around the figure."""
    found = []
    for k in range(count):
        angle = 0.4 + math.tau * k / count
        eye = (3.6 * math.sin(angle), 1.3 + 0.5 * (k % 2), 3.6 * math.cos(angle))
        found.append(eg.Camera.look_at(eye, (0.0, 1.0, 0.0), up=(0, 1, 0), fov_y=40, size=(size, size)))
    return found


def pose(seed: int, most: float = 40.0) -> Tensor:
    """Return rotation vectors (20, 3) of up to so many degrees about random axes."""
    g = torch.Generator().manual_seed(seed)
    axes = torch.randn(len(BONES), 3, generator=g, dtype=torch.float64)
    angle = math.radians(most) * torch.rand(len(BONES), 1, generator=g, dtype=torch.float64)
    return angle * axes / axes.norm(dim=1, keepdim=True)
