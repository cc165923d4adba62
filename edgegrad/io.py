"""Meshes, scenes, images and cameras from and to files; see edgegrad.files.load for what is read of each format."""

from .files.cameras import load_camera, load_cameras, save_camera
from .files.depth import read_depth
from .files.formats.views import View
from .files.image import linear_to_srgb, read_image, srgb_to_linear, write_image
from .files.load import load_mesh, load_scene
from .files.mask import read_mask
from .files.save import from_trimesh, save_mesh, save_scene, to_trimesh

__all__ = [
    "View", "from_trimesh", "linear_to_srgb", "load_camera", "load_cameras", "load_mesh", "load_scene", "read_depth",
    "read_image", "read_mask", "save_camera", "save_mesh", "save_scene", "srgb_to_linear", "to_trimesh", "write_image",
]  # fmt: skip
