"""Central finite differences of the forward renderer, and the comparison of a gradient with them.

A case is a function θ ↦ (scene, camera) of one number. The loss is the image times a fixed smooth adjoint, so its gradient
needs no forward samples. Both sides are means over seeds with a standard error each, and they agree when they differ by
no more than chance allows:

    |fd − gradient| ≤ 4 √(se_fd² + se_gradient²) + truncation · |fd|

4 standard errors of S seeds are exceeded by chance, by Student's t, in 0.1 % of comparisons at S = 16 (the slow tests) and in
3 % at S = 4, less the share that `truncation` covers; the seeds are fixed, so a test that passes stays so.
`truncation` is what the step itself may cost: 1 % by default, for steps that
move edges by about an eighth of a pixel. Seen through a box filter, the adjoint is constant over a pixel and jumps at its
border by a few percent, which a difference over a finite step blurs.
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
    image = eg.render(scene, camera, **options)  # type: ignore[arg-type]
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


def check(
    case: Case,
    step: float,
    spp: int = 1024,
    seeds: int = 4,
    truncation: float = 0.01,
    filter: str = "box",
    **options: object,
) -> tuple[Estimate, Estimate]:
    """Asserts agreement; returns (finite difference, gradient)."""
    fd = finite_difference(case, step, spp, seeds, filter=filter)
    g = gradient(case, 2 * seeds, filter=filter, **options)
    allowed = 4 * (fd.error**2 + g.error**2) ** 0.5 + truncation * abs(fd.mean)
    assert abs(fd.mean - g.mean) <= allowed, f"finite difference {fd}, gradient {g}, ratio {g.mean / fd.mean:.4f}"
    return fd, g


def check_ratio(
    case: Case, step: float, spp: int = 1024, seeds: int = 4, filter: str = "box", **options: object
) -> float:
    """The gradient over the finite difference lies within 1 ± 0.02, and both are known well enough to say so."""
    fd = finite_difference(case, step, spp, seeds, filter=filter)
    g = gradient(case, 2 * seeds, filter=filter, **options)
    ratio = g.mean / fd.mean
    noise = (fd.error**2 + g.error**2) ** 0.5 / abs(fd.mean)
    assert noise < 0.01, f"too noisy to tell: {fd}, {g}"
    assert abs(ratio - 1) <= 0.02, f"finite difference {fd}, gradient {g}, ratio {ratio:.4f} ± {noise:.4f}"
    return ratio


def rotation(axis: tuple[float, float, float], angle: Tensor) -> Tensor:
    """Rotation matrix (3, 3) by `angle` radians about a unit axis."""
    x, y, z = axis
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(angle * cross)
