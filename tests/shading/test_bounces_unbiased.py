"""Means of 256 gradients of few samples each, of light that is scattered twice, against finite differences: none of six scenes is
rejected (Holm 1979)."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from bounce_scenes import SIZE, adjoint, case_of, indirect_change
from finite_differences import Case, Estimate, estimate
from sampling_options import with_sampling

import edgegrad as eg
from edgegrad.light.radiance import CLOSER_STEPS

F64 = torch.float64
SEEDS, H, LEVEL = 256, 0.1, 0.05
SCENES = (
    ("cornell", "block x"),
    ("standing", "block z"),
    ("light upwards", "light x"),
    ("under sky", "ground y"),
    ("plates", "strip y"),
    ("ball", "ball x"),
)


def of_few_samples(case: Case) -> Estimate:
    """Return the mean over places of the motion in [−H, H], one for each seed, spread evenly."""
    found = []
    for seed in range(SEEDS):
        at = H * ((2 * seed + 1) / SEEDS - 1)
        value = 0.0
        for sign, bounces in ((1, 2), (-1, 1)):
            theta = torch.tensor(at, dtype=F64, requires_grad=True)
            options: dict[str, Any] = {"sampling": eg.Sampling(surface=2_000, edges=2_000)}
            spacing = 1.0 if bounces > 1 else 1 / CLOSER_STEPS  # of the same samples
            image = eg.render(
                *case(theta), 1, seed, bounces=bounces, **with_sampling(options, discontinuity_spacing=spacing)
            )
            (slope,) = torch.autograd.grad((adjoint()[:, :, None] * image).sum() / SIZE**2, theta)
            value += sign * float(slope)
        found.append(value)
    return estimate(found)


@pytest.mark.slow
def test_few_samples_are_unbiased_in_six_scenes() -> None:
    chances = []
    for scene, motion in SCENES:
        case = case_of(scene, motion)
        change, mean = indirect_change(case, H, 2048, 8), of_few_samples(case)
        error = math.hypot(change.error, mean.error)
        chances.append(math.erfc(abs(mean.mean - change.mean) / error / math.sqrt(2)))
        print(f"{scene}, {motion}: {mean.mean / change.mean:.3f} ± {error / abs(change.mean):.3f}, p {chances[-1]:.2f}")
        assert error < 0.1 * abs(change.mean), "too noisy to decide"
    assert all(p > LEVEL / (len(chances) - k) for k, p in enumerate(sorted(chances)))
