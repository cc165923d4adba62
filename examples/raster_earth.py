"""Find the texture of a globe from pictures in random poses and at random distances, with mipmaps and without.

    python examples/raster_earth.py [--steps 1000] [--size 128] [--out textures.png]

Targets are pictures of 8 times the size, reduced. Without mipmaps a distant picture says something of a few scattered texels
only; with them, of all that its pixels see. Prints the peak signal-to-noise ratio of both textures.
"""

from __future__ import annotations

import argparse
import math

import torch
from raster_views import descend, in_clip_space, perspective, rotations
from torch import Tensor

import edgegrad as eg
import edgegrad.raster as dr

TEXTURE = 256, 512  # height, width
FINER = 8


def globe(rings: int = 32, sectors: int = 64) -> tuple[Tensor, Tensor, Tensor]:
    """Return vertices of a sphere, their texture coordinates, and triangles; the seam has vertices of its own."""
    v, u = torch.meshgrid(torch.linspace(0, 1, rings + 1), torch.linspace(0, 1, sectors + 1), indexing="ij")
    up, around = math.pi * v, math.tau * u
    verts = torch.stack([up.sin() * around.cos(), -up.cos(), -up.sin() * around.sin()], 2)
    corner = torch.arange((rings + 1) * (sectors + 1)).view(rings + 1, sectors + 1)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    triangles = torch.stack([torch.stack([a, b, c], 2), torch.stack([a, c, d], 2)], 2).reshape(-1, 3)
    return verts.reshape(-1, 3), torch.stack([u, v], 2).reshape(-1, 2), triangles.int()


def world(generator: torch.Generator) -> Tensor:
    """Return (1, h, w, 3): coasts and hills of noise at all scales, with a grid of fine lines."""
    h, w = TEXTURE
    height = torch.zeros(1, 1, h, w)
    for k in range(2, 8):
        noise = torch.randn(1, 1, 2**k, 2 ** (k + 1), generator=generator)
        noise = torch.cat([noise, noise[..., :1]], 3)  # around the globe
        height = height + torch.nn.functional.interpolate(noise, (h, w), mode="bilinear", align_corners=True) * 0.6**k
    land = torch.sigmoid(40 * height)
    color = land * torch.tensor([0.35, 0.5, 0.2]).view(1, 3, 1, 1) + (1 - land) * torch.tensor([0.05, 0.15, 0.4]).view(
        1, 3, 1, 1
    )
    color = (color * (1 + height)).clamp(0, 1)
    color[..., ::16, :] += 0.4
    color[..., :, ::16] += 0.4
    return color.clamp(0, 1).permute(0, 2, 3, 1).contiguous()


class Globe:
    def __init__(self) -> None:
        self.verts, self.uv, self.tri = globe()

    def picture(self, texture: Tensor, R: Tensor, distance: Tensor, size: int, mipmaps: bool) -> Tensor:
        """Return pictures (B, size, size, 3)."""
        pos = in_clip_space(self.verts, R, distance, perspective(far=60.0))
        rast, rast_db = dr.rasterize(dr.RasterizeCudaContext(), pos, self.tri, (size, size))
        uv, uv_da = dr.interpolate(self.uv[None], rast, self.tri, rast_db, "all")
        image = dr.texture(texture, uv, uv_da if mipmaps else None)
        return torch.where(rast[..., 3:] > 0, image, 1.0)


def psnr(found: Tensor, truth: Tensor) -> float:
    """Return the ratio, weighted by the area that texels have on the globe."""
    h = truth.shape[1]
    area = ((torch.arange(h) + 0.5) * math.pi / h).sin()[None, :, None, None]
    return -10 * math.log10(float(((found.clamp(0, 1) - truth).square() * area).mean() / area.mean()))


def fit(mipmaps: bool, steps: int = 1000, size: int = 128, seed: int = 0) -> tuple[Tensor, float]:
    """Return the texture (1, h, w, 3) and its peak signal-to-noise ratio, dB."""
    generator = torch.Generator().manual_seed(seed)
    truth, of = world(generator), Globe()
    texture = torch.full_like(truth, 0.2).requires_grad_()
    optimizer = torch.optim.Adam([texture], lr=1e-2)

    def loss() -> Tensor:
        R, distance = rotations(1, generator), 2.5 + 30 * torch.rand(1, generator=generator) ** 3
        with torch.no_grad():
            fine = of.picture(truth, R, distance, FINER * size, mipmaps=False).permute(0, 3, 1, 2)
            target = torch.nn.functional.avg_pool2d(fine, FINER).permute(0, 2, 3, 1)
        return (of.picture(texture, R, distance, size, mipmaps) - target).square().mean()

    descend(optimizer, loss, steps, 0.1, "with mipmaps" if mipmaps else "without")
    return texture.detach(), psnr(texture.detach(), truth)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--out")
    options = parser.parse_args()
    found = {mipmaps: fit(mipmaps, options.steps, options.size) for mipmaps in (False, True)}
    for mipmaps, (_, ratio) in found.items():
        print(f"{'with mipmaps' if mipmaps else 'without':13s} {ratio:.1f} dB")
    if options.out:
        eg.write_image(options.out, torch.cat([texture[0] for texture, _ in found.values()]).clamp(0, 1).flip(0))
