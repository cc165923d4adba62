"""COLMAP's sparse reconstructions, text and binary, by pycolmap."""

from __future__ import annotations

from pathlib import Path

import torch

from .._files import require
from ..camera import Camera
from .part import Fault
from .views import View


def find(folder: Path) -> Path | None:
    """The reconstruction in a folder: there, or in sparse/0 or sparse as COLMAP lays them; None where there is none."""
    for place in (folder, folder / "sparse" / "0", folder / "sparse"):
        if any((place / f"cameras.{end}").is_file() and (place / f"images.{end}").is_file() for end in ("bin", "txt")):
            return place
    return None


def read(folder: Path, images: Path | None, dtype: torch.dtype) -> dict[str, View]:
    """By the names of the images, those that have a pose. Raises Fault, or ImportError without pycolmap."""
    pycolmap = require("pycolmap", "edgegrad[cameras]", "reading COLMAP's reconstructions")
    for end in ("bin", "txt"):
        if (folder / f"cameras.{end}").is_file() and not (folder / f"points3D.{end}").is_file():
            raise Fault(f"expected points3D.{end} beside cameras.{end}, got none; an empty one will do")
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value  # what is wrong becomes an error here
    try:
        found = pycolmap.Reconstruction(str(folder))
    except Exception as error:
        raise Fault(f"expected a reconstruction of COLMAP, got one that cannot be read ({error})") from error
    places = [images] if images else [folder / "images", folder.parent / "images", folder.parent.parent / "images"]
    views = {}
    for image in sorted(found.images.values(), key=lambda image: image.name):
        if not image.has_pose:
            continue
        camera, pose = image.camera, image.cam_from_world()
        rotation, shift, params = (
            torch.tensor(values, dtype=dtype) for values in (pose.rotation.matrix(), pose.translation, camera.params)
        )
        try:
            made = Camera.from_colmap(rotation, shift, camera.model.name, params, (camera.height, camera.width))
        except ValueError as error:
            raise Fault(f"camera {camera.camera_id} of {image.name!r}: {error}") from error
        file = next((place / image.name for place in places if (place / image.name).is_file()), None)
        views[image.name] = View(made, file)
    return views
