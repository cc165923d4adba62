"""Images of light that is scattered more than once against Mitsuba's."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
import torch
from mitsuba_rooms import MitsubaRoom
from room_scenes import ROOMS, towards_room, without_alpha
from scipy.stats import t as student

import edgegrad as eg
from benchmarks import mitsuba
from benchmarks.stability.statistics import holm

CHANCE = 1e-3  # of a false alarm in an image, by Holm
SEEDS, SPP = 8, 128


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [2, 4, 8])
@pytest.mark.parametrize("room", ROOMS)
def test_images(room: str, bounces: int) -> None:
    if importlib.util.find_spec("mitsuba") is None or mitsuba.available() is None:
        pytest.skip("Mitsuba is not installed, or finds no LLVM")
    camera = towards_room(24)
    peer, scene = MitsubaRoom(without_alpha(room), camera, bounces), ROOMS[room]()
    theirs = torch.stack([peer.render(SPP, seed) for seed in range(SEEDS)]).double()
    own = torch.stack([eg.render(scene, camera, SPP, seed, bounces=bounces).detach() for seed in range(SEEDS)])
    # Welch 1947. What hardly varies, such as a light that fills a pixel, may differ by rounding.
    noise = torch.stack([own.var(0), theirs.var(0)]).flatten(1) / SEEDS + 1e-10
    t = (own.mean(0) - theirs.mean(0)).flatten() / noise.sum(0).sqrt()
    freedom = noise.sum(0) ** 2 * (SEEDS - 1) / (noise**2).sum(0)
    p = torch.from_numpy(np.asarray(2 * student.sf(t.abs().numpy(), freedom.numpy())))
    print(f"largest {float(t.abs().max()):.1f} standard errors, root mean square {float(t.square().mean().sqrt()):.2f}")
    assert not holm(p, CHANCE).any()
    means = [side.mean((1, 2, 3)) for side in (own, theirs)]
    error = float(sum(mean.var() for mean in means) / SEEDS) ** 0.5
    ratio, error = float(means[0].mean() / means[1].mean()), error / float(means[1].mean())
    print(f"mean over Mitsuba's {ratio:.4f} ± {error:.4f}")
    assert abs(ratio - 1) < 4 * error + 1e-3
