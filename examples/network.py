"""A network as a shader, and a shape under it: a glossy torus whose appearance and thickness are both unknown.

    python examples/network.py [--out network.png]

The network takes a point and the direction to the eye and gives a colour. What it does at the silhouette is never
differentiated by place; the thickness is found by how the silhouettes move, which the renderer adds.
"""

from __future__ import annotations

import argparse
import itertools
import math

import torch
import trimesh
from torch import Tensor
from tqdm import tqdm

import edgegrad as eg

SIZE = 96
TRUE_TUBE, FIRST_TUBE = 0.30, 0.22


def torus(tube: Tensor) -> eg.Mesh:
    """Return a torus around the z axis, with the radius 0.7; `tube` is that of its tube."""
    made = trimesh.creation.torus(0.7, 0.1, major_sections=48, minor_sections=24)
    surface = torch.tensor(made.vertices, dtype=torch.float32)
    middle = torch.nn.functional.pad(torch.nn.functional.normalize(surface[:, :2], dim=1) * 0.7, (0, 1))
    return eg.Mesh(middle + tube * (surface - middle) / 0.1, torch.tensor(made.faces))


def glossy(hits: eg.points.Hits) -> Tensor:
    """Return the radiance of paint with a highlight (Blinn 1977)."""
    light = torch.nn.functional.normalize(torch.tensor([0.5, -0.6, 0.7]), dim=0)
    half = torch.nn.functional.normalize(hits.view + light, dim=1)
    matt = (hits.shading_normal @ light).clamp(min=0)[:, None]
    shine = (hits.shading_normal * half).sum(1, keepdim=True).clamp(min=0) ** 12
    paint = 0.5 + 0.4 * torch.sin(3 * hits.position + torch.tensor([0.0, 2.0, 4.0]))
    return paint * (0.25 + 0.75 * matt) + 0.5 * shine


class Paint(torch.nn.Module):
    def __init__(self, width: int = 64) -> None:
        super().__init__()
        sizes = [9, width, width, 3]
        layers = [m for a, b in itertools.pairwise(sizes) for m in (torch.nn.Linear(a, b), torch.nn.SiLU())]
        self.layers = torch.nn.Sequential(*layers[:-1], torch.nn.Softplus())

    def forward(self, hits: eg.points.Hits) -> Tensor:
        return self.layers(torch.cat([hits.position, hits.shading_normal, hits.view], 1))


def fit(steps: int = 200) -> tuple[list[Tensor], float]:
    """Return pictures (target, start, end) and the thickness that was found."""
    torch.manual_seed(0)
    cameras = [
        eg.Camera.look_at(
            (2.6 * math.cos(a), 2.6 * math.sin(a), 1.2 + 0.8 * (k % 2)),
            (0.0, 0.0, 0.0),
            (0.0, 0.0, 1.0),
            size=(SIZE, SIZE),
        )
        for k, a in enumerate(torch.linspace(0, 2 * math.pi, 7)[:-1].tolist())
    ]
    with torch.no_grad():
        targets = [eg.render(torus(torch.tensor(TRUE_TUBE)), c, 64, 10_000, shader=glossy) for c in cameras]
    paint, tube = Paint(), torch.tensor(FIRST_TUBE, requires_grad=True)
    optimizer = torch.optim.Adam([{"params": paint.parameters(), "lr": 5e-3}, {"params": [tube], "lr": 3e-3}])
    pictures = [targets[0]]
    for step in tqdm(range(steps), desc="network"):
        k = 0 if step in (0, steps - 1) else step % len(cameras)
        image = eg.render(torus(tube), cameras[k], 8, step, shader=paint)
        if step in (0, steps - 1):
            pictures.append(image.detach())
        optimizer.zero_grad()
        (image - targets[k]).square().mean().backward()
        optimizer.step()
    return pictures, tube.item()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="network.png")
    out = parser.parse_args().out
    pictures, tube = fit()
    eg.write_image(out, torch.cat(pictures, 1).clamp(0, 1))
    print(f"radius of the tube: {FIRST_TUBE} before, {tube:.4f} after, {TRUE_TUBE} in truth; {out}: target, start, end")
