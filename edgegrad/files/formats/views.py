"""A camera and the image that it took."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from ...camera.camera import Camera


class View(NamedTuple):
    """What load_cameras() finds of each image."""

    camera: Camera
    image: Path | None  # the image's file; None where none is named, or none found: see load_cameras
