"""Lights, and the class that lights of one's own inherit from."""

from .scene.environment import Environment
from .scene.lights import AreaLight, DirectionalLight, Light, LightPoints, PointLight, SphericalHarmonics, SpotLight

__all__ = [
    "AreaLight", "DirectionalLight", "Environment", "Light", "LightPoints", "PointLight", "SphericalHarmonics", "SpotLight",
]  # fmt: skip
