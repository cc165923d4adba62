"""Images from and to files, and their colours."""

from .files.depth import read_depth
from .files.image import linear_to_srgb, read_image, srgb_to_linear, write_image
from .files.mask import read_mask

__all__ = ["linear_to_srgb", "read_depth", "read_image", "read_mask", "srgb_to_linear", "write_image"]
