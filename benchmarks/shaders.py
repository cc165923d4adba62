"""What shaders written in PyTorch cost, in time, memory and noise: one table.

Run:  python -m benchmarks.shaders [--only time memory noise mipmaps]

Times are medians of steps, image and backward pass, on a sphere of 81,920 faces at 256² and 16 samples a pixel; ratios are of
steps that alternate in one run.
"""

from __future__ import annotations

import argparse
import math
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

import edgegrad as eg

from .common import sphere
from .scenes import build, front_camera, icosphere, smooth_adjoint

F64 = torch.float64


def network() -> torch.nn.Module:
    """Three layers, 64 wide."""
    torch.manual_seed(0)
    layers = [torch.nn.Linear(6, 64), torch.nn.ReLU(), torch.nn.Linear(64, 64), torch.nn.ReLU(), torch.nn.Linear(64, 3)]
    return torch.nn.Sequential(*layers)


def harmonics(n: Tensor) -> Tensor:
    x, y, z = n.unbind(1)
    return torch.stack([torch.ones_like(x), x, y, z, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], 1)


def steps_of_time() -> dict[str, Callable[[int], None]]:
    """Return one step each of the kernel's own colours and texture, and of shaders."""
    mesh, camera, _ = sphere(256)
    adjoint = smooth_adjoint(256, 256, 3).float()
    texture = torch.rand((256, 256, 3), generator=torch.Generator().manual_seed(0)).requires_grad_()
    light = torch.rand((9, 3)).requires_grad_()
    assert mesh.colors is not None
    verts, colors = mesh.verts.clone().requires_grad_(), mesh.colors.clone().requires_grad_()
    uvs = torch.stack([torch.atan2(mesh.verts[:, 0], mesh.verts[:, 2]) / (2 * math.pi), mesh.verts[:, 1]], 1)
    textured = eg.Mesh(mesh.verts, mesh.faces, texture=texture, uvs=uvs, uv_faces=mesh.faces)
    net = network()

    def lit(hits: eg.points.Hits) -> Tensor:
        return hits.sample(texture) * (harmonics(hits.shading_normal) @ light)

    def learned(hits: eg.points.Hits) -> Tensor:
        return net(torch.cat([hits.position, hits.view], 1))

    def disc(hits: eg.points.Hits) -> Tensor:
        return hits.where(0.5 - (hits.position[:, :2] - 0.1).norm(dim=1), 0.9, 0.2 + 0.2 * hits.position)

    def smooth(hits: eg.points.Hits) -> Tensor:
        inside = (0.5 - (hits.position[:, :2] - 0.1).norm(dim=1)).sigmoid()[:, None]
        return 0.9 * inside + (1 - inside) * (0.2 + 0.2 * hits.position)

    def run(mesh: eg.Mesh, seed: int, shader: Callable[[eg.points.Hits], Tensor] | None = None) -> None:
        image = eg.render(mesh, camera, seed=seed, shader=shader)
        (image * adjoint).sum().backward()

    return {
        "fused, colours of vertices": lambda seed: run(mesh.replace(verts=verts, colors=colors), seed),
        "fused, texture": lambda seed: run(textured.replace(verts=verts), seed),
        "shader: texture in nine harmonics": lambda seed: run(textured.replace(verts=verts), seed, lit),
        "shader: network 3 × 64": lambda seed: run(mesh.replace(verts=verts), seed, learned),
        "shader: a smooth disc": lambda seed: run(mesh.replace(verts=verts), seed, smooth),
        "shader: a disc by where()": lambda seed: run(mesh.replace(verts=verts), seed, disc),
    }


def times(repeats: int = 9) -> None:
    steps = steps_of_time()
    for step in steps.values():
        step(0)
    taken: dict[str, list[float]] = {name: [] for name in steps}
    for seed in tqdm(range(repeats), desc="time", leave=False):
        for name, step in steps.items():
            begin = time.perf_counter()
            step(seed)
            taken[name].append(time.perf_counter() - begin)
    fused = taken["fused, colours of vertices"]
    print("| step, image and gradient | ms | ratio |\n|---|---|---|")
    for name, own in taken.items():
        ratio = statistics.median(a / b for a, b in zip(own, fused, strict=True))
        print(f"| {name} | {1e3 * statistics.median(own):.0f} | {ratio:.2f} |")


def peak(gradient: bool) -> None:
    """Print the memory that this process needs above its start, in MB."""
    mesh, camera, _ = sphere((1080, 1920))
    net, verts = network(), mesh.verts.clone().requires_grad_(gradient)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with torch.set_grad_enabled(gradient):
        image = eg.render(
            mesh.replace(verts=verts), camera, shader=lambda hits: net(torch.cat([hits.position, hits.view], 1))
        )
        if gradient:
            image.square().mean().backward()
    print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)


def memory() -> None:
    print("| 1920 × 1080, 16 samples a pixel, network 3 × 64 | MB |\n|---|---|")
    for gradient in (False, True):
        command = [sys.executable, "-m", "benchmarks.shaders", "--peak", str(int(gradient))]
        found = subprocess.run(command, capture_output=True, check=True, cwd=Path(__file__).parents[1])
        print(f"| {'image and gradient' if gradient else 'image'} | {float(found.stdout):.0f} |")


def noise(seeds: int = 64) -> None:
    """Print the noise of images whose faces are shaded once a pixel, and of ones shaded at every sample (4 × 4 as fine)."""
    camera, fine = front_camera(64), 4
    finer = camera.replace(K=torch.cat([fine * camera.K[:2], camera.K[2:]]), size=(64 * fine, 64 * fine))
    texture = torch.rand((64, 64, 3), generator=torch.Generator().manual_seed(0), dtype=F64)

    def textured(hits: eg.points.Hits) -> Tensor:
        return hits.sample(texture, uv=0.5 + 0.4 * hits.position[:, :2])

    cases = {
        "a smooth shader, 20,480 faces": (5, lambda hits: 0.5 + 0.4 * torch.sin(4 * hits.position)),
        "a smooth shader, 320 faces": (2, lambda hits: 0.5 + 0.4 * torch.sin(4 * hits.position)),
        "white noise of 2/3 px, 320 faces": (2, textured),
    }
    print("| root mean square noise of a pixel inside | once | every sample |\n|---|---|---|")
    for name, (level, shader) in cases.items():
        mesh = icosphere(level)
        mesh = mesh.replace(verts=0.9 * mesh.verts)
        with torch.no_grad():
            once = torch.stack([eg.render(mesh, camera, seed=seed, shader=shader) for seed in range(seeds)])
            every = torch.stack([eg.render(mesh, finer, 1, seed, shader=shader) for seed in range(seeds)])
        every = torch.nn.functional.avg_pool2d(every.movedim(-1, 1), fine).movedim(1, -1)
        inside = slice(24, 40), slice(24, 40)
        rms = [float(x.var(0)[inside].mean().sqrt()) for x in (once, every)]
        print(f"| {name} | {rms[0]:.4f} | {rms[1]:.4f} |")


def mipmaps(seeds: int = 16, converged: int = 32) -> None:
    """Print the error of gradients of a texture much finer than the pixels, with default samples, by filter."""
    scene = build("quad", 24)
    (quad,) = scene.scene.meshes
    print("| error of the gradient at 24 px of 256² texels | vertices | texels |\n|---|---|---|")
    for filter in ("linear", "mipmap"):

        def gradient(seed: int, filter: str = filter, **samples: Any) -> tuple[Tensor, ...]:
            assert quad.texture is not None
            verts, texture = quad.verts.clone().requires_grad_(), quad.texture.clone().requires_grad_()
            mesh = quad.replace(verts=verts, texture=texture, filter=filter)
            image = eg.render(mesh, scene.camera, seed=seed, **samples)
            return torch.autograd.grad(image, [verts, texture], scene.adjoint.to(image))

        many = zip(
            *(gradient(1000 + seed, sampling=eg.Sampling(surface=200_000)) for seed in range(converged)), strict=True
        )
        some = zip(*(gradient(seed) for seed in range(seeds)), strict=True)
        errors = []
        for correct, found in zip(many, some, strict=True):
            mean = torch.stack(correct).mean(0)
            squares = [float((g - mean).norm() / mean.norm()) ** 2 for g in found]
            errors.append(f"{100 * math.sqrt(statistics.fmean(squares)):.0f} %")
        print(f"| {filter} | {' | '.join(errors)} |")


PARTS = {"time": times, "memory": memory, "noise": noise, "mipmaps": mipmaps}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--peak", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.peak is not None:
        peak(bool(arguments.peak))
        sys.exit()
    for part in arguments.only:
        PARTS[part]()
        print()
