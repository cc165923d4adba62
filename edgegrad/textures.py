"""Textures of meshes: coordinates for them, and texels from another surface, a function or pictures."""

from .baking import bake, bake_pictures
from .scene.unwrapping import unwrap

__all__ = ["bake", "bake_pictures", "unwrap"]
