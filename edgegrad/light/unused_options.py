"""Warnings of options of render() that do not change the image."""

from __future__ import annotations

import torch

from ..sampling import Sampling
from ..scene.scene import Scene
from ..warnings import warn
from .radiance import Lighting

CREASES = "sampling.creases"
LIGHTING = ("shadows", "bounces", "sampling.lights")  # options of lit scenes


def warn_of_unused(scene: Scene, with_shader: bool, lighting: Lighting, sampling: Sampling) -> None:
    """Warn of each option that is not at its default and has no effect on an image of the scene."""
    if torch.compiler.is_compiling():
        return
    given = lighting.shadows, lighting.bounces, sampling.lights, sampling.creases
    for name, value, default in zip((*LIGHTING, CREASES), given, (True, 1, 1, "auto"), strict=True):
        changed = type(value) is not type(default) or value != default
        if changed and (why := why_unused(name, scene, with_shader)):
            warn(f"unused {name}", f"{name}: {value!r} has no effect, for {why}; leave {name.split('.')[-1]}= out")


def why_unused(name: str, scene: Scene, with_shader: bool) -> str:
    """Return the reason why an option has no effect, or an empty string if it has one."""
    if name in LIGHTING and with_shader:
        return "the shader computes the radiance, not the scene's lights and materials"
    if name in LIGHTING and not scene.is_lit:
        return "the scene has neither lights nor materials"
    if name == CREASES and not with_shader and not scene.is_shaded:
        return "colours and textures show by themselves at which edges they jump"
    return ""
