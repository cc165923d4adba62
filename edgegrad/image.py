"""Colours of images: linear, as everywhere in edgegrad, and in sRGB."""

from .files.image import linear_to_srgb, srgb_to_linear

__all__ = ["linear_to_srgb", "srgb_to_linear"]
