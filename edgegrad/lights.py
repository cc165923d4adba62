"""Lights, the class that lights of one's own inherit from, and how shaders draw points of them."""

from .light.by_material import points_by_material
from .scene.environment import Environment
from .scene.lights import AreaLight, DirectionalLight, Light, LightPoints, PointLight, SphericalHarmonics, SpotLight

__all__ = [
    "AreaLight", "DirectionalLight", "Environment", "Light", "LightPoints", "PointLight", "SphericalHarmonics", "SpotLight",
    "points_by_material",
]  # fmt: skip
