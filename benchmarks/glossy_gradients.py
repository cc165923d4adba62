"""How noisy gradients of glossy surfaces are, by default samples.

The loss is the squared difference to the image of a scene that one parameter tells from this one, without its noise: the gradient
is that of an image times a fixed residual. Printed is the standard deviation of the gradient over its size, as vectors, in
percent.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from glossy import SIZE, sky
from table import Bench, Row
from torch import Tensor
from torch.nn.functional import normalize

import edgegrad as eg
from edgegrad.report.scenes import sphere

Parameters = dict[str, Tensor]
# What tells the other image from this one.
CHANGES = {
    "roughness": torch.tensor(0.03), "metallic": torch.tensor(-0.1), "base color": torch.tensor(-0.1),
    "normals": 0.02 * torch.tensor([1.0, -0.7, 0.5]), "translation": 0.02 * torch.tensor([1.0, -0.7, 0.5]),
    "texels": 0.3 * torch.rand((8, 16, 3), generator=torch.Generator().manual_seed(1)),
}  # fmt: skip
UVS = 0.01 * torch.tensor([1.0, 0.7])


def ball(kind: str, roughness: float) -> tuple[Parameters, Callable[[Parameters], eg.Scene]]:
    """Of a metal that is not quite one. Normals and vertices have a common shift, texels of the sky a factor for 8 × 8."""
    given = {
        "roughness": torch.tensor(roughness),
        "metallic": torch.tensor(0.8),
        "base color": torch.tensor([0.9, 0.6, 0.3]),
    }
    given |= {"normals": torch.zeros(3), "translation": torch.zeros(3), "texels": torch.ones(8, 16, 3)}
    verts, image = normalize(sphere(5).verts.float(), dim=1), sky(kind)
    if kind == "even":  # brighter above: under one that is the same from all around normals hardly matter
        image = image * torch.linspace(1.5, 0.5, len(image))[:, None, None]

    def scene(p: Parameters) -> eg.Scene:
        material = eg.Material(p["base color"], metallic=p["metallic"], roughness=p["roughness"])
        mesh = eg.Mesh(verts + p["translation"], sphere(5).faces, normals=verts + p["normals"], material=material)
        radiance = image * p["texels"].repeat_interleave(8, 0).repeat_interleave(8, 1)
        return eg.Scene([mesh], lights=[eg.Environment(radiance)])

    return given, scene


def sheet() -> tuple[Parameters, Callable[[Parameters], eg.Scene]]:
    """A metal sheet with a wavy normal map under a point light, by the texture coordinates of its 81 vertices."""
    line = torch.linspace(-1, 1, 9)
    y, x = torch.meshgrid(line, line, indexing="ij")
    i = torch.arange(81).reshape(9, 9)
    a, b, c, d = (part.reshape(-1) for part in (i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]))
    faces = torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)])
    verts, t = torch.stack([x, y, 0 * x], -1).reshape(-1, 3), torch.arange(32) * (math.pi / 16)
    height = 0.75 * torch.sin(2 * t)[:, None] * torch.cos(3 * t)
    slopes = [height.roll(1, k) - height.roll(-1, k) for k in (1, 0)]
    image = normalize(torch.stack([*slopes, torch.ones_like(height)], -1), dim=-1) * 0.5 + 0.5

    def scene(p: Parameters) -> eg.Scene:
        map_ = eg.Texture(image, p["uvs"], faces)
        material = eg.Material(torch.tensor([0.9, 0.6, 0.3]), metallic=0.8, roughness=0.2, normal_map=map_)
        return eg.Scene(
            [eg.Mesh(verts, faces, material=material)], lights=[eg.PointLight(torch.tensor([1.0, 1.0, 3.0]), 30.0)]
        )

    return {"uvs": (verts[:, :2] + 1) / 2}, scene


def noise(
    given: Parameters, scene: Callable[[Parameters], eg.Scene], changes: Parameters, camera: eg.Camera, seeds: int
) -> dict[str, float]:
    """Of the gradient by each parameter, all taken at once, in percent."""

    def clean(p: Parameters) -> Tensor:
        with torch.no_grad():
            return eg.render(scene(p), camera, spp=64, light_samples=4, seed=900)

    residual = {name: 2 * (clean(given) - clean({**given, name: given[name] + by})) for name, by in changes.items()}
    found: dict[str, list[Tensor]] = {name: [] for name in changes}
    for seed in range(seeds):
        p = {name: value.clone().requires_grad_() for name, value in given.items()}
        image = eg.render(scene(p), camera, seed=seed)
        for name in changes:
            (g,) = torch.autograd.grad((image * residual[name]).sum(), p[name], retain_graph=True)
            found[name].append(g.double().flatten())
    return {name: _relative(torch.stack(gradients)) for name, gradients in found.items()}


def _relative(g: Tensor) -> float:
    """In percent; the square of the mean has its own noise in it, which is taken off."""
    variance = g.var(0).sum()
    return 100 * float((variance / (g.mean(0).square().sum() - variance / len(g)).clamp(min=1e-30)).sqrt())


def glossy_gradients(bench: Bench) -> list[Row]:
    camera = eg.Camera.look_at((0.0, 0.3, 3.2), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, (SIZE, SIZE))
    rows, seeds = [], bench.repeats(24)
    for kind in ("even", "lamps"):
        for roughness in (0.5, 0.2, 0.1, 0.05):
            found = noise(*ball(kind, roughness), CHANGES, camera, seeds)
            sky_ = "smooth sky" if kind == "even" else "sky with lamps"
            rows += [
                Row(
                    f"a metal ball, {sky_}, roughness {roughness}: gradient by {name}",
                    value,
                    unit=" %",
                    must=10.0,
                    aim=5.0,
                )
                for name, value in found.items()
            ]
    above = eg.Camera.look_at((0.6, -1.2, 2.6), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 45.0, (SIZE, SIZE))
    value = noise(*sheet(), {"uvs": UVS}, above, seeds)["uvs"]
    rows.append(Row("a normal-mapped sheet: gradient by texture coordinates", value, unit=" %", must=40.0, aim=20.0))
    return rows
