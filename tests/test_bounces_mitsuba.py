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
    # Over blocks of 4 × 4 pixels, of which none but those of the lamp and the sky are without noise.
    blocks = [images.unfold(1, 4, 4).unfold(2, 4, 4).mean((-1, -2)) for images in (theirs, own)]
    error = sum(block.var(0) for block in blocks) / 4
    difference = blocks[0].mean(0) - blocks[1].mean(0)
    noise = (error + (2e-4 * blocks[1].mean(0)) ** 2).sqrt()
    assert float((difference / noise).square().mean()) < 2.5
    assert abs(float(own.mean() / theirs.mean()) - 1) < 3e-3
