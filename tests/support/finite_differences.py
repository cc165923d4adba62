"""Comparisons of a gradient that has statistical noise, with what is exact and with central finite differences of the forward
renderer. Each must be able to decide the gradient from 0.95 and from 1.05 times itself, or it fails.

Finite differences are of a case, a function θ ↦ (scene, camera) of one number. The loss is the image times a fixed smooth
adjoint, so its gradient needs no forward samples. Both sides are means over seeds with a standard error each.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from scenes import smooth_adjoint
from torch import Tensor

import edgegrad as eg

Case = Callable[[Tensor], tuple[eg.Scene, eg.Camera]]


class Estimate(NamedTuple):
    mean: float
    error: float  # standard error of the mean


def estimate(values: list[float]) -> Estimate:
    x = torch.tensor(values, dtype=torch.float64)
    return Estimate(x.mean().item(), (x.std() / len(values) ** 0.5).item())


def loss(scene: eg.Scene, camera: eg.Camera, **options: object) -> Tensor:
    image = eg.render(scene, camera, **{"seed": 0, **options})  # type: ignore[arg-type]
    return (image.double() * smooth_adjoint(*image.shape[-3:])).sum()


def finite_difference(case: Case, step: float, spp: int, seeds: int, **options: object) -> Estimate:
    """(loss(θ + h) − loss(θ − h)) / 2h at θ = 0; both sides use the same samples."""
    values = []
    with torch.no_grad():
        for seed in range(seeds):
            high, low = (
                loss(*case(torch.tensor(h, dtype=torch.float64)), spp=spp, seed=seed, **options) for h in (step, -step)
            )
            values.append(((high - low) / (2 * step)).item())
    return estimate(values)


def gradient(case: Case, seeds: int, **options: object) -> Estimate:
    """d loss / dθ at θ = 0 by edgegrad. The image's samples matter to the background alone: the loss is linear."""
    values = []
    for seed in range(seeds):
        theta = torch.zeros((), dtype=torch.float64, requires_grad=True)
        values.append(torch.autograd.grad(loss(*case(theta), spp=64, seed=1000 + seed, **options), theta)[0].item())
    return estimate(values)


def check(name: str, truth: float, found: Estimate, slack: float = 0.005, most: float = 0.023) -> None:
    """The gradient is the exact derivative, up to chance: within 4 standard errors, and a `slack` for their tails.

    Where that is less than 2.3 % of the derivative, 0.95 and 1.05 times a gradient that passes do not:
    0.95 · 1.023 < 1 − 0.95 · 0.023 and 1.05 · 0.977 > 1 + 1.05 · 0.023.
    """
    allowed = 4 * found.error + slack * abs(truth)
    said = f"{name}: exact {truth:.6g}, gradient {found.mean:.6g} ± {found.error:.2g}, ratio {found.mean / truth:.4f}"
    assert allowed < most * abs(truth), f"{said}; too noisy to decide"
    assert abs(found.mean - truth) <= allowed, said


def check_ratio(
    case: Case, step: float, spp: int = 512, seeds: int = 4, filter: str = "box", **options: object
) -> float:
    """The gradient over the finite difference; it must be right."""
    fd = finite_difference(case, step, spp, seeds, filter=filter)
    return right_ratio(fd, gradient(case, 2 * seeds, filter=filter, **options))


def right_ratio(fd: Estimate, g: Estimate) -> float:
    """The gradient over the finite difference lies within 1 ± 0.02, and both are known well enough to say so."""
    ratio = g.mean / fd.mean
    noise = (fd.error**2 + g.error**2) ** 0.5 / abs(fd.mean)
    assert noise < 0.01, f"too noisy to decide: {fd}, {g}"
    assert abs(ratio - 1) <= 0.02, f"finite difference {fd}, gradient {g}, ratio {ratio:.4f} ± {noise:.4f}"
    return ratio


def rotation(axis: tuple[float, float, float], angle: Tensor) -> Tensor:
    """Rotation matrix (3, 3) by `angle` radians about a unit axis."""
    x, y, z = axis
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(angle * cross)
