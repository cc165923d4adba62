"""What trimesh passes over in OBJ files, and materials of MTL files that scatter light."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...scene.material import Material
from .part import Fault
from .source import Source

# Of MTL, and of its extension for metallic-roughness: maps that nothing reads.
MAPS = (
    "map_ka", "map_ks", "map_ns", "map_ke", "map_pr", "map_pm", "map_ps", "map_bump", "bump", "norm", "disp", "decal",
    "refl", "map_aat", "map_refl",
)  # fmt: skip


def tidy(data: bytes) -> bytes:
    """OBJ text as trimesh expects it: one space after a keyword, none before it, no comments (it looks into them)."""
    text = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    text = re.sub(rb"(?m)^([ \t]*|[vf][^#\n]*)#.*$", rb"\1", text)
    text = re.sub(rb"(?m)^[ \t]*(v|vt|vn|f|o|g|s|usemtl|mtllib)[ \t]+", rb"\1 ", text)
    if len(set(re.findall(rb"(?m)^mtllib (.*?)[ \t]*$", text))) > 1:
        raise Fault("expected one mtllib, got several, and only one would be read; join the .mtl files")
    if re.search(rb"(?m)^f .*?(?<=[ /])0+(?=[ /]|$)", text):
        raise Fault("expected indices that count from 1, got 0 in a face; repair the mesh")
    if re.search(rb"(?m)^f .*-", text) and text.rfind(b"\nv ") > text.find(b"\nf "):
        raise Fault("expected all vertices before faces with negative indices, got some after; export it otherwise")
    return text


class Materials:
    """Materials of an MTL file that scatter light; base colours stay with the parts, which share the rest where it is equal."""

    def __init__(self) -> None:
        self.known: dict[object, Material] = {}

    def get(self, given: Any, source: Source) -> Material:
        """By what trimesh read of one, {} if there is none.

        Lambertian, or, where it has highlights, a dielectric whose roughness says by Ns how sharp they are. Phong's exponent Ns
        is as wide as a lobe of α² = 2 / (Ns + 2), and α = roughness² (Walter et al. 2007, section 5.2).
        """
        for name in MAPS:
            if name in given:
                source.unsupported.note(name)
        metallic, roughness = _number(given, "pm"), _number(given, "pr")
        shiny = _number(given, "illum", 2.0) not in (0.0, 1.0) and any(_numbers(given, "ks"))
        if metallic is None and roughness is None and shiny:
            source.unsupported.note("Ks", "a dielectric of 4 %, by Ns")
            exponent = _number(given, "ns", 0.0)
            assert exponent is not None
            roughness = (2.0 / (max(exponent, 0.0) + 2.0)) ** 0.25
        emission = tuple(_numbers(given, "ke"))
        key = metallic, roughness, emission if any(emission) else None
        if key not in self.known:
            glow = torch.tensor(np.broadcast_to(emission, 3).copy(), dtype=torch.float32) if any(emission) else None
            self.known[key] = Material(metallic=metallic, roughness=roughness, emission=glow)
        return self.known[key]


def alpha(given: Any, source: Source) -> Tensor | None:
    """(h, w) float32: d times map_d, the alpha of an image or else its grey, where either is less than one."""
    opacity = _number(given, "d", 1.0)
    assert opacity is not None
    if _number(given, "tr", 0.0):
        source.unsupported.note("Tr", "left out, for writers differ in what 1 means; d says it")
    if opacity < 1.0:
        source.unsupported.note("d", "shown where it is 0.5 or more, cut out elsewhere")
    if "map_d" not in given:
        return torch.full((1, 1), opacity) if opacity < 0.5 else None
    name = " ".join(given["map_d"])
    image = source.folder.image(name)
    grey = source.textures.data(name, image, slice(0, 1))[..., 0]
    own = source.textures.alpha(image, opacity)
    return opacity * grey if own is None else own


def _numbers(given: Any, name: str) -> list[float]:
    """trimesh gives numbers, lists of numbers, or lists of words."""
    try:
        values = [float(v) for v in np.atleast_1d(given.get(name, []))]
    except ValueError as error:
        raise Fault(f"expected numbers for {name} in the material, got {given[name]}; repair it") from error
    if not np.isfinite(values).all():
        raise Fault(f"expected finite numbers for {name} in the material, got {values}; repair it")
    return values


def _number(given: Any, name: str, default: float | None = None) -> float | None:
    values = _numbers(given, name)
    return values[0] if values else default
