"""A step at default settings on scenes that others have: nested, tangled, flat colours, a noisy loss."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

import torch

import edgegrad as eg

from .common import Converged, Kernel, single, sphere
from .document import kernel_hash
from .error_time.methods import default_samples, differentiate
from .scenes import ReportScene, build, icosphere
from .table import Bench, Row, median_row, median_time, quartiles, ratio_row

CONVERGED = Path(__file__).resolve().parents[1] / "out" / "converged"


def deep(bench: Bench) -> list[Row]:
    _, camera, adjoint = sphere(512)
    outer = single(icosphere(5))
    nested = eg.Scene([outer.replace(verts=outer.verts * (1.0 - 0.04 * k)) for k in range(20)])
    one, twenty = Kernel(outer, camera, adjoint), Kernel(nested, camera, adjoint)
    alone, all_ = bench.interleaved(11, one.backward, twenty.backward)
    note = f"{median_time(all_)} over {median_time(alone)}, 20,480 faces each"
    return [ratio_row("20 nested spheres over the outer one, backward", all_, alone, must=2, note=note)]


def tangled(bench: Bench) -> list[Row]:
    rows = []
    for noise in (0.03, 0.1):
        what = f"tangled sphere, {100 * noise:g} % noise"
        rows += default_step(bench, what, build("tangled", noise=noise), over_image={"must": 1.5})
    return rows


def flat_colors(bench: Bench) -> list[Row]:
    many, few = build("flat-colors"), build("flat-colors", subdivisions=4)
    return [
        *default_step(
            bench, "81,920 flat colours", many, error={"must": 1.0}, over_image={"must": 0.8, "aim": 0.4}
        ),
        *default_step(bench, "5,120 flat colours", few, error={"must": 0.5}, milliseconds={"must": 15}),
    ]  # fmt: skip


def noise(bench: Bench) -> list[Row]:
    rows = []
    for subdivisions in (3, 6):
        scene = build("noise", subdivisions=subdivisions)
        what = f"white-noise adjoint, {scene.faces:,} faces"
        rows += default_step(bench, what, scene, error={"must": 8.0}, over_image={"must": 1.0})
    return rows


def default_step(
    bench: Bench,
    what: str,
    scene: ReportScene,
    *,
    error: dict[str, Any] | None = None,
    over_image: dict[str, Any] | None = None,
    milliseconds: dict[str, Any] | None = None,
) -> list[Row]:
    """Measure a step with default settings, after the vertices moved.

    The rows are the backward pass relative to the image of 16 samples a pixel, its time, and the error of the gradient of
    vertices. `error`, `over_image` and `milliseconds` are their targets.
    """
    bench.bar.set_postfix_str("converged gradient")
    correct = Converged(scene, CONVERGED, kernel_hash())
    elsewhere = scene.moved((scene.verts * 1.001).float())
    gradients, ahead, back = [], [], []
    n = bench.repeats(9)
    for turn in range(n + 1):
        bench.bar.set_postfix_str(f"{turn} of {n}")
        with torch.no_grad():
            eg.render(elsewhere, scene.camera, spp=1)
        gradient, image_seconds, backward_seconds = differentiate(scene, spp=16, seed=turn)
        gradients.append(gradient)
        ahead.append(image_seconds)
        back.append(1e3 * backward_seconds)
    ratios = [a / (1e3 * b) for a, b in zip(back[1:], ahead[1:], strict=True)]
    surface, edge = default_samples(scene.scene, scene.camera, scene.adjoint)
    times = f"{statistics.median(back[1:]):.3g} ms over {1e3 * statistics.median(ahead[1:]):.3g} ms"
    counts = f"{surface:,} surface and {edge:,} edge samples"
    own = f"converged: ± {100 * correct.own_error:.2g} %, by kernel {correct.made_by}"
    each = [100.0 * correct.error([gradient]) for gradient in gradients]
    return [
        median_row(f"{what}: backward over image", ratios, note=times, **(over_image or {})),
        median_row(f"{what}: backward", back[1:], unit=" ms", **(milliseconds or {})),
        Row(
            f"{what}: error", 100.0 * correct.error(gradients), quartiles(each), " %",
            note=f"{counts}; {own}", **(error or {}),
        ),
    ]  # fmt: skip
