"""The operators of edgegrad.raster next to render(spp=1), and render_batch: processor time of a step, forward and backward.

python -m benchmarks.raster [--rounds 5]

The scene is a textured sphere of 20,480 faces, seen by 8 cameras at 512², with gradients of vertices and texture. All take
turns. render_batch has 32 spheres of 1,280 faces at 64²: plain ones take one thread each, next to the calling one, lit ones come
one by one.

Two threads against one, also by turns: by the clock, as the least of all rounds, to be compared on a machine with other work
with what hashing gains there, which shares perfectly; and by processor time, that of one thread over what the busier of two
has, which does not count the time that threads wait for a processor, or for each other.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import statistics
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import torch
from torch import Tensor

import edgegrad as eg
import edgegrad.raster as dr

from .scenes import icosphere

BATCH, SIZE = 8, 512


class Step:
    def __init__(self) -> None:
        mesh = icosphere(5)
        self.verts, self.faces = mesh.verts.float(), mesh.faces
        self.uvs = (self.verts[:, :2] + 1) / 2
        self.texture, self.adjoint = torch.rand(512, 512, 3), torch.rand(BATCH, SIZE, SIZE, 3)
        angles = [2 * math.pi * k / BATCH for k in range(BATCH)]
        eyes = [(3 * math.sin(a), 0.3, 3 * math.cos(a)) for a in angles]
        self.cameras = [eg.Camera.look_at(eye, (0, 0, 0), (0, 1, 0), 45.0, (SIZE, SIZE)) for eye in eyes]
        self.topology = dr.antialias_construct_topology_hash(self.faces)

    def clip_space(self, verts: Tensor, near: float = 0.1, far: float = 10.0) -> Tensor:
        """Return clip-space positions (B, V, 4)."""
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
        rast, _ = dr.rasterize(dr.RasterizeGLContext(output_db=False), pos, self.faces, (SIZE, SIZE))
        uv, _ = dr.interpolate(self.uvs[None], rast, self.faces)
        color = torch.where(rast[..., 3:] > 0, dr.texture(texture[None], uv), 0.0)
        image = dr.antialias(color, rast, pos, self.faces, self.topology)
        (image * self.adjoint).sum().backward()

    def rendered(self) -> None:
        verts, texture = self.verts.clone().requires_grad_(), self.texture.clone().requires_grad_()
        mesh = eg.Mesh(verts, self.faces, uvs=self.uvs, uv_faces=self.faces, texture=texture)
        images = [eg.render(mesh, camera, spp=1) for camera in self.cameras]
        (torch.stack(images) * self.adjoint).sum().backward()


IMAGES = 32


def batch(lit: bool) -> Callable[[], None]:
    """Return a step of render_batch() over meshes that share vertices."""
    mesh = icosphere(3)
    camera = eg.Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40.0, (64, 64))
    lights = [eg.lights.DirectionalLight(torch.tensor([0.0, -0.3, -1.0]))] if lit else []
    material = eg.Material() if lit else None

    def step() -> None:
        verts = mesh.verts.float().requires_grad_()
        meshes = [eg.Mesh(verts * (1 + 0.01 * k), mesh.faces, material=material) for k in range(IMAGES)]
        images = eg.render_batch([(eg.Scene([own], lights=lights), camera) for own in meshes])
        assert isinstance(images, Tensor)
        images.square().sum().backward()

    return step


def hashing(blocks: int = 300) -> None:
    """Do work that threads share perfectly."""
    block, threads = bytes(1 << 20), torch.get_num_threads()

    def part(_: int) -> None:
        for _ in range(blocks // threads):
            hashlib.sha256(block).digest()  # without the interpreter's lock

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(part, range(threads)))


class Times(NamedTuple):
    """Seconds."""

    whole: float  # of processors, of all threads
    own: float  # of them that of the calling one
    wall: float


def measured(work: Callable[[], None]) -> Times:
    before = time.process_time(), time.thread_time(), time.perf_counter()
    work()
    after = time.process_time(), time.thread_time(), time.perf_counter()
    return Times(*(b - a for a, b in zip(before, after, strict=True)))


def middle(numbers: Iterable[float]) -> float:
    return statistics.median_low(list(numbers))


def by_turns(works: dict[str, Callable[[], None]], rounds: int) -> dict[str, dict[int, list[Times]]]:
    """Measure each with one thread and with two, in turns; the first round does not count."""
    found: dict[str, dict[int, list[Times]]] = {name: {1: [], 2: []} for name in works}
    for turn in range(rounds + 1):
        for name, work in works.items():
            for threads in (1, 2):
                torch.set_num_threads(threads)
                times = measured(work)
                if turn > 0:
                    found[name][threads].append(times)
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    step = Step()
    found = by_turns(
        {
            "operators": step.operators,
            "render(spp=1)": step.rendered,
            "render_batch": batch(lit=False),
            "render_batch, lit": batch(lit=True),
            "hashing": hashing,
        },
        rounds,
    )
    for name, (one, two) in ((name, times.values()) for name, times in found.items()):
        clock = min(t.wall for t in one) / min(t.wall for t in two)
        # Beside a calling thread that reads scenes, or waits, work two others: three share two processors.
        three = name in ("render_batch", "hashing")
        busier = [max(t.own, t.whole / 2 if three else t.whole - t.own) for t in two]
        gain = middle(t.whole / longest for t, longest in zip(one, busier, strict=True))
        print(
            f"{name:17s} {1e3 * middle(t.whole for t in one):5.0f} ms of processor time with 1 thread, "
            f"{1e3 * middle(t.whole for t in two):5.0f} with 2, of which the calling thread has "
            f"{middle(t.own / t.whole for t in two):.2f}; 2 threads gain {clock:.2f} by the clock, {gain:.2f} by "
            "processor time"
        )
    for threads in (1, 2):
        pairs = zip(found["operators"][threads], found["render(spp=1)"][threads], strict=True)
        ratios = [a.whole / b.whole for a, b in pairs]
        print(f"operators over render, {threads} threads: {middle(ratios):.2f} ({min(ratios):.2f} … {max(ratios):.2f})")
