"""Adam and Gauss-Newton on the same fits: steps and seconds until the loss is within a third of the better end.

    python -m benchmarks.fit_methods

The pose of a lit mesh (6 numbers), a sun and eight colours (27), a camera and a roughness (7): of tests/fit/small_fits.py.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import small_fits
import torch

import edgegrad as eg
from edgegrad.fit.descent.fit_scene import Progress

PROBLEMS = {
    "pose": small_fits.pose, "light and colours": small_fits.light_and_colors,
    "camera and material": small_fits.camera_and_material,
}  # fmt: skip
NEAR = 4 / 3


def followed(problem: Callable[[], small_fits.Problem], method: str) -> list[tuple[float, float]]:
    """Seconds of processor time, and the loss against pictures without noise, after each step and at the end."""
    given = problem()
    found, spent = [], 0.0
    began = time.process_time()

    def look(progress: Progress) -> None:
        nonlocal spent, began
        spent += time.process_time() - began
        found.append((spent, loss(progress.scene, progress.cameras)))
        began = time.process_time()

    def loss(scene: eg.Scene, cameras: list[eg.Camera]) -> float:
        with torch.no_grad():
            renders = [eg.render(scene, camera, 64, 99) for camera in cameras]
        targets = given.targets or []
        return sum(float((a - b).square().mean()) for a, b in zip(renders, targets, strict=True)) / len(renders)

    fit = given.fit(method=method, callback=look)
    spent += time.process_time() - began
    found.append((spent, loss(fit.scene, fit.cameras)))
    return found


def main() -> None:
    small_fits.pose().fit(method="gauss-newton", steps=1)  # torch loads its rules of forward mode, for some seconds
    print("problem               method         steps  seconds  steps in all  seconds in all")
    for name, problem in PROBLEMS.items():
        ways = {method: followed(problem, method) for method in ("adam", "gauss-newton")}
        enough = NEAR * min(way[-1][1] for way in ways.values())
        for method, way in ways.items():
            reached = next((k for k, (_, loss) in enumerate(way) if loss <= enough), None)
            steps, seconds = ("—", math.nan) if reached is None else (min(reached + 1, len(way) - 1), way[reached][0])
            print(f"{name:21} {method:13} {steps:>6} {seconds:8.1f} {len(way) - 1:13} {way[-1][0]:15.1f}", flush=True)


if __name__ == "__main__":
    main()
