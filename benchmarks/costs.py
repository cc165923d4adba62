"""What parts of a step cost, and what they are compared with."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import torch
from torch import Tensor

import edgegrad as eg
from edgegrad.library import core

from .common import Kernel, Step, parts, single, sphere
from .scenes import build, cube, front_camera, icosphere, smooth_adjoint, smooth_colors
from .table import Bench, Row, median_row, median_time, ratio_row, seconds_of


@cache
def big() -> Kernel:
    """81,920 faces at 512² × 16."""
    return Kernel(*sphere(512))


def forward(bench: Bench) -> list[Row]:
    kernel, (mesh, camera, _) = big(), sphere(512)
    threads = torch.get_num_threads()

    def call() -> None:
        with torch.no_grad():
            eg.render(mesh, camera)

    widths = sorted({8, core.packet_width()})
    loops = [lambda n=n: parts.bare_loop(kernel.scene, kernel.camera, kernel.options, n, threads) for n in widths]
    *bare, inside, whole = bench.interleaved(21, *loops, kernel.forward, lambda: seconds_of(call))
    target: dict[str, Any] = {"must": 0.8, "aim": 0.95, "more_is_better": True}
    rows = []
    for width, loop in zip(widths, bare, strict=True):
        what = f"forward: rays/s over the bare loop, packets of {width}"
        note = f"{512 * 512 * 16 / statistics.median(loop) / 1e6:.1f} M rays/s in the bare loop, {median_time(loop)}"
        rows.append(ratio_row(f"{what}, kernel", loop, inside, note=note, **target))
        rows.append(ratio_row(f"{what}, eg.render", loop, whole, note=median_time(whole), **target))
    return rows


def backward(bench: Bench) -> list[Row]:
    kernel, (mesh, camera, adjoint) = big(), sphere(512)
    assert mesh.colors is not None
    mesh = mesh.replace(verts=mesh.verts.requires_grad_(), colors=mesh.colors.requires_grad_())
    images: list[Tensor] = []

    def render() -> None:
        assert mesh.colors is not None
        mesh.verts.grad = mesh.colors.grad = None
        images[:] = [eg.render(mesh, camera)]

    ahead, back, torch_ahead, torch_back = bench.interleaved(
        21, kernel.forward, lambda: kernel.backward(appearance=True),
        lambda: seconds_of(render), lambda: seconds_of(lambda: images[0].backward(adjoint)),
    )  # fmt: skip
    target: dict[str, Any] = {"must": 0.5, "aim": 0.25}
    return [
        ratio_row("backward over forward, kernel", back, ahead, note=median_time(back), **target),
        ratio_row("backward over forward, autograd", torch_back, torch_ahead, note=median_time(torch_back), **target),
    ]


def update(bench: Bench) -> list[Row]:
    mesh, camera, adjoint = sphere(64)
    kernels = [Kernel(mesh.replace(verts=mesh.verts * scale), camera, adjoint, spp=1) for scale in (1.0, 1.001)]
    turn = [0]

    def move() -> float:
        kernel = kernels[turn[0] % 2]
        turn[0] += 1
        kernel.forward()
        return 1e3 * kernel.profile["update"]

    def weld() -> float:
        kernel = kernels[(turn[0] - 1) % 2]  # the one that moved last
        kernel.backward(64, 64)
        return 1e3 * kernel.profile["update"]

    moved, welded = bench.interleaved(41, move, weld)
    note = f"and {statistics.median(welded):.2g} ms in the backward pass that follows, for edges"
    return [median_row("update after vertices moved, 81,920 faces", moved, unit=" ms", must=6, aim=3, note=note)]


def small(bench: Bench) -> list[Row]:
    step = Step(single(cube()), front_camera(64), smooth_adjoint(64, 64, 3).float())
    (times,) = bench.interleaved(201, lambda: 1e3 * step(spp=4)[1])
    return [median_row("cube at 64² × 4 spp: update, forward and backward", times, unit=" ms", must=2, aim=0.7)]


def large(bench: Bench) -> list[Row]:
    steps = [Step(*sphere(512, subdivisions)) for subdivisions in (6, 8)]
    few, many = bench.interleaved(9, *(lambda step=step: step()[1] for step in steps))
    note = f"{median_time(many)} over {median_time(few)}"
    return [ratio_row("1.3 M faces: a step over that at 81,920 faces", many, few, must=3, aim=2, note=note)]


def threads(bench: Bench) -> list[Row]:
    kernel = big()
    sides = [lambda n=n: kernel.forward(n) for n in (1, 2)]
    sides += [lambda n=n: kernel.backward(appearance=True, threads=n) for n in (1, 2)]
    one, two, one_back, two_back = bench.interleaved(15, *sides)
    target: dict[str, Any] = {"must": 1.8, "aim": 1.95, "more_is_better": True}
    return [
        ratio_row("2 threads over 1, forward", one, two, note=f"{median_time(one)} over {median_time(two)}", **target),
        ratio_row(
            "2 threads over 1, backward", one_back, two_back,
            note=f"{median_time(one_back)} over {median_time(two_back)}", **target,
        ),
    ]  # fmt: skip


def bits(bench: Bench) -> list[Row]:
    kernel = big()
    found = []
    for n in (1, 2):
        kernel.forward(n)
        kernel.backward(appearance=True, threads=n)
        found.append([tensor.clone() for tensor in (kernel.image, *kernel.grads.values())])
    same = all(torch.equal(a, b) for a, b in zip(*found, strict=True))
    return [Row("same bits at 1 and 2 threads (1: yes)", float(same))]


def textures(bench: Bench) -> list[Row]:
    globe = build("globe", 512)
    mesh = globe.scene.meshes[0]
    plain = mesh.replace(texture=None, uvs=None, uv_faces=None, colors=smooth_colors(mesh.verts))
    textured, colored = (Kernel(m, globe.camera, globe.adjoint) for m in (mesh, plain))
    times = bench.interleaved(
        15, textured.forward, colored.forward,
        lambda: textured.backward(appearance=True), lambda: colored.backward(appearance=True),
    )  # fmt: skip
    note = "65,024 faces; gradients of vertices and texels, or of vertices and colours"
    return [
        ratio_row("texture over colours of vertices, forward", times[0], times[1]),
        ratio_row("texture over colours of vertices, backward", times[2], times[3], note=note),
    ]


@dataclass(frozen=True)
class Channels:
    """The image of a sphere, or channels next to it, and perhaps the gradient of all of them by the vertices."""

    mesh: eg.Mesh
    camera: eg.Camera
    names: Sequence[str] | None  # None: render()
    gradient: bool

    def seconds(self) -> float:
        mesh = self.mesh.replace(verts=self.mesh.verts.detach().clone().requires_grad_(self.gradient))
        return seconds_of(partial(self.run, mesh))

    def run(self, mesh: eg.Mesh) -> None:
        if self.names is None:
            found = [eg.render(mesh, self.camera)]
        else:
            found = list(eg.render_aovs(mesh, self.camera, self.names).values())
        if self.gradient:
            torch.autograd.backward(found, [smooth_channels(x.shape[-1]) for x in found])


@cache
def smooth_channels(channels: int) -> Tensor:
    return smooth_adjoint(256, 256, channels).float()


def aovs(bench: Bench) -> list[Row]:
    rows = []
    _, camera, _ = sphere(256)
    for subdivisions, names, most in (
        (6, ["image", "alpha"], 1.1), (6, ["image", "alpha", "depth"], 1.5),
        (6, ["image", "alpha", "depth", "normal"], 1.5), (4, ["image", "alpha", "depth", "normal"], 1.5),
    ):  # fmt: skip
        mesh = single(icosphere(subdivisions))
        for gradient in (False, True):
            one, all_ = (Channels(mesh, camera, chosen, gradient).seconds for chosen in (None, names))
            alone, together = bench.interleaved(15, one, all_)
            what = f"{', '.join(names)} over the image, {'with gradient' if gradient else 'forward'}"
            note = f"{median_time(together)} over {median_time(alone)}, {len(mesh.faces):,} faces at 256² × 16"
            rows.append(ratio_row(what, together, alone, must=most, note=note))
    return rows


# Names of lenses, their projection and coefficients, and the most that a pass may take over that of a pinhole.
LENSES: dict[str, tuple[str, list[float] | None, float | None]] = {
    "a lens of zeros": ("perspective", [0.0, 0.0, 0.0, 0.0], 1.05),
    "a lens with k1": ("perspective", [-0.1, 0.0, 0.0, 0.0], 1.3),
    "a lens with decentring": ("perspective", [-0.1, 0.02, 0.001, -0.002], None),
    "a fisheye": ("fisheye", None, 1.3),
    "a fisheye with k1 to k4": ("fisheye", [-0.05, 0.02, -0.01, 0.002], 1.3),
}


def lenses(bench: Bench) -> list[Row]:
    """Images and steps through lenses that distort, over those of a pinhole."""
    mesh, adjoint = single(icosphere(5)), smooth_channels(3)
    pinhole = front_camera(256)
    cameras = [pinhole] + [
        pinhole.replace(
            projection=projection, distortion=None if values is None else torch.tensor(values, dtype=torch.float64)
        )
        for projection, values, _ in LENSES.values()
    ]

    def image(camera: eg.Camera, spp: int) -> None:
        with torch.no_grad():
            eg.render(mesh, camera, spp)

    def both(camera: eg.Camera, spp: int) -> None:
        verts = mesh.verts.detach().clone().requires_grad_()
        eg.render(mesh.replace(verts=verts), camera, spp).backward(adjoint)

    rows = []
    for spp in (16, 1):
        for what, work in (("image", image), ("image and gradient", both)):
            run = [partial(seconds_of, partial(work, camera, spp)) for camera in cameras]
            straight, *bent = bench.interleaved(21, *run)
            for (name, (_, _, most)), times in zip(LENSES.items(), bent, strict=True):
                note = f"{median_time(times)} over {median_time(straight)}, 20,480 faces at 256² × {spp}"
                must = most if spp == 16 else None
                rows.append(ratio_row(f"{name} over a pinhole, {what}", times, straight, must=must, note=note))
    return rows


def sparse(bench: Bench) -> list[Row]:
    mesh, camera, adjoint = sphere(512)
    window = torch.zeros_like(adjoint)
    window[200:251, 200:251] = adjoint[200:251, 200:251]  # 1 % of the pixels, inside the sphere
    few, all_ = Kernel(mesh, camera, window), Kernel(mesh, camera, adjoint)
    some, dense = bench.interleaved(21, few.backward, all_.backward)
    note = f"{median_time(some)} over {median_time(dense)}, {int(few.profile['surface_samples']):,} surface samples"
    return [ratio_row("loss at 1 % of the image over one at all of it, backward", some, dense, note=note)]
