"""Find a texture and the light on it from pictures: the shader is nine spherical harmonics of the normal times the texture.

    python examples/harmonics.py [--out harmonics.png]

Ramamoorthi and Hanrahan 2001: the light that a matt surface returns is a polynomial of degree two in its normal. Both the
texture and the nine coefficients are tensors that the shader closes over; they get gradients like those of any module.
"""

from __future__ import annotations

import argparse
import math

import torch
from torch import Tensor
from tqdm import tqdm

import edgegrad as eg

SIZE = 96


def globe(rows: int = 24, columns: int = 48) -> eg.Mesh:
    """Return a sphere with texture coordinates, whose seam has two of them for one vertex."""
    i, j = torch.arange(rows + 1), torch.arange(columns + 1)
    phi, theta = 2 * math.pi * j / columns, math.pi * i / rows
    unit = torch.stack(
        torch.broadcast_tensors(
            theta.sin()[:, None] * phi.cos(), theta.cos()[:, None].neg(), theta.sin()[:, None] * phi.sin()
        ),
        -1,
    )
    corner = torch.stack([i[:-1, None] * (columns + 1) + j[:-1], i[1:, None] * (columns + 1) + j[:-1]], -1).reshape(
        -1, 2
    )
    a, b = corner.unbind(1)
    uv_faces = torch.cat([torch.stack([a, b, b + 1], 1), torch.stack([a, b + 1, a + 1], 1)])
    welded = torch.stack(torch.broadcast_tensors(i[:, None], j % columns), -1).reshape(-1, 2)
    index = welded[:, 0] * (columns + 1) + welded[:, 1]
    uvs = torch.stack(torch.broadcast_tensors(j / columns, (i / rows)[:, None]), -1).reshape(-1, 2)
    return eg.Mesh(unit.reshape(-1, 3), index[uv_faces], texture=torch.zeros(1, 1, 3), uvs=uvs, uv_faces=uv_faces)


def harmonics(n: Tensor) -> Tensor:
    """Return the real spherical harmonics (N, 9) of unit vectors (N, 3), to degree two, without their constants."""
    x, y, z = n.unbind(1)
    return torch.stack([torch.ones_like(x), x, y, z, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], 1)


def shader(texture: Tensor, light: Tensor) -> eg.shader.Shader:
    return lambda hits: hits.sample(texture) * (harmonics(hits.shading_normal) @ light)


def fit(steps: int = 150) -> tuple[list[Tensor], float, float]:
    """Return pictures (target, start, end), and the root mean square error of the image before and after."""
    torch.manual_seed(0)
    mesh = globe()
    cameras = eg.Camera.look_at((0.0, 0.8, 3.2), (0.0, 0.0, 0.0), size=(SIZE, SIZE))
    v, u = torch.meshgrid(torch.linspace(0, 1, 32), torch.linspace(0, 1, 64), indexing="ij")
    true_texture = torch.stack([0.5 + 0.4 * torch.sin(25 * u), 0.5 + 0.4 * torch.cos(18 * v), 0.3 + 0.4 * u], -1)
    true_light = torch.tensor([0.7, 0.25, 0.3, 0.2, 0.05, 0.05, 0.03, -0.1, 0.05])[:, None] * torch.tensor(
        [1.0, 0.95, 0.85]
    )

    def views(texture: Tensor, light: Tensor, seed: int, spp: int) -> Tensor:
        """Return views from six sides: the globe rotates under the light."""
        turned = []
        for k in range(6):
            c, s = math.cos(math.pi * k / 3), math.sin(math.pi * k / 3)
            R = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
            turned.append(eg.render(mesh.transformed(R), cameras, spp, seed, shader=shader(texture, light)))
        return torch.stack(turned)

    with torch.no_grad():
        target = views(true_texture, true_light, seed=10_000, spp=64)
    texture = torch.full((32, 64, 3), 0.5, requires_grad=True)
    light = torch.zeros(9, 3).index_fill_(0, torch.tensor(0), 0.7).requires_grad_()
    optimizer = torch.optim.Adam([{"params": [texture], "lr": 0.03}, {"params": [light], "lr": 0.02}])
    pictures, errors = [target[0]], []
    for step in tqdm(range(steps), desc="harmonics"):
        image = views(texture, light, seed=step, spp=4)
        loss = (image - target).square().mean()
        if step in (0, steps - 1):
            pictures.append(image[0].detach())
            errors.append(loss.item() ** 0.5)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return pictures, errors[0], errors[-1]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="harmonics.png")
    out = parser.parse_args().out
    pictures, before, after = fit()
    eg.write_image(out, torch.cat(pictures, 1))
    print(f"error of the image: {before:.4f} before, {after:.4f} after; {out}: target, start, end")
