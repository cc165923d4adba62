"""Light that is scattered more than once: noise and time of images over those of Mitsuba's path tracer, and of gradients."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any
from unittest import mock

import torch
from bounce_scenes import BounceScene, before_room, cornell, panel, plates
from bounce_scenes import room as walls
from mitsuba_rooms import MitsubaRoom
from room_scenes import ROOMS, box_room, towards_room, vector, without_alpha
from scenes import icosphere
from torch import Tensor

import edgegrad as eg
from edgegrad import shader

from .table import Bench, Row, Skipped, median_row

SIZE, SPP = 64, 64
SAMPLERS = {"independent": {"must": 1.0, "aim": 0.5}, "multijitter": {}}  # Mitsuba's default, and its best one


def bounces(bench: Bench) -> list[Row]:
    return [row for room in ROOMS for row in images(bench, room)]


def bounced_gradients(bench: Bench) -> list[Row]:
    return [*gradients(bench), *secondary_edges(bench), *mirrors(bench)]


def gradients(bench: Bench) -> list[Row]:
    """Time gradients with respect to the colour of a wall and to all vertices, with default samples."""
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


def secondary_edges(bench: Bench) -> list[Row]:
    """Time secondary edges alone, of a ball of 20,480 faces: samples double until the error of its translation is 2 %."""
    ball = icosphere(5)
    verts = 0.4 * ball.verts.double() + vector(0.15, -0.35, 0.1).double()
    ball = eg.Mesh(verts, ball.faces, material=eg.Material(torch.tensor([0.6], dtype=torch.float64)))
    found = BounceScene({"room": walls(), "emitter": panel((0.1, 0.97, 0), (0.3, 0.25)), "ball": ball}, before_room())

    def gradient(samples: int, seed: int) -> tuple[Tensor, float]:
        shift, begin = torch.zeros(3, dtype=torch.float64, requires_grad=True), time.process_time()
        moved = found.meshes | {"ball": ball.replace(verts=verts + shift)}
        counts: dict[str, Any] = {"sampling": eg.Sampling(surface=1, edges=samples)}
        image = eg.render(eg.Scene(list(moved.values())), _larger(found), 1, seed, bounces=2, shadows=False, **counts)
        (slope,) = torch.autograd.grad(image.mean(), shift)
        return slope, time.process_time() - begin

    def image() -> float:
        begin = time.process_time()
        with torch.no_grad():
            eg.render(eg.Scene(list(found.meshes.values())), _larger(found), 16, bounces=2)
        return time.process_time() - begin

    below, samples, noise, seeds = statistics.median(image() for _ in range(bench.repeats(8))), 10_000, 1.0, 8
    taken: Sequence[float] = ()
    terms = dict.fromkeys(("_interior", "_boundary", "_shadows"), lambda *_: [])
    with mock.patch.multiple(shader._Image, **terms):
        gradient(1_000, 0)
        while noise > 0.02:
            samples *= 2
            slopes, taken = zip(*(gradient(samples, seed) for seed in range(seeds)), strict=True)
            noise = _noise(torch.stack(slopes))
    what = "2 bounces: secondary edges of 20,480 faces, translation at 2 %, over the image of 64² × 16"
    note = f"{samples:,} samples, noise {100 * noise:.1f} % over {seeds} seeds"
    return [median_row(what, [seconds / below for seconds in taken], must=10.0, note=note)]


def mirrors(bench: Bench) -> list[Row]:
    """Measure the noise of the interior term of a surface of roughness 0.2, with respect to its material and its motion."""
    rows = []
    for what, found, name in (("a block", cornell(), "block"), ("a plate that lights another", plates(), "left")):
        slopes: dict[str, list[Tensor]] = {"base colour": [], "roughness": [], "translation": []}
        for seed in range(bench.repeats(16)):
            made = torch.tensor([0.7]), torch.tensor(0.2), torch.zeros(3)
            base, roughness, shift = leaves = [value.double().requires_grad_() for value in made]
            mesh = found.meshes[name]
            look = eg.Material(base, metallic=0.5, roughness=roughness)
            moved = found.meshes | {name: eg.Mesh(mesh.verts + shift, mesh.faces, material=look)}
            scene = eg.Scene(list(moved.values()))
            image = eg.render(scene, _larger(found), 16, seed, bounces=2, visibility=False)
            for values, slope in zip(slopes.values(), torch.autograd.grad(image.mean(), leaves), strict=True):
                values.append(slope.reshape(-1))
        for by, values in slopes.items():
            noise = 100 * _noise(torch.stack(values))
            rows.append(Row(f"2 bounces, roughness 0.2, {what}: noise inside of faces, by {by}", noise, unit=" %"))
    return rows


def _larger(found: BounceScene) -> eg.Camera:
    """Return the camera of a scene with SIZE × SIZE pixels."""
    scale = torch.tensor([[SIZE], [SIZE], [1.0]]).double() / torch.tensor([[32.0], [32.0], [1.0]]).double()
    return found.camera.replace(K=found.camera.K * scale, size=(SIZE, SIZE))


def _noise(values: Tensor) -> float:
    """Return the deviation of gradients (N seeds, n), all components together, relative to the size of their mean."""
    return float(values.var(0).sum().sqrt() / values.mean(0).norm())


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
    """Return `work` with the seconds of processor time, of all threads, next to its result."""

    def call() -> tuple[Tensor, float]:
        begin = time.process_time()
        image = work()
        return image, time.process_time() - begin

    return call
