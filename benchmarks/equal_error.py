"""How many times longer others take to the same error of the per-vertex gradient."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

import edgegrad as eg
from edgegrad.library import core

from . import mitsuba
from .common import Kernel, Step, parts, sphere
from .table import Bench, Row, Skipped, median_time, quartiles

Run = Callable[[float, int], tuple[Tensor, float]]  # (budget, seed) → gradient (V, 3), seconds
FACTORS = tuple(2.0**k for k in range(-6, 7))  # times edgegrad's default samples
SPP = tuple(4.0**k for k in range(6))


@cache
def equal() -> tuple[Kernel, Tensor, Tensor]:
    """81,920 faces at 256², on which errors are measured, and converged gradients of the two terms."""
    kernel = Kernel(*sphere(256))
    return kernel, *kernel.references()


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
    **target: Any,
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
    note = f"edgegrad × {budget:.2g} of {samples}, {median_time(times)}; {other_budget:.3g} {unit}"
    note += f", {median_time(other_times)}"
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
        return one(sampling=eg.Sampling(surface=round(factor / 4 * surface), edges=round(factor * edge), seed=seed))

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
        seconds = parts.pixel_backward(
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
