"""Lights, the class that lights of one's own inherit from, and how shaders draw points of them.

Area lights are meshes that emit: `eg.shapes.rectangle(material=eg.Material(base_color=0.0, emission=…))`.
"""

from .light.by_material import points_by_material
from .scene.environment import Environment
from .scene.lights import DirectionalLight, Light, LightPoints, PointLight, SphericalHarmonics, SpotLight

__all__ = [
    "DirectionalLight", "Environment", "Light", "LightPoints", "PointLight", "SphericalHarmonics", "SpotLight",
    "points_by_material",
]  # fmt: skip
