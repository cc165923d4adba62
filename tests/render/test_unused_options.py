"""Options that have no effect on an image are named in a warning, those that have one are not."""

from __future__ import annotations

import warnings
from typing import Any

import pytest
import torch
from lit_scenes import F64, from_above, plane

import edgegrad as eg

CAMERA = from_above(4)
UNLIT = eg.Scene(plane(colors=torch.full((4, 3), 0.5, dtype=F64)))
MIPMAPS = eg.Scene(plane(texture=torch.full((2, 2, 3), 0.5, dtype=F64), filter="mipmap"))
LIT = eg.Scene(plane(material=eg.Material(0.5)), lights=[eg.lights.PointLight((0.0, 0.0, 2.0), 3.0)])


def shader(hits: eg.points.Hits) -> torch.Tensor:
    return hits.position


@pytest.mark.parametrize(
    ("scene", "options", "name"),
    [
        (UNLIT, {"bounces": 2}, "bounces"),
        (UNLIT, {"shadows": False}, "shadows"),
        (UNLIT, {"sampling": eg.Sampling(lights=4)}, "sampling.lights"),
        (UNLIT, {"sampling": eg.Sampling(creases=True)}, "sampling.creases"),
        (MIPMAPS, {"bounces": 2}, "bounces"),
        (LIT, {"bounces": 2, "shader": shader}, "bounces"),
        (LIT, {"shadows": False, "shader": shader}, "shadows"),
        (UNLIT, {"sampling": eg.Sampling(lights=4), "shader": shader}, "sampling.lights"),
    ],
)
def test_an_option_without_effect_is_named(scene: eg.Scene, options: dict[str, Any], name: str) -> None:
    own, field = options[name.split(".")[0]], name.split(".")[-1]
    value = getattr(own, field) if name != field else own
    for function in (eg.render, eg.plan):
        with pytest.warns(UserWarning, match=f"^{name}: {value} has no effect, for .*; leave {field}= out$") as seen:
            function(scene, CAMERA, 1, **options)
        assert len(seen) == 1 and seen[0].filename == __file__


def test_channels_and_profiles_name_it_too() -> None:
    with pytest.warns(UserWarning, match=r"^bounces: 2 has no effect"):
        eg.render_aovs(UNLIT, CAMERA, ["image", "depth"], 1, bounces=2, seed=0)
    with pytest.warns(UserWarning, match=r"^bounces: 2 has no effect"):
        eg.profile(UNLIT, CAMERA, spp=1, repeats=1, bounces=2)


def test_an_option_with_effect_or_at_its_default_is_not_named() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        eg.render(LIT, CAMERA, 1, bounces=2, shadows=False, sampling=eg.Sampling(lights=2, creases=True), seed=0)
        eg.render(UNLIT, CAMERA, 1, shader=shader, sampling=eg.Sampling(creases=False), seed=0)
        eg.render(MIPMAPS, CAMERA, 1, sampling=eg.Sampling(creases=False), seed=0)
        eg.render(
            UNLIT,
            CAMERA,
            1,
            bounces=1,
            shadows=True,
            sampling=eg.Sampling(lights=1, creases="auto"),
            seed=0,
        )
        eg.render_aovs(LIT, CAMERA, ["depth"], 1, bounces=2, seed=0)
