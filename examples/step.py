"""Find the place and the size of a disc, and the width of stripes, on a sphere from one picture.

    python examples/step.py [--out step.png]

The shader declares its discontinuities by hits.where() and hits.floor(), so their borders have gradients. With torch.where() and
torch.floor() the image is the same, and the gradient of all four numbers is zero.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

import edgegrad as eg

SIZE = 128
RED, WHITE, BLUE = (torch.tensor(c) for c in ([0.75, 0.1, 0.08], [0.85, 0.85, 0.8], [0.1, 0.2, 0.5]))


class Paint(NamedTuple):
    centre: Tensor  # (2,) of the disc, along x and y
    radius: Tensor
    stripe: Tensor  # width

    def __call__(self, hits: eg.points.Hits) -> Tensor:
        p = hits.position
        stripes = hits.floor(p[:, 1] / self.stripe)[:, None] % 2
        ground = stripes * WHITE + (1 - stripes) * BLUE
        front = p[:, 2] > 0
        disc = hits.where(self.radius - (p[:, :2] - self.centre).norm(dim=1), RED, ground)
        return torch.where(front[:, None], disc, ground) * (0.4 + 0.6 * hits.shading_normal[:, 2:].clamp(min=0))


TRUTH = Paint(torch.tensor([0.15, 0.1]), torch.tensor(0.45), torch.tensor(0.21))


def fit(steps: int = 120) -> tuple[list[Tensor], Paint]:
    """Return pictures (target, start, end), and what was found."""
    mesh = eg.shapes.sphere()
    camera = eg.Camera.look_at((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), fov_y=32.0, size=(SIZE, SIZE))
    with torch.no_grad():
        target = eg.render(mesh, camera, 64, 10_000, shader=TRUTH)
    leaves = [torch.tensor(v, requires_grad=True) for v in ([-0.1, 0.25], 0.3, 0.19)]
    paint = Paint(*leaves)
    rates = (0.01, 0.01, 0.001)
    optimizer = torch.optim.Adam([{"params": [p], "lr": r} for p, r in zip(leaves, rates, strict=True)])
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=1e-5)
    pictures = [target]
    for step in tqdm(range(steps), desc="step"):
        image = eg.render(mesh, camera, 8, step, shader=paint)
        if step in (0, steps - 1):
            pictures.append(image.detach())
        optimizer.zero_grad()
        (image - target).square().mean().backward()
        optimizer.step()
        schedule.step()
    return pictures, Paint(*(leaf.detach() for leaf in leaves))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="step.png")
    out = parser.parse_args().out
    pictures, found = fit()
    eg.write_image(out, torch.cat(pictures, 1))
    for name, value, truth in zip(Paint._fields, found, TRUTH, strict=True):
        print(f"{name}: {[round(x, 4) for x in value.reshape(-1).tolist()]}, in truth {truth.reshape(-1).tolist()}")
    print(f"{out}: target, start, end")
