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
from room_scenes import ROOMS, box_room, towards_room, vector, without_alpha

SIZE, SPP = 64, 64
SAMPLERS = {"independent": {"must": 1.0, "aim": 0.5}, "multijitter": {}}  # Mitsuba's default, and its best one


def bounces(bench: Bench) -> list[Row]:
    return [*gradients(bench), *(row for room in ROOMS for row in images(bench, room))]


def gradients(bench: Bench) -> list[Row]:
    """By the colour of a wall and by all vertices, at default samples."""
    rows = []
    for what in ("the colour of a wall", "the block's vertices"):
        room = box_room()
        leaf = vector(0.7, 0.15, 0.1) if what.startswith("the colour") else room.meshes[4].verts.clone()
        leaf.requires_grad_()
        meshes = list(room.meshes)
        if what.startswith("the colour"):
            meshes[2] = meshes[2].replace(material=eg.Material(leaf))
        else:
            meshes[4] = meshes[4].replace(verts=leaf)
        scene, ratios = room.replace(meshes=meshes), []
        for seed in range(bench.repeats(8)):
            begin = time.process_time()
            with torch.no_grad():
                eg.render(scene, towards_room(2 * SIZE), seed=seed, bounces=2)
            middle = time.process_time()
            eg.render(scene, towards_room(2 * SIZE), seed=seed, bounces=2).mean().backward()
            # What a gradient adds, in the forward pass as well.
            ratios.append((time.process_time() - middle) / (middle - begin) - 1)
        rows.append(median_row(f"2 bounces: gradient over image, by {what}", ratios, must=1.5, aim=1.0))
    return rows


def images(bench: Bench, room: str) -> list[Row]:
    scene, camera, seeds = ROOMS[room](), towards_room(SIZE), iter(range(1 << 20))
    try:
        peers = [MitsubaRoom(without_alpha(room), camera, 2, sampler) for sampler in SAMPLERS]
    except (ImportError, RuntimeError) as error:
        raise Skipped(f"{error}") from error

    def own() -> Tensor:
        with torch.no_grad():
            return eg.render(scene, camera, SPP, next(seeds), bounces=2)

    for warm in (own, *(lambda peer=peer: peer.render(SPP, 0) for peer in peers)):
        warm()
    found = bench.interleaved(8, _timed(own), *(_timed(lambda p=peer: p.render(SPP, next(seeds))) for peer in peers))
    noise = [float(torch.stack([image for image, _ in side]).double().var(0).mean()) ** 0.5 for side in found]
    seconds = [statistics.median(taken for _, taken in side) for side in found]
    rows = []
    for k, (sampler, wanted) in enumerate(SAMPLERS.items(), 1):
        at_equal_time = noise[0] / noise[k] * (seconds[0] / seconds[k]) ** 0.5
        note = f"noise {noise[0]:.4f} and {noise[k]:.4f}, processor time {seconds[0]:.3f} s and {seconds[k]:.3f} s"
        what = f"{room}, 2 bounces: noise at equal time over Mitsuba's with {sampler}"
        rows.append(Row(what, at_equal_time, note=note, **wanted))
    return rows


def _timed(work: Callable[[], Tensor]) -> Callable[[], tuple[Tensor, float]]:
    """With its seconds of processor time, of all threads."""

    def call() -> tuple[Tensor, float]:
        begin = time.process_time()
        image = work()
        return image, time.process_time() - begin

    return call
