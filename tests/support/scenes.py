"""Small scenes and meshes that many tests share, in float64."""

from __future__ import annotations

from benchmarks.error_time.methods import default_samples
from benchmarks.scenes import (
    cube,
    front_camera,
    icosphere,
    occluded_triangle,
    one_triangle,
    random_slivers,
    smooth_adjoint,
    smooth_colors,
    soup,
)

__all__ = [
    "cube",
    "default_samples",
    "front_camera",
    "icosphere",
    "occluded_triangle",
    "one_triangle",
    "random_slivers",
    "smooth_adjoint",
    "smooth_colors",
    "soup",
]
