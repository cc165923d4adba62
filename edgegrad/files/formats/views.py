"""A camera and the image that it took."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from ...camera.camera import Camera
from ..image import read_size
from ..paths import StoredPath
from .context import UnreadLog


class View(NamedTuple):
    """A camera of load_cameras() with its image.

    Parameters
    ----------
    camera : Camera
    image : Path or None
        File whose pixels read_image() reads as the camera describes them; None where none is named, found or fits: see
        load_cameras.
    """

    camera: Camera
    # The image's file, whose pixels read_image() reads as the camera speaks of them; None where none is named, found or fits:
    # see load_cameras.
    image: Path | None


def resized(camera: Camera, size: tuple[int, int]) -> Camera | None:
    """Return the camera for (H, W) pixels, or None where these are not in proportion to its own."""
    (H, W), (h, w) = size, camera.size
    # A scaled size ends less than a pixel from the other one, because sizes of scaled images are rounded.
    return camera.resized(size) if abs(H * w - W * h) <= max(H, W, h, w) else None


def matched(views: Mapping[str, View], unread: UnreadLog) -> dict[str, View]:
    """Return views whose cameras have the sizes of their images, and note scaled cameras and images that do not fit. A camera
    describes the pixels that are stored. Where the upright image alone is in proportion to it, it describes that one. Where
    neither is, the view loses its image."""
    found: dict[str, View] = {}
    scaled: list[str] = []
    unfit: list[str] = []
    for name, (camera, image) in views.items():
        found[name] = View(camera, image) if image is None else _matched(camera, image)
        own, pixels = found[name], f"{camera.size[1]} × {camera.size[0]} pixels in the file of cameras"
        if image is not None and own.image is None:
            unfit.append(f"{name!r} ({_pixels(read_size(StoredPath(image)))}, {pixels})")
        elif own.camera.size != camera.size:
            scaled.append(f"{name!r} ({_pixels(own.camera.size)}, {pixels})")
    if scaled:
        unread.note(f"the size of {len(scaled)} of {len(views)} images, as {scaled[0]}", "cameras scaled to the images")
    if unfit:
        unread.note(
            f"{len(unfit)} of {len(views)} images, as {unfit[0]}",
            "not in proportion, so View.image is None; pass the folder of the images that were calibrated as images=, or crop "
            "the camera by camera.crop()",
        )
    return found


def _matched(camera: Camera, image: Path) -> View:
    stored = StoredPath(image)
    try:
        for file in (stored, image):
            if (fitting := resized(camera, read_size(file))) is not None:
                return View(fitting, file)
    except (PermissionError, ValueError):
        return View(camera, stored)  # read_image() says what is wrong with the file
    return View(camera, None)


def _pixels(size: tuple[int, int]) -> str:
    return f"{size[1]} × {size[0]}"
