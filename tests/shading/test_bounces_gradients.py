"""Gradients of light that is scattered more than once, by what moves, against finite differences of images of it alone."""

from __future__ import annotations

from typing import Any

import pytest
from bounce_scenes import case_of, indirect_change, indirect_gradient, plates
from finite_differences import right_ratio

import edgegrad as eg


def check(scene: str, motion: str, spp: int, seeds: int, h: float = 0.1, bounces: int = 2, **samples: Any) -> None:
    case = case_of(scene, motion)
    change = indirect_change(case, h, spp, seeds, bounces)
    print(right_ratio(change, indirect_gradient(case, h, seeds, bounces, **samples)))


OPEN = {"sampling": eg.Sampling(surface=60_000, edges=10_000)}


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [2, 3])
@pytest.mark.parametrize("motion", ["right vertex", "left y", "light y"])
def test_all_motions_of_paths_that_no_border_crosses(motion: str, bounces: int) -> None:
    check("open plates", motion, 4096, 8, bounces=bounces, **{name: 8 * n for name, n in OPEN.items()})


@pytest.mark.slow
def test_strip_between_plates() -> None:
    check("plates", "strip y", 4096, 6, sampling=eg.Sampling(surface=1 << 18, edges=1 << 16))


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [0.5, 0.2])
@pytest.mark.parametrize("glossy", ["left", "right"])
def test_strip_between_glossy_plates(glossy: str, roughness: float) -> None:
    found = plates()
    material = eg.Material(metallic=0.5, roughness=roughness)
    scene = found._replace(meshes=found.meshes | {glossy: found.meshes[glossy].replace(material=material)})
    case = scene.moving("strip", (0.0, 1.0, 0.0))
    change = indirect_change(case, 0.1, 8192, 12)
    print(right_ratio(change, indirect_gradient(case, 0.1, 12, sampling=eg.Sampling(surface=1_000, edges=60_000))))
