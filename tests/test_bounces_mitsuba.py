"""Images of light that is scattered more than once against Mitsuba's."""

from __future__ import annotations

import pytest
import torch
from mitsuba_rooms import MitsubaRoom
from room_scenes import box_room, towards_room

import edgegrad as eg


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [2, 4, 8])
@pytest.mark.parametrize("lights", ["lamp", "point", "sky"])
def test_images(lights: str, bounces: int) -> None:
    pytest.importorskip("mitsuba")
    scene, camera = box_room(lights), towards_room(24)
    peer = MitsubaRoom(scene, camera, bounces)
    theirs = torch.stack([peer.render(512, seed) for seed in range(4)]).double()
    own = torch.stack([eg.render(scene, camera, 256, seed, bounces=bounces).detach() for seed in range(4)])
    # Over blocks of 8 × 8 pixels, for noise has heavy tails where light is near a wall.
    blocks = [images.unfold(1, 8, 8).unfold(2, 8, 8).mean((-1, -2)) for images in (theirs, own)]
    error = ((blocks[0].var(0) + blocks[1].var(0)) / 4).sqrt()
    means = [block.mean(0) for block in blocks]
    assert bool(((means[0] - means[1]).abs() < 0.015 * means[0] + 4 * error).all())
    assert abs(float(own.mean() / theirs.mean()) - 1) < 5e-3
