"""Warnings of options of render() that do not change the image."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from ..scene.scene import Scene
from ..warnings import warn
from .radiance import LIGHTING

# Options that only some ways of shading use, with their defaults.
DEFAULTS = {"creases": "auto", "check_shader": False, "shadows": True, "light_samples": 1, "bounces": 1}


def warn_of_unused(scene: Scene, with_shader: bool, options: Mapping[str, Any]) -> None:
    """Warn of each option that is not at its default and has no effect on an image of the scene."""
    if torch.compiler.is_compiling():
        return
    for name, value in options.items():
        why = why_unused(name, scene, with_shader) if name in DEFAULTS else ""
        if why and (type(value) is not type(DEFAULTS[name]) or value != DEFAULTS[name]):
            warn(f"unused {name}", f"{name}: {value!r} has no effect, for {why}; leave {name}= out")


def why_unused(name: str, scene: Scene, with_shader: bool) -> str:
    """Return the reason why an option has no effect, or an empty string if it has one."""
    if name in LIGHTING and with_shader:
        return "the shader computes the radiance, not the scene's lights and materials"
    if name in LIGHTING and not scene.is_lit:
        return "the scene has neither lights nor materials"
    if name == "check_shader" and not with_shader:
        return "there is no shader"
    if name == "creases" and not with_shader and not scene.is_shaded:
        return "colours and textures show by themselves at which edges they jump"
    return ""
