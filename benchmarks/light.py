"""Lit scenes: images and gradients over those without light, and samples on the borders of shadows alone."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

import edgegrad as eg
from edgegrad.kernel.request import make_request
from edgegrad.library import core
from edgegrad.light.radiance import Lighting
from edgegrad.points.image_context import ImageContext
from edgegrad.shader import ShadingTraits, UserShader, _Image

from .common import Kernel, parts
from .scenes import ReportScene, build
from .table import Bench, Row, median_time, ratio_row, seconds_of

# Samples on the borders of shadows.
COUNTS = {
    kind: tuple(1 << k for k in range(8, most + 1, 2)) for kind, most in (("point", 18), ("area", 20), ("sky", 18))
}
CONVERGED = 1 << 20
WANTED = {"point": 3.0, "area": 3.0, "sky": 5.0}  # errors, in percent
OVER_IMAGE: dict[str, dict[str, Any]] = {
    "point": {"must": 0.5, "aim": 0.2},
    "area": {"must": 5, "aim": 2},
    "sky": {"aim": 10},
}
SLOPES: dict[str, dict[str, Any]] = {"point": {"must": -0.9, "aim": -1}, "area": {"must": -0.6, "aim": -0.75}}


def light(bench: Bench) -> list[Row]:
    return [*images(bench), *(row for kind in ("point", "area", "sky") for row in shadow_boundaries(bench, kind))]


def images(bench: Bench) -> list[Row]:
    """Time images and gradients of a textured globe under two punctual lights."""
    globe = build("globe", 512, rows=143)
    (mesh,) = globe.scene.meshes
    lights = [
        eg.lights.PointLight(torch.tensor([2.0, 3.0, 2.5]), 30.0),
        eg.lights.DirectionalLight(torch.tensor([0.5, -1.0, -0.6]), 2.0),
    ]
    unlit, lit = eg.Scene([mesh]), eg.Scene([mesh.replace(material=eg.Material())], lights=lights)
    kernel = Kernel(mesh, globe.camera, globe.adjoint)
    threads = torch.get_num_threads()
    packet = core.packet_width()
    hit = float((eg.render_aovs(mesh, globe.camera, ["alpha"], 16)["alpha"]).mean())

    def image(scene: eg.Scene, **options: Any) -> Callable[[], float]:
        def call() -> None:
            with torch.no_grad():
                eg.render(scene, globe.camera, **options)

        return lambda: seconds_of(call)

    images: list[Tensor] = []
    leaves = [mesh.verts.detach().clone().requires_grad_(), mesh.texture.detach().clone().requires_grad_()]  # type: ignore[union-attr]
    powers = [torch.tensor(power, requires_grad=True) for power in (30.0, 2.0)]

    def whole() -> None:
        moved = mesh.replace(verts=leaves[0], texture=leaves[1], material=eg.Material())
        shining = [kind.replace(intensity=power) for kind, power in zip(lights, powers, strict=True)]
        images[:] = [eg.render(eg.Scene([moved], lights=shining), globe.camera)]

    bare, plain, open_, shadowed, ahead, back = bench.interleaved(
        9, lambda: parts.bare_loop(kernel.scene, kernel.camera, kernel.options, packet, threads),
        image(unlit), image(lit, shadows=False), image(lit), lambda: seconds_of(whole),
        lambda: seconds_of(lambda: torch.autograd.backward(images[0], globe.adjoint, inputs=[*leaves, *powers])),
    )  # fmt: skip
    rays = [seconds * (1.0 + 2.0 * hit) for seconds in bare]
    faces = f"{len(mesh.faces):,} faces at 512² × 16"
    # A gradient's samples are shaded with a graph ahead of the backward pass: its cost is both, less the image.
    gradient = [a + b - c for a, b, c in zip(ahead, back, shadowed, strict=True)]
    return [
        ratio_row(
            "lit by two punctual lights without shadows over unlit, image", open_, plain, must=2, aim=1.5,
            note=f"{median_time(open_)} over {median_time(plain)}, {faces}",
        ),
        ratio_row(
            "the same with shadows over the bare rays, three a sample that hits", shadowed, rays, must=1.6, aim=1.25,
            note=f"{median_time(shadowed)} over {median_time(rays)}, a surface is shaded about once a pixel",
        ),
        ratio_row(
            "lit with shadows, all gradients: backward pass over image", back, shadowed, must=1.0, aim=0.6,
            note=f"{median_time(back)} over {median_time(shadowed)}",
        ),
        ratio_row(
            "the same with what a gradient adds to the forward pass, over image", gradient, shadowed, must=1.0, aim=0.6,
            note=f"{median_time(gradient)} over {median_time(shadowed)}",
        ),
    ]  # fmt: skip


class ShadowBoundaries(_Image):
    """The image with samples on shadow boundaries alone."""

    def render(self) -> Tensor:
        image = self._values()
        begin = time.perf_counter()
        found = self._context.attached(image, self._shadows())
        self.seconds = time.perf_counter() - begin
        return found


def shadow_gradient(scene: ReportScene, count: int, seed: int) -> tuple[Tensor, float]:
    """Return the shadow term (V, 3), float64, from `count` samples (−1: default), and its seconds without the image."""
    verts = scene.verts.float().requires_grad_()
    moved = scene.moved(verts)
    request = make_request(
        moved, scene.camera, 16, 0, sampling=eg.Sampling(edges=None if count < 0 else count, seed=seed)
    )
    image = ShadowBoundaries(
        ImageContext(moved, request, 0),
        UserShader(Lighting(True, 1)),
        False,
        ShadingTraits(keeps_little=True, additive=True),
    )
    found = image.render()
    begin = time.perf_counter()
    (gradient,) = torch.autograd.grad((found * scene.adjoint).sum(), verts)
    return gradient.double(), image.seconds + time.perf_counter() - begin


def shadow_boundaries(bench: Bench, kind: str) -> list[Row]:
    """Compare the time of the term, at a given error, with that of the image; and measure how the error falls with samples."""
    scene = build(f"lit-{kind}", 256)
    wanted = WANTED[kind] / 100.0
    runs, most = (2, CONVERGED // 4) if bench.quick else (4, CONVERGED)
    correct = torch.stack([shadow_gradient(scene, most, (1 << 40) + k)[0] for k in range(runs)]).mean(0)
    norm = float(correct.norm())

    def image() -> None:
        with torch.no_grad():
            eg.render(scene.scene, scene.camera)

    n = bench.repeats(9)
    image()
    shadow_gradient(scene, 256, 0)
    ahead = statistics.median(seconds_of(image) for _ in range(n))
    errors, seconds = [], []
    counts = COUNTS[kind][:-1] if bench.quick else COUNTS[kind]
    for count in (*counts, -1):
        bench.bar.set_postfix_str(f"{kind}, {count} samples")
        found = [shadow_gradient(scene, count, seed) for seed in range(n)]
        errors.append(math.sqrt(statistics.fmean(float((g - correct).norm() / norm) ** 2 for g, _ in found)))
        seconds.append(statistics.median(s for _, s in found))
    error, time_ = errors.pop(), seconds.pop()
    slope = float(np.polyfit(np.log(counts), np.log(errors), 1)[0])
    rows = [
        Row(
            f"shadow of a {kind} light: its term at default samples over the image", time_ / ahead,
            note=f"{1e3 * time_:.3g} ms over {1e3 * ahead:.3g} ms; error {100 * error:.2g} %",
        ),
        Row(f"shadow of a {kind} light: slope of the error by samples", slope, **SLOPES.get(kind, {})),
    ]  # fmt: skip
    if min(errors) > wanted:
        note = f"{100 * min(errors):.2g} % with {counts[-1]:,} samples in {1e3 * seconds[-1]:.3g} ms"
        what = f"shadow of a {kind} light: {100 * wanted:g} % over the image"
        return [Row(what, seconds[-1] / ahead, bound=True, note=note), *rows]
    at = float(np.exp(np.interp(-math.log(wanted), -np.log(errors), np.log(seconds))))
    many = float(np.exp(np.interp(-math.log(wanted), -np.log(errors), np.log(counts))))
    what = f"shadow of a {kind} light: its term at {100 * wanted:g} % over the image"
    note = f"{1e3 * at:.3g} ms over {1e3 * ahead:.3g} ms, {many:,.0f} samples"
    return [Row(what, at / ahead, note=note, **OVER_IMAGE[kind]), *rows]
