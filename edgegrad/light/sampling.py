"""How points of lights with an extent are drawn for surfaces: what the kernel's samplers (csrc/shading/lit/light_sample.h,
mesh_light_sampling.h) need of meshes that emit."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from ..library import core
from ..points.records import values_of
from ..scene.environment import UNIFORM_SHARE, Environment
from ..scene.mesh_light import MeshLight
from ..scene.scene import Scene

# Where radiance has derivatives, points are drawn as if no surface were darker, for what is black has derivatives too.
DARK = 0.05

_trees: WeakKeyDictionary[MeshLight, Any] = WeakKeyDictionary()


def tree_of(light: MeshLight) -> Any:
    """Return the kernel's tree of the faces, or None where there are too many of them."""
    if len(light.mesh.faces) > core.MOST_EMISSIVE_FACES:
        return None
    if light not in _trees:
        verts, faces = values_of(light.mesh.verts.detach().double(), light.mesh.faces)
        _trees[light] = core.EmissiveFaceTree(np.ascontiguousarray(verts), faces.astype(np.int32))
    return _trees[light]


def hides(light: MeshLight) -> bool:
    """Return whether near faces hide far ones, as none is alpha-tested."""
    return light.mesh.alpha is None


def least_brightness(light: MeshLight) -> float:
    """Return what is added to the brightness of a light, so that dark parts have a gradient too."""
    mean = float(light.mean_emission)
    return UNIFORM_SHARE * mean if mean > 0 else 1.0


def how_drawn(scene: Scene) -> str:
    """Return what plan() says of points of lights: by what they are drawn, and why."""
    skies = sum(isinstance(light, Environment) for light in scene.casting)
    lights = [light for light in scene.casting if isinstance(light, MeshLight)]
    if not (skies or lights):
        return ""
    materials = [mesh.material for mesh in scene.meshes if mesh.material is not None]
    if not any(material.is_glossy for material in materials):
        return ", drawn by the light, for no surface is glossy"
    of = ["skies"] * (skies > 0) + ["meshes that emit"] * (len(lights) > 0)
    said = f"; on glossy surfaces of {core.CANDIDATES_FOR_ONE} candidates for each, by light and, "
    said += f"up to roughness {core.WIDEST_LOBE}, by lobe"
    said += f", one is kept by what it gives ({', '.join(of)})"
    if lights:
        said += "; a light well within the lobe by the light alone, of a round one directions to a ball around it"
    if any(tree_of(light) is None for light in lights):
        said += "; lights of too many faces by the light alone"
    return said
