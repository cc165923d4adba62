"""Light that is scattered more than once: noise and time of images over those of Mitsuba's path tracer, and the gradient's."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from table import Bench, Row, Skipped, median_row
from torch import Tensor

import edgegrad as eg

sys.path.append(str(Path(__file__).parents[1] / "tests"))

from mitsuba_rooms import MitsubaRoom
from room_scenes import box_room, towards_room, vector

SIZE, SPP = 64, 64
MUST: dict[tuple[str, int], float] = {("lamp", 2): 1.0, ("point", 2): 1.0, ("sky", 2): 1.0}


def bounces(bench: Bench) -> list[Row]:
    return [*gradients(bench), *(row for lights in ("lamp", "point", "sky") for row in images(bench, lights))]


def gradients(bench: Bench) -> list[Row]:
    """By the colour of a wall, at default samples."""
    color = vector(0.7, 0.15, 0.1).requires_grad_()
    room = box_room()
    wall = room.meshes[2].replace(material=eg.Material(color))
    scene = room.replace(meshes=[*room.meshes[:2], wall, *room.meshes[3:]])
    ratios = []
    for seed in range(bench.repeats(8)):
        begin = time.process_time()
        image = eg.render(scene, towards_room(2 * SIZE), seed=seed, bounces=2)
        middle = time.process_time()
        image.mean().backward()
        ratios.append((time.process_time() - middle) / (middle - begin))
    return [median_row("2 bounces: backward pass over image, by the colour of a wall", ratios, must=1.5, aim=1.0)]


def images(bench: Bench, lights: str) -> list[Row]:
    scene, camera = box_room(lights), towards_room(SIZE)
    rows = []
    seeds = iter(range(1 << 20))
    for count in (2, 4):
        try:
            peer = MitsubaRoom(scene, camera, count)
        except ImportError as error:
            raise Skipped(f"{error}; pip install mitsuba") from error

        def own(count: int = count) -> Tensor:
            with torch.no_grad():
                return eg.render(scene, camera, SPP, next(seeds), bounces=count)

        def theirs(peer: MitsubaRoom = peer) -> Tensor:
            return peer.render(SPP, next(seeds))

        found = bench.interleaved(8, _timed(own), _timed(theirs))
        noise = [float(torch.stack([image for image, _ in side]).double().var(0).mean()) ** 0.5 for side in found]
        seconds = [statistics.median(taken for _, taken in side) for side in found]
        at_equal_time = noise[0] / noise[1] * (seconds[0] / seconds[1]) ** 0.5
        note = f"noise {noise[0]:.4f} and {noise[1]:.4f}, processor time {seconds[0]:.3f} s and {seconds[1]:.3f} s"
        what = f"room, {lights}, {count} bounces: noise at equal time over Mitsuba's"
        aim = 0.5 if (lights, count) in MUST else None
        rows.append(Row(what, at_equal_time, must=MUST.get((lights, count)), aim=aim, note=note))
    return rows


def _timed(work: Callable[[], Tensor]) -> Callable[[], tuple[Tensor, float]]:
    """With its seconds of processor time, of all threads."""

    def call() -> tuple[Tensor, float]:
        begin = time.process_time()
        image = work()
        return image, time.process_time() - begin

    return call
