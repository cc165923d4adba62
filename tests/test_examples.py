"""The examples find what they look for, in fewer steps than they take."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import torch

FOLDER = Path(__file__).parents[1] / "examples"


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_texture_and_its_light() -> None:
    pictures, before, after = example("harmonics").fit(steps=30)
    assert after < 0.4 * before
    assert len(pictures) == 3


def test_a_network_and_the_shape_under_it() -> None:
    network = example("network")
    _, tube = network.fit(steps=60)
    assert abs(tube - network.TRUE_TUBE) < 0.5 * abs(network.FIRST_TUBE - network.TRUE_TUBE)


def test_steps() -> None:
    step = example("step")
    _, found = step.fit(steps=50)
    assert torch.allclose(found.centre, step.TRUTH.centre, atol=0.02)
    assert abs(found.radius - step.TRUTH.radius) < 0.02
    assert abs(found.stripe - step.TRUTH.stripe) < 0.004


def test_there_is_no_other() -> None:
    assert sorted(path.stem for path in FOLDER.glob("*.py")) == ["harmonics", "network", "step"]
