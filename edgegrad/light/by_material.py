"""Points of lights for shaders, drawn as those of render() are: by what the materials of surfaces make of them."""

from __future__ import annotations

import torch

from ..points.hits import Hits
from ..points.surfaces import CameraView
from ..scene.lights import Light, LightPoints
from . import in_kernel


@torch.no_grad()
def points_by_material(hits: Hits, light: Light, samples: int) -> list[LightPoints]:
    """Return points of a light for each of the hits, as many as `samples`.

    Those of a light whose shadow boundary is sampled are given. For hits of trace(), each of which has another viewer, they are
    drawn by what the light emits.
    """
    if not isinstance(hits, Hits):
        raise TypeError(f"hits: expected Hits, got {type(hits).__name__}")
    if not isinstance(light, Light):
        raise TypeError(f"light: expected one of hits.lights, got {type(light).__name__}")
    if light.punctual or hits._knows_light(light) or not isinstance(hits._view, CameraView):
        return [hits.light_points(light, k, samples) for k in range(samples)]
    return in_kernel.light_points(hits, light, samples)
