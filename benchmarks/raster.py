"""The operators of edgegrad.raster beside render(spp=1), and render_batch: processor time of a step, forward and backward.

python benchmarks/raster.py [--rounds 5]

The scene is a textured sphere of 20,480 faces, seen by 8 cameras at 512², with gradients of vertices and texture. Both take
turns; "share of the calling thread" is its processor time over that of all threads, which bounds what they gain.
render_batch has 16 spheres of 1,280 faces at 64²: plain ones take one thread each, beside the calling one, lit ones come one
by one.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable

import torch
from torch import Tensor

import edgegrad as eg
import edgegrad.raster as dr
from edgegrad.report.scenes import sphere

BATCH, SIZE = 8, 512


class Step:
    def __init__(self) -> None:
        mesh = sphere(5)
        self.verts, self.faces = mesh.verts.float(), mesh.faces
        self.uvs = (self.verts[:, :2] + 1) / 2
        self.texture, self.adjoint = torch.rand(512, 512, 3), torch.rand(BATCH, SIZE, SIZE, 3)
        angles = [2 * math.pi * k / BATCH for k in range(BATCH)]
        eyes = [(3 * math.sin(a), 0.3, 3 * math.cos(a)) for a in angles]
        self.cameras = [eg.Camera.look_at(eye, (0, 0, 0), (0, 1, 0), 45.0, (SIZE, SIZE)) for eye in eyes]
        self.topology = dr.antialias_construct_topology_hash(self.faces)

    def clip_space(self, verts: Tensor, near: float = 0.1, far: float = 10.0) -> Tensor:
        """(B, V, 4)"""
        out = []
        for camera in self.cameras:
            pose, f = camera.world_to_camera.float(), 2 * float(camera.K[0, 0]) / SIZE
            x, y, z = (verts @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
            depth = (far + near) / (far - near) * z - 2 * far * near / (far - near)
            out.append(torch.stack([f * x, -f * y, depth, z], 1))
        return torch.stack(out)

    def operators(self) -> None:
        verts, texture = self.verts.clone().requires_grad_(), self.texture.clone().requires_grad_()
        pos = self.clip_space(verts)
        rast, _ = dr.rasterize(dr.RasterizeContext(output_db=False), pos, self.faces, (SIZE, SIZE))
        uv, _ = dr.interpolate(self.uvs[None], rast, self.faces)
        color = torch.where(rast[..., 3:] > 0, dr.texture(texture[None], uv), 0.0)
        image = dr.antialias(color, rast, pos, self.faces, self.topology)
        (image * self.adjoint).sum().backward()

    def rendered(self) -> None:
        verts, texture = self.verts.clone().requires_grad_(), self.texture.clone().requires_grad_()
        mesh = eg.Mesh(verts, self.faces, uvs=self.uvs, uv_faces=self.faces, texture=texture)
        images = [eg.render(mesh, camera, spp=1) for camera in self.cameras]
        (torch.stack(images) * self.adjoint).sum().backward()


def batch(lit: bool) -> Callable[[], None]:
    """A step of render_batch() over 16 meshes that share vertices."""
    mesh = sphere(3)
    camera = eg.Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40.0, (64, 64))
    lights = [eg.DirectionalLight(torch.tensor([0.0, -0.3, -1.0]))] if lit else []
    material = eg.Material() if lit else None

    def step() -> None:
        verts = mesh.verts.float().requires_grad_()
        meshes = [eg.Mesh(verts * (1 + 0.01 * k), mesh.faces, material=material) for k in range(16)]
        images = eg.render_batch([(eg.Scene([own], lights=lights), camera) for own in meshes])
        assert isinstance(images, Tensor)
        images.square().sum().backward()

    return step


def processor_time(work: Callable[[], None]) -> tuple[float, float]:
    """Seconds of all threads, and of the calling one."""
    all_threads, own = time.process_time(), time.thread_time()
    work()
    return time.process_time() - all_threads, time.thread_time() - own


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    step = Step()
    found: dict[str, list[tuple[float, float]]] = {"operators": [], "render(spp=1)": []}
    for _ in range(rounds + 1):
        found["operators"].append(processor_time(step.operators))
        found["render(spp=1)"].append(processor_time(step.rendered))
    for name, times in found.items():
        whole, own = sorted(times[1:])[len(times[1:]) // 2]
        print(f"{name:14s} {1e3 * whole:6.0f} ms of processor time, share of the calling thread {own / whole:.2f}")
    ratios = sorted(a[0] / b[0] for a, b in zip(*(times[1:] for times in found.values()), strict=True))
    middle, threads = ratios[len(ratios) // 2], torch.get_num_threads()
    print(f"operators over render: {middle:.2f} ({ratios[0]:.2f} … {ratios[-1]:.2f}); {threads} threads")
    for lit in (False, True):
        work = batch(lit)
        whole, own = sorted([processor_time(work) for _ in range(rounds + 1)][1:])[rounds // 2]
        name = "render_batch, lit" if lit else "render_batch"
        print(f"{name:17s} {1e3 * whole / 16:5.1f} ms an image, share of the calling thread {own / whole:.2f}")
