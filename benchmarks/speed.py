"""How fast edgegrad is, and what it is compared with, against targets: one table.

Run:  python benchmarks/speed.py [--only NAME …] [--quick] [--out FILE.json]

A ratio is taken in one run: its two sides alternate, so that a noisy machine slows both, and what is printed is the median
over the pairs and their quartiles. "At equal error" is the error of the per-vertex gradient relative to the whole gradient,
root mean square over seeds, against a converged run; each side's samples are swept and its time is interpolated. There the
quartiles are those of a bootstrap over the pairs, so that they hold the chance in the errors as well.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import Converged, Kernel, Step, single, sphere
from light import light
from table import HEAD, Bench, Row, Skipped, line, median_row, milliseconds, quartiles, ratio_row, seconds_of
from torch import Tensor
from tqdm import tqdm

import edgegrad as eg
from edgegrad.library import core
from edgegrad.report import build
from edgegrad.report.error_time import mitsuba
from edgegrad.report.error_time.methods import default_samples, differentiate
from edgegrad.report.scenes import ReportScene, cube, front_camera, smooth_adjoint, smooth_colors
from edgegrad.report.scenes import sphere as icosphere

Run = Callable[[float, int], tuple[Tensor, float]]  # (budget, seed) → gradient (V, 3), seconds
FACTORS = tuple(2.0**k for k in range(-6, 7))  # times edgegrad's default samples
SPP = tuple(4.0**k for k in range(6))


@cache
def big() -> Kernel:
    """81,920 faces at 512² × 16."""
    return Kernel(*sphere(512))


@cache
def equal() -> tuple[Kernel, Tensor, Tensor]:
    """81,920 faces at 256², on which errors are measured, and converged gradients of the two terms."""
    kernel = Kernel(*sphere(256))
    return kernel, *kernel.references()


# -- the rows --------------------------------------------------------------------------------------------------------


def forward(bench: Bench) -> list[Row]:
    kernel, (mesh, camera, _) = big(), sphere(512)
    threads = torch.get_num_threads()

    def call() -> None:
        with torch.no_grad():
            eg.render(mesh, camera)

    widths = sorted({8, core.packet_width()})
    loops = [
        lambda n=n: core.for_tests.bare_loop(kernel.scene, kernel.camera, kernel.options, n, threads) for n in widths
    ]
    *bare, inside, whole = bench.interleaved(21, *loops, kernel.forward, lambda: seconds_of(call))
    target: dict[str, Any] = {"must": 0.8, "aim": 0.95, "more_is_better": True}
    rows = []
    for width, loop in zip(widths, bare, strict=True):
        what = f"forward: rays/s over the bare loop, packets of {width}"
        note = f"{512 * 512 * 16 / statistics.median(loop) / 1e6:.1f} M rays/s in the bare loop, {milliseconds(loop)}"
        rows.append(ratio_row(f"{what}, kernel", loop, inside, note=note, **target))
        rows.append(ratio_row(f"{what}, eg.render", loop, whole, note=milliseconds(whole), **target))
    return rows


def backward(bench: Bench) -> list[Row]:
    kernel, (mesh, camera, adjoint) = big(), sphere(512)
    assert mesh.colors is not None
    mesh = mesh.replace(verts=mesh.verts.requires_grad_(), colors=mesh.colors.requires_grad_())
    images: list[Tensor] = []

    def render() -> None:
        mesh.verts.grad = mesh.colors.grad = None
        images[:] = [eg.render(mesh, camera)]

    ahead, back, torch_ahead, torch_back = bench.interleaved(
        21, kernel.forward, lambda: kernel.backward(appearance=True),
        lambda: seconds_of(render), lambda: seconds_of(lambda: images[0].backward(adjoint)),
    )  # fmt: skip
    target: dict[str, Any] = {"must": 0.5, "aim": 0.25}
    return [
        ratio_row("backward over forward, kernel", back, ahead, note=milliseconds(back), **target),
        ratio_row("backward over forward, autograd", torch_back, torch_ahead, note=milliseconds(torch_back), **target),
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
    note = f"{milliseconds(many)} over {milliseconds(few)}"
    return [ratio_row("1.3 M faces: a step over that at 81,920 faces", many, few, must=3, aim=2, note=note)]


def threads(bench: Bench) -> list[Row]:
    kernel = big()
    sides = [lambda n=n: kernel.forward(n) for n in (1, 2)]
    sides += [lambda n=n: kernel.backward(appearance=True, threads=n) for n in (1, 2)]
    one, two, one_back, two_back = bench.interleaved(15, *sides)
    target: dict[str, Any] = {"must": 1.8, "aim": 1.95, "more_is_better": True}
    return [
        ratio_row("2 threads over 1, forward", one, two, note=f"{milliseconds(one)} over {milliseconds(two)}", **target),
        ratio_row(
            "2 threads over 1, backward", one_back, two_back,
            note=f"{milliseconds(one_back)} over {milliseconds(two_back)}", **target,
        ),
    ]  # fmt: skip


def memory(bench: Bench) -> list[Row]:
    peaks = [fresh("memory")["bytes"] / 1e6 for _ in range(1 if bench.quick else 2)]
    what = "peak memory above scene and images, 1920 × 1080 × 64 spp"
    return [median_row(what, peaks, unit=" MB", must=150, aim=50)]


def start(bench: Bench) -> list[Row]:
    n = bench.repeats(5)
    imports, cubes, spheres = [], [], []
    for turn in range(n):
        bench.bar.set_postfix_str(f"{turn} of {n}")
        imports.append(fresh("import")["seconds"])
        cubes.append(fresh("first", "cube"))
        spheres.append(fresh("first", "sphere"))
    rows = [median_row("import edgegrad, after torch", imports, unit=" s", must=0.3, aim=0.1)]
    for name, found in (("cube at 64²", cubes), ("sphere at 512²", spheres)):
        first, moved, same = ([run[key] for run in found] for key in ("first", "moved", "same"))
        note = f"{milliseconds(first)}; later {milliseconds(moved)}, where nothing moved {milliseconds(same)}"
        rows.append(ratio_row(f"first render of a process over a later one, {name}", first, moved, must=1.5, note=note))
    return rows


def fresh(*arguments: str) -> dict[str, float]:
    """What fresh.py measures in a process of its own."""
    command = [sys.executable, str(Path(__file__).with_name("fresh.py")), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
    return json.loads(done.stdout)


def order(bench: Bench) -> list[Row]:
    """A step where torch was imported first, over one where edgegrad was: alone, and beside two busy processes."""
    rows = []
    for load in (0, 2):
        busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(load)]
        try:
            ours, theirs = bench.interleaved(4, lambda: fresh("steps", "edgegrad"), lambda: fresh("steps", "torch"))
        finally:
            for process in busy:
                process.kill()
        for key, name in (("median", "median"), ("slow", "90 % quantile")):
            first, second = ([run[key] for run in side] for side in (ours, theirs))
            what = f"a step, torch imported first over edgegrad first, {name}" + (", machine busy" if load else "")
            rows.append(ratio_row(what, second, first, note=f"{milliseconds(second)} over {milliseconds(first)}"))
    return rows


def bits(bench: Bench) -> list[Row]:
    kernel = big()
    found = []
    for n in (1, 2):
        kernel.forward(n), kernel.backward(appearance=True, threads=n)
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
    """The image of a sphere, or channels beside it, and perhaps the gradient of all of them by the vertices."""

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
            note = f"{milliseconds(together)} over {milliseconds(alone)}, {len(mesh.faces):,} faces at 256² × 16"
            rows.append(ratio_row(what, together, alone, must=most, note=note))
    return rows


def sparse(bench: Bench) -> list[Row]:
    mesh, camera, adjoint = sphere(512)
    window = torch.zeros_like(adjoint)
    window[200:251, 200:251] = adjoint[200:251, 200:251]  # 1 % of the pixels, inside the sphere
    few, all_ = Kernel(mesh, camera, window), Kernel(mesh, camera, adjoint)
    some, dense = bench.interleaved(21, few.backward, all_.backward)
    note = f"{milliseconds(some)} over {milliseconds(dense)}, {int(few.profile['surface_samples']):,} surface samples"
    return [ratio_row("loss at 1 % of the image over one at all of it, backward", some, dense, note=note)]


def deep(bench: Bench) -> list[Row]:
    _, camera, adjoint = sphere(512)
    outer = single(icosphere(5))
    nested = eg.Scene([outer.replace(verts=outer.verts * (1.0 - 0.04 * k)) for k in range(20)])
    one, twenty = Kernel(outer, camera, adjoint), Kernel(nested, camera, adjoint)
    alone, all_ = bench.interleaved(11, one.backward, twenty.backward)
    note = f"{milliseconds(all_)} over {milliseconds(alone)}, 20,480 faces each"
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
    error: dict[str, float] | None = None,
    over_image: dict[str, float] | None = None,
    milliseconds: dict[str, float] | None = None,
) -> list[Row]:
    """A step at default settings as a user writes it, after the vertices moved: the backward pass beside the image of 16 samples
    a pixel, and the error of the per-vertex gradient. Each is a row; those that have a target say so."""
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
        gradients.append(gradient), ahead.append(image_seconds), back.append(1e3 * backward_seconds)
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


# -- at equal error --------------------------------------------------------------------------------------------------


class Side:
    """One side of a comparison: the two budgets around the wanted error, and what was measured at them."""

    def __init__(self, run: Run, budgets: Sequence[float], per_turn: int) -> None:
        self.run, self.budgets, self.per_turn = run, budgets, per_turn
        self.reached = False
        # Of each turn, by budget: the mean squared error, and the median of the seconds.
        self.squares: dict[float, list[float]] = {}
        self.seconds: dict[float, list[float]] = {}

    def measure(self, budget: float, seeds: Sequence[int], error: Callable[[Tensor], float]) -> None:
        runs = [self.run(budget, seed) for seed in seeds]
        self.squares.setdefault(budget, []).append(statistics.fmean(error(gradient) ** 2 for gradient, _ in runs))
        self.seconds.setdefault(budget, []).append(statistics.median(seconds for _, seconds in runs))

    def rms(self, budget: float, turns: Sequence[int] | None = None) -> float:
        squares = self.squares[budget]
        return math.sqrt(statistics.fmean(squares if turns is None else [squares[turn] for turn in turns]))

    def bracket(self, wanted: float, error: Callable[[Tensor], float], limit: float) -> None:
        """Upwards until the error is below the wanted one or the next budget would take longer than `limit` seconds."""
        tried: list[float] = []
        for budget in self.budgets:
            # Time grows at most in proportion to the budget, as there are costs that do not depend on it.
            if tried and self.seconds[tried[-1]][0] * budget / tried[-1] > limit:
                break
            tried.append(budget)
            self.run(budget, 1000)  # warm
            self.measure(budget, range(1001, 1001 + max(3, self.per_turn)), error)
            if self.rms(budget) < wanted:
                self.reached = True
                break
        self.budgets = tried[-2:]
        self.squares, self.seconds = {}, {}

    def at(self, wanted: float, turns: Sequence[int]) -> tuple[list[float], float]:
        """Seconds of each turn and the budget at the wanted error, log-log between the two budgets."""
        low, high = self.budgets[0], self.budgets[-1]
        w = 1.0
        if low != high and self.reached:
            w = math.log(self.rms(low, turns) / wanted) / math.log(self.rms(low, turns) / self.rms(high, turns))
            w = min(max(w, -0.5), 1.5)  # chance may put the wanted error a little outside
        times = [self.seconds[low][turn] ** (1 - w) * self.seconds[high][turn] ** w for turn in turns]
        return times, low ** (1 - w) * high**w


def equal_error(
    bench: Bench,
    what: str,
    wanted: float,
    part: Tensor,
    ours: Side,
    theirs: Side,
    turns: int,
    unit: str,
    samples: str = "its default samples",
    **target: float,
) -> list[Row]:
    """How many times longer `theirs` takes to the wanted error of `part` of the gradient."""
    _, inside, edges = equal()
    norm = float((inside + edges).norm())

    def error(gradient: Tensor) -> float:
        return float((gradient - part).norm()) / norm

    for name, side in (("edgegrad", ours), ("the other", theirs)):
        bench.bar.set_postfix_str(f"samples of {name}")
        side.bracket(wanted, error, bench.limit)
    if not ours.reached:
        raise Skipped(f"edgegrad does not come to {100 * wanted:g} % within {bench.limit:g} s")
    n = bench.repeats(turns)
    for turn in range(n):
        bench.bar.set_postfix_str(f"{turn} of {n}")
        for side in (ours, theirs):
            for budget in side.budgets:
                side.measure(budget, range(turn * side.per_turn, (turn + 1) * side.per_turn), error)

    def ratio(chosen: Sequence[int]) -> float:
        pairs = zip(theirs.at(wanted, chosen)[0], ours.at(wanted, chosen)[0], strict=True)
        return statistics.median(a / b for a, b in pairs)

    every, chance = range(n), np.random.default_rng(0)
    spread = quartiles([ratio(chance.integers(n, size=n).tolist()) for _ in range(400)])
    (times, budget), (other_times, other_budget) = ours.at(wanted, every), theirs.at(wanted, every)
    note = f"edgegrad × {budget:.2g} of {samples}, {milliseconds(times)}; {other_budget:.3g} {unit}"
    note += f", {milliseconds(other_times)}"
    if not theirs.reached:
        note += f", where its error is still {100 * theirs.rms(theirs.budgets[-1]):.2g} %"
    return [Row(what, ratio(every), spread, more_is_better=True, bound=not theirs.reached, note=note, **target)]


def against_mitsuba(**terms: bool) -> mitsuba.Mitsuba:
    if mitsuba.available() is None:
        raise Skipped("Mitsuba is not installed or finds no LLVM; pip install 'edgegrad[peers]' and libLLVM")
    mesh, camera, adjoint = sphere(256)
    return mitsuba.Mitsuba(eg.Scene([mesh]), camera, adjoint, "prb_projective", **terms)


def step(bench: Bench) -> list[Row]:
    peer = against_mitsuba()
    kernel, inside, edges = equal()
    surface, edge = kernel.default_samples()
    one = Step(*sphere(256))

    def ours(factor: float, seed: int) -> tuple[Tensor, float]:
        # So few samples inside faces are enough at 3 %: less time at that error, as Mitsuba's SPLIT is for it.
        return one(surface_samples=round(factor / 4 * surface), edge_samples=round(factor * edge), grad_seed=seed)

    def theirs(spp: float, seed: int) -> tuple[Tensor, float]:
        (gradient,), seconds = peer.gradient(spp, seed)
        return gradient, seconds

    what = "a step at 3 % error: Mitsuba's prb_projective over edgegrad"
    return equal_error(
        bench, what, 0.03, inside + edges, Side(ours, FACTORS, 5), Side(theirs, SPP, 1), 8, "spp",
        "its default samples (a quarter of that inside faces)", must=30, aim=100,
    )  # fmt: skip


def interior(bench: Bench) -> list[Row]:
    kernel, inside, _ = equal()
    surface, _ = kernel.default_samples()
    verts = torch.zeros_like(inside)

    def ours(factor: float, seed: int) -> tuple[Tensor, float]:
        return kernel.gradient(round(factor * surface), -1, seed, boundary=False)

    def theirs(spp: float, seed: int) -> tuple[Tensor, float]:
        # The forward pass again, and the shading differentiated at each hit. The seconds are those of its pixel loop and of
        # adding up; not of what the kernel sets up around it and this estimator does not need.
        image = core.ImageOptions(spp=round(spp), filter="box", seed=seed)
        seconds = core.for_tests.pixel_backward(
            kernel.scene, kernel.camera, image, torch.get_num_threads(), kernel.adjoint.numpy(), verts.zero_().numpy()
        )
        return verts.clone(), seconds

    what = "interior at 2 % error: differentiated pixel samples over edgegrad"
    sides = Side(ours, FACTORS, 3), Side(theirs, tuple(2.0**k for k in range(11)), 3)
    return equal_error(bench, what, 0.02, inside, *sides, 12, "spp", must=3, aim=10)


def boundary(bench: Bench) -> list[Row]:
    peer = against_mitsuba(interior=False)
    # Both sides without the update after vertices moved: without a term, this is all that the adaptor does.
    nothing = against_mitsuba(interior=False, boundary=False)
    updating = statistics.median(nothing.gradient(1, 0)[1] for _ in range(5))
    kernel, _, edges = equal()
    _, edge = kernel.default_samples()

    def ours(factor: float, seed: int) -> tuple[Tensor, float]:
        return kernel.gradient(-1, round(factor * edge), seed, interior=False)

    def theirs(spp: float, seed: int) -> tuple[Tensor, float]:
        (gradient,), seconds = peer.gradient(mitsuba.SPLIT * spp, seed, primal_spp=1)
        return gradient, seconds - updating

    what = "boundary at 1.7 % error: Mitsuba's boundary term over edgegrad's"
    sides = Side(ours, FACTORS, 5), Side(theirs, SPP, 1)
    return equal_error(bench, what, 0.017, edges, *sides, 8, "boundary spp", must=100, aim=300)


ROWS: dict[str, Callable[[Bench], list[Row]]] = {
    "forward": forward,
    "backward": backward,
    "update": update,
    "step": step,
    "interior": interior,
    "boundary": boundary,
    "cube": small,
    "large": large,
    "threads": threads,
    "memory": memory,
    "start": start,
    "order": order,
    "bits": bits,
    "textures": textures,
    "aovs": aovs,
    "sparse": sparse,
    "deep": deep,
    "tangled": tangled,
    "flat-colors": flat_colors,
    "noise": noise,
    "light": light,
}
# What is slow or wrong in the scenes of others first: rows that a change of the default samples is measured by.
GROUPS = {"safe": ("deep", "tangled", "flat-colors", "noise")}
CONVERGED = Path(__file__).resolve().parents[1] / "out" / "converged"


def settings(quick: bool) -> dict[str, Any]:
    """Where and of what this was measured."""
    return {
        "date": time.strftime("%Y-%m-%d %H:%M:%S"), "quick": quick, "threads": torch.get_num_threads(),
        "cores": os.cpu_count(), "load": os.getloadavg()[0], "system": platform.platform(),
        "python": platform.python_version(), "torch": torch.__version__,
        "edgegrad": eg.__version__, "mitsuba": mitsuba.available(),
        "kernel": kernel_hash(),
    }  # fmt: skip


def kernel_hash() -> str:
    return hashlib.sha256(Path(core.__file__).read_bytes()).hexdigest()[:12]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = [*ROWS, *GROUPS]
    parser.add_argument("--only", nargs="+", choices=known, metavar="NAME", help=f"some of {', '.join(known)}")
    parser.add_argument("--quick", action="store_true", help="few repeats")
    parser.add_argument(
        "--limit", type=float, default=10.0, metavar="SECONDS", help="most that a gradient may take (10)"
    )
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="the table, with notes and where it was measured")
    args = parser.parse_args()
    rows: list[Row] = []
    skipped: dict[str, str] = {}
    only = [name for given in args.only or ROWS for name in GROUPS.get(given, (given,))]
    names = [name for name in ROWS if name in only]
    tqdm.write(line(HEAD))
    with tqdm(total=len(names), unit="row", dynamic_ncols=True, disable=None) as bar:
        bench = Bench(args.quick, args.limit, bar)
        for name in names:
            bar.set_description(name)
            try:
                found = ROWS[name](bench)
            except Skipped as reason:
                skipped[name] = str(reason)
                tqdm.write(f"{name}: skipped; {reason}")
                found = []
            for row in found:
                rows.append(row)
                tqdm.write(line(row.cells()) + (f"\n    {row.note}" if row.note else ""))
            bar.update()
            if args.out is not None:  # after each row, so that Ctrl-C loses none
                document = {"settings": settings(args.quick), "rows": [asdict(r) for r in rows], "skipped": skipped}
                args.out.parent.mkdir(parents=True, exist_ok=True)
                args.out.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
