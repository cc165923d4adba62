"""Images from and to files, and their colours."""

from .files.image import linear_to_srgb, read_image, srgb_to_linear, write_image

__all__ = ["linear_to_srgb", "read_image", "srgb_to_linear", "write_image"]
