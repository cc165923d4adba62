"""The conversions of docs/how-to/mitsuba.md, by images of Mitsuba and of edgegrad of the same scenes."""

from __future__ import annotations

import contextlib
import importlib
import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from doc_pages import FENCE, FOLDER
from torch import Tensor

import edgegrad as eg
from benchmarks.mitsuba import sky_image

SIZE = (12, 16)
ORIGIN, TARGET, UP = [1.0, -2.5, 2.0], [0.1, 0.0, 0.2], [0.0, 0.0, 1.0]
COLOR = [0.7, 0.5, 0.3]
ALBEDO = [0.8, 0.6, 0.4]


@pytest.fixture(scope="module")
def page() -> dict[str, Any]:
    """Return what the code of the page defines."""
    names: dict[str, Any] = {}
    text = (Path(FOLDER) / "how-to/mitsuba.md").read_text(encoding="utf-8")
    with contextlib.redirect_stdout(io.StringIO()):
        for kind, source in FENCE.findall(text):
            if kind == "python":
                exec(source, names)
    return names


@pytest.fixture(scope="module")
def mi() -> Any:
    pytest.importorskip("mitsuba")
    module = importlib.import_module("mitsuba")
    module.set_variant("scalar_rgb")
    return module


def quad(half: float, height: float = 0.0) -> eg.Mesh:
    """Return a square that is seen from above."""
    corners = [[-half, -half, height], [half, -half, height], [half, half, height], [-half, half, height]]
    return eg.Mesh(torch.tensor(corners), torch.tensor([[0, 1, 2], [0, 2, 3]]))


def theirs(mi: Any, fov: dict[str, Any], bsdf: dict[str, Any], emitter: dict[str, Any], spp: int, depth: int) -> Tensor:
    """Return Mitsuba's image of a floor, a plate above it and a light."""
    T = mi.ScalarTransform4f
    height, width = SIZE
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", **fov, "to_world": T().look_at(ORIGIN, TARGET, UP), "film": film}
    floor = {"type": "rectangle", "to_world": T().scale([3.0, 3.0, 1.0]), "bsdf": {"type": "twosided", "below": bsdf}}
    plate = {**floor, "to_world": T().translate([0.0, 0.0, 0.4]) @ T().scale([0.3, 0.3, 1.0])}
    scene = {
        "type": "scene", "integrator": {"type": "path", "max_depth": depth, "rr_depth": 100},
        "sensor": {**sensor, "sampler": {"type": "multijitter", "sample_count": spp}},
        "floor": floor, "plate": plate, "light": emitter,
    }  # fmt: skip
    return torch.from_numpy(np.array(mi.render(mi.load_dict(scene), seed=1)))


def agree(found: Tensor, expected: Tensor, noise: float) -> None:
    """Check images pixel by pixel up to noise, and their means within 1 %."""
    assert found.mean() == pytest.approx(float(expected.mean()), rel=0.01)
    assert float((found - expected).square().mean().sqrt()) < noise * float(expected.mean())


def rgb(values: list[float]) -> dict[str, Any]:
    return {"type": "rgb", "value": values}


def sky() -> Tensor:
    """Return an image (h, w, 3) that is neither even nor symmetric."""
    draw = torch.Generator().manual_seed(3)
    return (0.2 + torch.rand((4, 6, 3), generator=draw)).clone()


def case(mi: Any, page: dict[str, Any], name: str) -> tuple[dict[str, Any], Any, dict[str, Any], eg.Material]:
    """Return Mitsuba's light, edgegrad's, Mitsuba's material and edgegrad's."""
    T = mi.ScalarTransform4f
    bsdf, material = {"type": "diffuse", "reflectance": rgb(ALBEDO)}, eg.Material(torch.tensor(ALBEDO))
    point = {"type": "point", "position": [0.8, 0.5, 2.0], "intensity": rgb([9 * c for c in COLOR])}
    color = torch.tensor(COLOR)
    if name == "point":
        return point, eg.lights.PointLight((0.8, 0.5, 2.0), 9.0, color=color), bsdf, material
    if name == "directional":
        emitter = {"type": "directional", "direction": [0.6, -0.8, -1.0], "irradiance": rgb([3 * c for c in COLOR])}
        return emitter, eg.lights.DirectionalLight((0.6, -0.8, -1.0), 3.0, color=color), bsdf, material
    if name == "spot":
        place = T().look_at([0.3, 0.2, 2.0], [0.0, 0.1, 0.0], [0.0, 1.0, 0.0])
        emitter = {"type": "spot", "to_world": place, "intensity": rgb([9 * c for c in COLOR]), "cutoff_angle": 40.0}
        emitter["beam_width"] = 39.0
        angles = {"inner_angle": math.radians(39.0), "outer_angle": math.radians(40.0)}
        return (
            emitter,
            eg.lights.SpotLight((0.3, 0.2, 2.0), (-0.3, -0.1, -2.0), 9.0, color=color, **angles),
            bsdf,
            material,
        )
    if name == "area":
        place = T().translate([0.2, 0.3, 1.5]) @ T().scale([0.4, 0.3, 1.0]) @ T().rotate([1.0, 0.0, 0.0], 180)
        radiance = {"type": "area", "radiance": rgb([5 * c for c in COLOR])}
        light = quad(1.0).replace(material=eg.Material(0.0, emission=5 * color, two_sided=False))
        M = torch.tensor(np.array(place.matrix)).float()
        light = light.replace(verts=light.verts @ M[:3, :3].T + M[:3, 3])
        return {"type": "rectangle", "to_world": place, "emitter": radiance}, light, bsdf, material
    if name == "constant":
        return {"type": "constant", "radiance": rgb(COLOR)}, eg.lights.Environment(color), bsdf, material
    if name == "envmap":
        rows = sky_image(sky().double()).float()
        place = T().rotate([1.0, 0.0, 0.0], 90) @ T().rotate([0.0, 1.0, 0.0], 40)
        emitter = {"type": "envmap", "bitmap": mi.Bitmap(rows.numpy()), "to_world": place}
        return emitter, page["environment"](sky(), np.array(place.matrix)), bsdf, material
    metallic, roughness = 1.0 if name == "metal" else 0.0, 0.5
    bsdf = {"type": "principled", "base_color": rgb(ALBEDO), "metallic": metallic, "roughness": roughness}
    light = eg.lights.PointLight((0.8, 0.5, 2.0), 9.0, color=color)
    return point, light, bsdf, eg.Material(torch.tensor(ALBEDO), metallic, roughness)


# How far pixels may be off by noise, in units of the mean.
CASES = {
    "point": 0.03, "directional": 0.12, "spot": 0.07, "area": 0.04, "constant": 0.02, "envmap": 0.02, "metal": 0.07,
}  # fmt: skip


def images(
    mi: Any, page: dict[str, Any], name: str, fov: dict[str, Any], spp: int, bounces: int = 1
) -> tuple[Tensor, Tensor]:
    emitter, light, bsdf, material = case(mi, page, name)
    expected = theirs(mi, fov, bsdf, emitter, spp, bounces + 1)
    camera = page["from_mitsuba"](page["look_at"](ORIGIN, TARGET, UP), fov_x=fov["fov"], size=SIZE)
    meshes = [quad(3.0).replace(material=material), quad(0.3, 0.4).replace(material=material)]
    scene = eg.Scene(meshes, lights=[light])
    return eg.render(scene, camera, spp, sampling=eg.Sampling(lights=4), bounces=bounces, seed=0).float(), expected


@pytest.mark.parametrize("name", CASES)
def test_lights_and_materials(mi: Any, page: dict[str, Any], name: str) -> None:
    agree(*images(mi, page, name, {"fov": 50.0}, 256), CASES[name])


def test_dielectrics_differ_as_the_page_says(mi: Any, page: dict[str, Any]) -> None:
    found, expected = images(mi, page, "plastic", {"fov": 50.0}, 256)
    assert 0.93 < float(found.mean() / expected.mean()) < 0.97


def test_bounces(mi: Any, page: dict[str, Any]) -> None:
    agree(*images(mi, page, "point", {"fov": 50.0}, 256, bounces=2), 0.03)


def test_an_envmap_is_turned_by_half_a_turn(page: dict[str, Any]) -> None:
    """The rotation is diag(−1, 1, −1) after that of `to_world`. The test needs no Mitsuba."""
    half, quarter = torch.diag(torch.tensor([-1.0, 1.0, -1.0])), torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    to_world = torch.eye(4)
    to_world[:3, :3] = quarter
    assert torch.equal(page["environment"](sky()).rotation, half)
    assert torch.equal(page["environment"](sky(), to_world).rotation, quarter @ half)
