"""Find the light from all around by pictures of a ball of polished metal that mirrors it.

    python examples/mirror.py [--out mirror.png]

render() has such a material of its own, `eg.Material(0.95, metallic=1.0, roughness=0.2)`. Here the shader is one of PyTorch,
for a metal that it defines itself. It is given points of the light that so smooth a metal mirrors, each with the density by
which it was drawn.
"""

from __future__ import annotations

import argparse
import math

import torch
from torch import Tensor
from torch.nn.functional import interpolate, normalize
from tqdm import tqdm

import edgegrad as eg

SIZE = 64
ROWS, COLUMNS = 16, 32
BASE, ALPHA = 0.95, 0.2**2
SMOOTH = 6e-3  # how much a rough environment costs: hardly any light comes from the texels around the poles


def metal(hits: eg.points.Hits) -> Tensor:
    """Return the radiance of the metal in the light of the scene."""
    (light,) = hits.lights
    points = hits.light_points(light, by=eg.lights.points_by_material)
    n, l = hits.shading_normal, light.incident(points, hits.position)
    arriving = light.arriving(points, hits.position)  # over the density, which has no derivative
    down = (n * l).sum(1, keepdim=True)
    return torch.where(down > 0, reflected(n, hits.view, l) * down * arriving, 0.0)


def reflected(n: Tensor, v: Tensor, l: Tensor) -> Tensor:
    """Return (N, 1): the microfacets of GGX (Walter et al. 2007), masked and shadowed (Heitz 2014), with Schlick's
    Fresnel term."""
    nv, nl = (n * v).sum(1, keepdim=True).clamp(min=1e-3), (n * l).sum(1, keepdim=True).clamp(min=1e-3)
    m = normalize(v + l, dim=1)
    sine = torch.linalg.cross(n, m).square().sum(1, keepdim=True)  # 1 − cos² would round it away
    facets = ALPHA**2 / (math.pi * (sine + ALPHA**2 * (1 - sine)) ** 2)
    fresnel = BASE + (1 - BASE) * (1 - (v * m).sum(1, keepdim=True)).clamp(0, 1) ** 5
    return facets * fresnel / (4 * nv * nl * (1 + slope_mask(nv) + slope_mask(nl)))


def slope_mask(cosine: Tensor) -> Tensor:
    """Return Smith's Λ of the GGX distribution (Heitz 2014, eq. 72)."""
    return ((1 + ALPHA**2 * (1 / cosine**2 - 1)).sqrt() - 1) / 2


def sky() -> Tensor:
    """Return a sky (ROWS, COLUMNS, 3): blue over brown, a sun, and two lights."""
    y, x = torch.meshgrid((torch.arange(ROWS) + 0.5) / ROWS, (torch.arange(COLUMNS) + 0.5) / COLUMNS, indexing="ij")
    x, y = x[..., None], y[..., None]
    above = torch.sigmoid(24 * (0.52 + 0.05 * torch.sin(6 * math.pi * x) - y))
    image = above * (1.1 - y) * torch.tensor([0.35, 0.5, 0.8]) + (1 - above) * torch.tensor([0.3, 0.22, 0.15])
    for u, v, color in ((0.3, 0.25, (3.0, 2.7, 2.0)), (0.72, 0.4, (0.9, 0.1, 0.1)), (0.9, 0.7, (0.1, 0.6, 0.2))):
        image = image + torch.exp(-(((x - u) * 24) ** 2 + ((y - v) * 12) ** 2) / 2) * torch.tensor(color)
    return image


def roughness(image: Tensor) -> Tensor:
    """Return the mean square of differences of neighbouring texels."""
    return image.diff(dim=0).square().mean() + (image - image.roll(1, 1)).square().mean()


def fit(steps: int = 200, size: int = SIZE) -> tuple[list[Tensor], Tensor]:
    """Return pictures of the ball (target, end), and the environment that was found."""
    material = eg.Material(torch.full((3,), BASE), metallic=1.0, roughness=ALPHA**0.5)  # by which points are drawn
    ball = eg.shapes.sphere(subdivisions=4, material=material)
    ball = ball.replace(normals=ball.vertex_normals())
    places = [(3.3, 1.2, 1.1), (-1.9, -1.0, 2.9), (-1.5, 1.0, -3.1), (2.0, -1.2, -2.9)]
    cameras = [eg.Camera.look_at(place, (0.0, 0.0, 0.0), fov_y=34.0, size=(size, size)) for place in places]

    def picture(radiance: Tensor, k: int, spp: int, seed: int) -> Tensor:
        scene = eg.Scene([ball], lights=[eg.lights.Environment(radiance, visible=False)])
        return eg.render(scene, cameras[k], spp, seed, shader=metal)

    def mean(radiance: Tensor, k: int, seed: int) -> Tensor:
        with torch.no_grad():
            return torch.stack([picture(radiance, k, 64, seed + i) for i in range(16)]).mean(0)

    targets = [mean(sky(), k, 10_000) for k in range(len(cameras))]
    found = torch.full((ROWS, COLUMNS, 3), 0.4, requires_grad=True)
    optimizer = torch.optim.Adam([found], lr=0.06)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=1e-3)
    for step in tqdm(range(steps), desc="mirror"):
        k = step % len(cameras)
        loss = (picture(found, k, 4, step) - targets[k]).square().mean() + SMOOTH * roughness(found)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        with torch.no_grad():
            found.clamp_(min=0.0)
    return [targets[0], mean(found, 0, 20_000)], found.detach()


def error(found: Tensor) -> float:
    """Return the root mean square over the directions, over that of the environment."""
    height = torch.sin((torch.arange(ROWS) + 0.5) * math.pi / ROWS)[:, None, None]
    return (((found - sky()) ** 2 * height).sum() / (sky() ** 2 * height).sum()).sqrt().item()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="mirror.png")
    out = parser.parse_args().out
    pictures, found = fit()
    maps = [interpolate(m.movedim(2, 0)[None], (SIZE, 2 * SIZE))[0].movedim(0, 2) for m in (sky(), found)]
    eg.write_image(out, torch.cat([pictures[0], maps[0], pictures[1], maps[1]], 1).clamp(0, 1))
    print(f"error of the environment: {error(torch.full_like(found, 0.4)):.3f} before, {error(found):.3f} after")
    print(f"{out}: the ball and its environment, the ball and the environment that were found")
