"""Noise in images of metal balls under skies and small lights, compared with that of Mitsuba's `direct` in the same time."""

from __future__ import annotations

import importlib
import math
import statistics
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

import edgegrad as eg

from . import mitsuba
from .scenes import icosphere
from .table import Bench, Row, median_time, quartiles, seconds_of

SIZE = 96
LIGHTS = ((14, 40, 4, 60.0), (20, 90, 3, 120.0), (30, 64, 5, 40.0))  # row, column, size and radiance
# The most noise of a pixel in percent of its radiance: under an even sky at 4 light samples, under lights at 32.
EVEN, UNDER_LIGHTS = {0.5: 5.0, 0.2: 3.0, 0.05: 2.0}, {1.0: 4.0, 0.5: 5.0, 0.3: 7.0, 0.2: 10.0}


def sky(kind: str) -> Tensor:
    image = torch.full((64, 128, 3), 1.0 if kind == "even" else 0.2)
    for row, column, size, radiance in LIGHTS if kind != "even" else ():
        image[row : row + size, column : column + size] = radiance
    return image


class Images:
    """Images of one ball under a sky, by seed."""

    def __init__(self, kind: str, roughness: float, light_samples: int = 4) -> None:
        verts = torch.nn.functional.normalize(icosphere(5).verts.float(), dim=1)
        metal = eg.Material(base_color=torch.ones(3), metallic=1.0, roughness=roughness)
        mesh = eg.Mesh(verts, icosphere(5).faces, normals=verts, material=metal)
        self.scene = eg.Scene([mesh], lights=[eg.lights.Environment(sky(kind))])
        self.camera = eg.Camera.look_at((0.0, 0.3, 3.2), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, (SIZE, SIZE))
        self.light_samples = light_samples

    def __call__(self, seed: int) -> Tensor:
        return eg.render(self.scene, self.camera, spp=16, sampling=eg.Sampling(lights=self.light_samples), seed=seed)


class MitsubaImages:
    """Mitsuba's images of the same ball: 64 samples a pixel, each with one sample of the light and one of the BSDF."""

    def __init__(self, mi: Any, kind: str, roughness: float) -> None:
        metal = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": roughness**2}
        parts = {
            "integrator": {"type": "direct"},
            "sensor": mitsuba.sensor(mi, (0, 0.3, 3.2), (0, 0, 0), 40, (SIZE, SIZE)),
            "sky": mitsuba.sky(mi, sky(kind)),
            "ball": {"type": "sphere", "bsdf": metal},
        }
        self.mi, self.scene = mi, mi.load_dict({"type": "scene", **parts})

    def __call__(self, seed: int) -> Tensor:
        return torch.from_numpy(np.array(self.mi.render(self.scene, spp=64, seed=seed)))


FLOOR, BALL, LIGHT_BALL = 3.0, ((0.0, 0.6, 0.0), 0.6), ((-1.0, 2.0, -1.5), 0.5)
# Centre, half sides and radiance.
QUADS = {
    "a quad": ((0.0, 2.2, -1.8), (0.4, 0.0, 0.0), (0.0, 0.25, 0.3), 20.0),
    "a softbox": ((0.0, 2.5, -3.0), (2.5, 0.0, 0.0), (0.0, 1.6, 0.8), 2.0),
}


class LightImages:
    """Images of a ball on a plane, both of metal, under an area light."""

    def __init__(self, kind: str, roughness: float) -> None:
        metal = eg.Material(base_color=torch.ones(3), metallic=1.0, roughness=roughness)
        unit = torch.nn.functional.normalize(icosphere(5).verts.float(), dim=1)
        place, size = BALL
        ball = eg.Mesh(unit * size + torch.tensor(place), icosphere(5).faces, normals=unit, material=metal)
        corners = FLOOR * torch.tensor([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
        floor = eg.Mesh(corners, torch.tensor([[0, 2, 1], [0, 3, 2]]), material=metal)
        if kind in QUADS:
            center, u, v, radiance = QUADS[kind]
            vectors = torch.tensor(center), torch.tensor(u), torch.tensor(v)
            light = eg.shapes.rectangle(
                *vectors, material=eg.Material(base_color=0.0, emission=radiance, two_sided=False)
            )
        else:
            place, size = LIGHT_BALL
            verts = torch.nn.functional.normalize(icosphere(3).verts.float(), dim=1) * size + torch.tensor(place)
            light = eg.Mesh(verts, icosphere(3).faces).replace(material=eg.Material(base_color=0.0, emission=10.0))
        self.scene = eg.Scene([ball, floor, light])
        self.camera = eg.Camera.look_at((0.0, 1.6, 3.6), (0.0, 0.35, 0.0), (0.0, 1.0, 0.0), 36.0, (SIZE, SIZE))

    def __call__(self, seed: int) -> Tensor:
        return eg.render(self.scene, self.camera, spp=16, sampling=eg.Sampling(lights=4), seed=seed)


class MitsubaLightImages:
    """Mitsuba's images of the same scene, with 64 samples a pixel."""

    def __init__(self, mi: Any, kind: str, roughness: float) -> None:
        turn = mi.ScalarTransform4f
        metal = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": roughness**2}
        if kind in QUADS:
            centre, u, v, radiance = QUADS[kind]
            frame = np.eye(4)
            frame[:3, 0], frame[:3, 1], frame[:3, 3] = u, v, centre
            n = np.cross(u, v)
            frame[:3, 2] = n / np.linalg.norm(n)
            light: dict[str, Any] = {"type": "rectangle", "to_world": turn(frame)}
        else:
            (place, size), radiance = LIGHT_BALL, 10.0
            light = {"type": "sphere", "center": list(place), "radius": size}
        light["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
        parts = {
            "integrator": {"type": "direct"},
            "sensor": mitsuba.sensor(mi, (0, 1.6, 3.6), (0, 0.35, 0), 36, (SIZE, SIZE)),
            "ball": {"type": "sphere", "center": list(BALL[0]), "radius": BALL[1], "bsdf": metal},
            "floor": {"type": "rectangle", "to_world": turn().rotate([1, 0, 0], -90).scale(FLOOR), "bsdf": dict(metal)},
            "light": light,
        }
        self.mi, self.scene = mi, mi.load_dict({"type": "scene", **parts})

    def __call__(self, seed: int) -> Tensor:
        return torch.from_numpy(np.array(self.mi.render(self.scene, spp=64, seed=seed)))


def drawn(images: Callable[[int], Tensor], count: int, first: int = 0) -> tuple[Tensor, list[float]]:
    """Return pixels around the middle (count, n, C) and the seconds of each image."""
    images(first)
    found: list[Tensor] = []
    seconds = [seconds_of(lambda s=s: found.append(images(first + s))) for s in range(1, count + 1)]
    y, x = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    inside = torch.hypot(x - SIZE / 2 + 0.5, y - SIZE / 2 + 0.5) < 0.4 * SIZE
    return torch.stack(found)[:, inside].double(), seconds


def noise(pixels: Tensor) -> float:
    """Return the root mean square noise of pixels, relative to the mean radiance."""
    return float(pixels.var(0).mean().sqrt() / pixels.mean())


def relative(kind: str, roughness: float, light_samples: int, count: int) -> float:
    """Return the mean over pixels of noise relative to radiance, in percent."""
    pixels, _ = drawn(Images(kind, roughness, light_samples), count)
    return 100 * float((pixels.std(0) / pixels.mean(0)).mean())


def glossy(bench: Bench) -> list[Row]:
    n = bench.repeats(16)
    rows = [
        Row(f"a metal ball, even sky, roughness {r}: noise", relative("even", r, 4, n), unit=" %", must=must)
        for r, must in EVEN.items()
    ]
    rows += [
        Row(
            f"… sky with small lights, 32 light samples, roughness {r}: noise",
            relative("lights", r, 32, n),
            unit=" %",
            must=must,
        )
        for r, must in UNDER_LIGHTS.items()
    ]
    try:
        mi = importlib.import_module("mitsuba")
    except ImportError:
        return rows
    mi.set_variant("scalar_rgb")
    threads = torch.get_num_threads()
    skies = [
        against_mitsuba(bench, Images(kind, r), MitsubaImages(mi, kind, r), f"sky: {kind}, roughness {r}", threads)
        for kind in ("even", "lights")
        for r in (0.5, 0.2, 0.1)
    ]
    lights = [
        against_mitsuba(
            bench, LightImages(kind, r), MitsubaLightImages(mi, kind, r), f"light: {kind}, roughness {r}", threads
        )
        for kind in (*QUADS, "a ball")
        for r in (1.0, 0.5, 0.2, 0.05)
    ]
    return rows + skies + lights


def against_mitsuba(
    bench: Bench, ours: Callable[[int], Tensor], theirs: Callable[[int], Tensor], what: str, threads: int
) -> Row:
    """Compare noise with Mitsuba's at equal time; noise of independent samples falls with the root of the time."""
    ratios, seconds, others = [], [], []
    for turn in range(bench.repeats(8)):
        found, own = drawn(ours, 4, 10 * turn)
        their_found, other = drawn(theirs, 4, 10 * turn)
        seconds += own
        others += other
        share = statistics.median(own) / statistics.median(other)
        ratios.append(noise(found) / noise(their_found) * math.sqrt(share))
    return Row(
        f"… {what}: noise over Mitsuba's of as much time", statistics.median(ratios), quartiles(ratios),
        must=1.0, aim=0.5, note=f"edgegrad {median_time(seconds)}, Mitsuba {median_time(others)}, {threads} threads",
    )  # fmt: skip
