"""Errors of image and gradient of a case against its reference, and the verdict."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from oracles.exact import one_thread
from torch import Tensor

from edgegrad.render import render

from ...supersampling import supersampled
from .case import Case, Parts, Problem

TOLERANCE = 0.02  # what may be missing, beyond four standard errors
NOISE = 0.01  # a larger standard error is too much to decide
RIGHT, LIMIT, WRONG, NOISY, RAISED = "right", "limit", "wrong", "too noisy to decide", "error raised"


@dataclass(frozen=True)
class Effort:
    """Numbers of seeds, which grow until the standard error of everything is below `noise`."""

    seeds: tuple[int, ...] = (8, 32, 128, 512)
    noise: float = 0.004
    difference_seeds: tuple[int, ...] = (8,)  # of finite differences, for each part by itself
    difference_spp: int = 2048
    seconds: float = 30.0  # no more seeds after that

    def up_to(self, more: int) -> Effort:
        """Return an effort with `more` times as many seeds at most."""
        if more == 1:
            return self
        seeds, differences = ((*n, more * n[-1]) for n in (self.seeds, self.difference_seeds))
        return replace(self, seeds=seeds, difference_seeds=differences)


QUICK = Effort(seeds=(4, 16, 64), noise=0.009, difference_seeds=(4,), difference_spp=1024, seconds=6.0)


class Estimate(NamedTuple):
    mean: Tensor
    error: float  # standard error of the mean, all components together


class Running:
    """Mean and variance of tensors that come one by one (Welford)."""

    def __init__(self) -> None:
        self.count, self.mean, self.squares = 0, torch.zeros(()), torch.zeros(())

    def add(self, value: Tensor) -> None:
        value = value.detach().double()
        self.count += 1
        delta = value - self.mean
        self.mean = self.mean + delta / self.count
        self.squares = self.squares + delta * (value - self.mean)

    def estimate(self) -> Estimate:
        return Estimate(self.mean, float((self.squares.sum() / (self.count - 1) / self.count).sqrt()))


def measure(case: Case, effort: Effort) -> dict[str, Any]:
    """Return the row of a case as data. An error that it raises becomes its verdict."""
    begin = time.perf_counter()
    row: dict[str, Any] = {"group": case.group, "name": case.name, "extreme": case.extreme}
    try:
        effort = replace(effort, seeds=tuple(n for n in effort.seeds if n <= case.seeds))
        row |= compare(case.build(), effort.up_to(case.more))
        row["verdict"], row["worst"] = verdict(row, case)
    except (ValueError, TypeError) as error:
        row |= {"verdict": RAISED, "raised": f"{type(error).__name__}: {error}"}
    if case.limit:
        row["limit"] = case.limit
    row["seconds"] = time.perf_counter() - begin
    return row


def compare(problem: Problem, effort: Effort) -> dict[str, Any]:
    """Return relative errors of the image and of the gradient of each part, with the standard errors of both sides."""
    wanted_image, wanted = reference(problem, effort)
    begin = time.perf_counter()
    background = problem.make(problem.parts)[0].background
    # What the scene adds to its background is what an image can get wrong.
    behind = 0.0 if background is None or problem.faint else background.double()
    contrast = float((wanted_image - behind).norm())
    adjoint = float(problem.cotangent(wanted_image).norm())
    image, grads = Running(), {name: Running() for name in problem.parts}
    row: dict[str, Any] = {}
    for seeds in effort.seeds:
        for seed in range(image.count, seeds):
            one, gradient = sample(problem, seed)
            image.add(one)
            for name, value in gradient.items():
                grads[name].add(value)
        row = {
            "reference": problem.reference, "seeds": seeds, "steps": problem.steps,
            "image": _relative(image.estimate(), Estimate(wanted_image, 0.0), contrast),
            "parts": {
                name: _relative(
                    run.estimate(), wanted[name], float(wanted[name].mean.norm()), problem.zero * adjoint, adjoint
                )
                for name, run in grads.items()
            },
        }  # fmt: skip
        noise = max(entry["noise"] for entry in (row["image"], *row["parts"].values()))
        if noise < effort.noise or time.perf_counter() - begin > effort.seconds:
            break
    return row


def _relative(found: Estimate, wanted: Estimate, size: float, zero: float = 0.0, unit: float = 1.0) -> dict[str, float]:
    """Return errors relative to `size`, that of the reference, or to `unit` where the size is at most `zero`."""
    scale = size if size > zero else unit
    return {
        "error": float((found.mean - wanted.mean).norm()) / scale,
        "noise": (found.error**2 + wanted.error**2) ** 0.5 / scale,
        "size": size,
    }


def verdict(row: dict[str, Any], case: Case) -> tuple[str, str]:
    """Return the verdict and the quantity that decides it."""
    entries = {"image": row["image"], **row["parts"]}
    worst = max(entries, key=lambda name: entries[name]["error"] - 4.0 * entries[name]["noise"])
    off = [e["error"] - 4.0 * e["noise"] - TOLERANCE for e in entries.values()]
    if not all(x <= 0.0 for x in off):  # NaN is wrong too
        limited = case.limit and max(entry["error"] for entry in entries.values()) <= case.most
        return (LIMIT if limited else WRONG), worst
    noisiest = max(entries, key=lambda name: entries[name]["noise"])
    if not entries[noisiest]["noise"] <= NOISE:
        return NOISY, noisiest
    return RIGHT, worst


def worst_part(row: dict[str, Any]) -> tuple[str, dict[str, float]]:
    """Return the part of the gradient with the largest error, and its errors."""
    return max(row["parts"].items(), key=lambda item: item[1]["error"])


def sample(problem: Problem, seed: int, **options: Any) -> tuple[Tensor, Parts]:
    """Return image and gradient from one seed."""
    leaves = {name: value.detach().clone().requires_grad_() for name, value in problem.parts.items()}
    image = render(*problem.make(leaves), **{"spp": problem.spp, "seed": seed, **problem.options, **options})
    adjoint = problem.cotangent(image).to(image.dtype)
    grads = torch.autograd.grad(image, list(leaves.values()), adjoint, materialize_grads=True)
    return image, dict(zip(leaves, grads, strict=True))


def reference(problem: Problem, effort: Effort) -> tuple[Tensor, dict[str, Estimate]]:
    """Return the correct image and gradients."""
    if problem.exact is None:
        return by_differences(problem, effort)
    image, grads = exact(problem, problem.exact)
    return image, {name: Estimate(value, 0.0) for name, value in grads.items()}


def exact(problem: Problem, integrals: Callable[[Parts], Tensor]) -> tuple[Tensor, Parts]:
    leaves = {name: value.detach().double().requires_grad_() for name, value in problem.parts.items()}
    with one_thread():
        image = integrals(leaves)
        loss = (image * problem.cotangent(image)).sum()
        grads = torch.autograd.grad(loss, list(leaves.values()), materialize_grads=True)
    return image.detach(), dict(zip(leaves, grads, strict=True))


def by_differences(problem: Problem, effort: Effort) -> tuple[Tensor, dict[str, Estimate]]:
    """The image of problem.image(); gradients by central differences of the forward renderer, common random numbers, h and h/2.

    The value is that of h; the distance to that of h/2, where chance does not explain it, counts as its error.
    """
    image = problem.image(*(problem.equal or problem.make)(problem.parts))
    adjoint = problem.cotangent(image)
    found = {}
    for name, value in problem.parts.items():
        whole, half = (differences(problem, adjoint, name, scale, effort).estimate() for scale in (1.0, 0.5))
        apart = float((whole.mean - half.mean).norm())
        error = whole.error if apart <= 4.0 * half.error else apart
        found[name] = Estimate(whole.mean.reshape(value.shape), error)
    return image, found


def differences(problem: Problem, adjoint: Tensor, name: str, scale: float, effort: Effort) -> Running:
    """Return differences of each component of a part, from as many seeds as the wanted noise takes."""
    make, finer = problem.equal or problem.make, problem.finer
    value, h = problem.parts[name], scale * problem.steps[name]
    units = torch.eye(value.numel(), dtype=value.dtype).reshape(-1, *value.shape)
    # Of two samples in each finer pixel differences vary about half as much as of one, which costs nearly the same.
    spp = max(2 if finer > 1 else 1, effort.difference_spp // finer**2)
    bounces = problem.options.get("bounces", 1)

    def loss(value: Tensor, seed: int) -> float:
        scene, camera = make({**problem.parts, name: value})
        return float((supersampled(scene, camera, finer, spp=spp, seed=seed, bounces=bounces) * adjoint).sum())

    run = Running()
    with torch.no_grad():
        for seeds in effort.difference_seeds:
            for seed in range(run.count, seeds):
                both = [(loss(value + h * e, seed), loss(value - h * e, seed)) for e in units]
                run.add(torch.tensor([(high - low) / (2.0 * h) for high, low in both], dtype=torch.float64))
            if run.estimate().error <= effort.noise * float(run.mean.norm()):
                break
    return run
