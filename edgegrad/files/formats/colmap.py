"""COLMAP's sparse reconstructions, text and binary: their cameras and poses (its documentation, "Output Format").

They are read here because pycolmap ends the process where a file is damaged.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from itertools import zip_longest
from os.path import isfile  # False also of names that no file can have
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import NamedTuple

import torch

from ...camera.camera import Camera
from .context import UnreadLog
from .part import FormatError
from .views import View

# Models by their number in binary files, with how many parameters they have.
MODELS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8, "FULL_OPENCV": 12,
    "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12, "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4, "EUCM": 6, "EQUIRECTANGULAR": 2,
}  # fmt: skip
POINT = struct.calcsize("<ddq")  # of an image: x, y and the 3D point


class ColmapCamera(NamedTuple):
    model: str
    size: tuple[int, int]  # (H, W)
    params: list[float]


class ColmapImage(NamedTuple):
    pose: list[float]  # quaternion w, x, y, z and translation, world to camera
    camera: int
    name: str


def find(folder: Path) -> Path | None:
    """Return the reconstruction in a folder, or in its sparse/0 or sparse as COLMAP lays them; None where there is none."""
    for place in (folder, folder / "sparse" / "0", folder / "sparse"):
        if any((place / f"cameras.{end}").is_file() and (place / f"images.{end}").is_file() for end in ("bin", "txt")):
            return place
    return None


def note_others(folder: Path, place: Path, unread: UnreadLog) -> None:
    """Note reconstructions next to sparse/0, which COLMAP makes where it cannot connect some images to others."""
    if place == folder / "sparse" / "0":
        for other in sorted(place.parent.iterdir()):
            if other != place and other.is_dir() and find(other) == other:
                unread.note(f"sparse/{other.name}", "a reconstruction of its own; load it by its folder")


def read(folder: Path, images: Path | None, unread: UnreadLog) -> dict[str, View]:
    """Return views by the names of the images that have a pose, in their order. Raises FormatError."""
    binary = all((folder / f"{name}.bin").is_file() for name in ("cameras", "images"))
    cameras_file, images_file = (folder / f"{name}.{'bin' if binary else 'txt'}" for name in ("cameras", "images"))
    try:
        if binary:
            cameras_data, images_data = _BinaryReader(cameras_file), _BinaryReader(images_file)
            cameras, found = _cameras(cameras_data), list(_images(images_data))
            for file, data in ((cameras_file, cameras_data), (images_file, images_data)):
                if left := len(data.data) - data.at:
                    unread.note(f"{left} bytes at the end of {file.name}")
        else:
            cameras, found = _cameras_of_text(_lines(cameras_file)), list(_images_of_text(_lines(images_file)))
    except (struct.error, ValueError, IndexError) as error:
        raise FormatError(
            f"expected a reconstruction of COLMAP, got one that cannot be read ({error}); export it again"
        ) from error
    places = [images] if images else [folder / "images", folder.parent / "images", folder.parent.parent / "images"]
    views: dict[str, View] = {}
    for image in sorted(found, key=lambda image: image.name):
        try:
            given = cameras[image.camera]
            pose = torch.tensor(image.pose, dtype=torch.float64)
            camera = Camera.from_colmap(
                pose[:4], pose[4:], given.model, torch.tensor(given.params, dtype=torch.float64), given.size
            )
        except KeyError:
            raise FormatError(
                f"{image.name!r}: expected its camera {image.camera}, got none; export it again"
            ) from None
        except ValueError as error:
            raise FormatError(f"camera {image.camera} of {image.name!r}: {error}") from error
        if image.name in views:
            raise FormatError(f"{image.name!r}: expected one image of this name, got two; export it again")
        views[image.name] = View(camera, _file(places, image.name))
    lost = [name for name, view in views.items() if view.image is None]
    if lost and (images is not None or len(lost) < len(views)):
        unread.note(f"{len(lost)} of {len(views)} images, as {lost[0]!r}", "no such file: its View.image is None")
    return views


def _file(places: list[Path], name: str) -> Path | None:
    if PurePosixPath(name).is_absolute() or PureWindowsPath(name).drive or ".." in PurePosixPath(name).parts:
        return None
    return next((place / name for place in places if isfile(place / name)), None)


# -- binary: little-endian -------------------------------------------------------------------------------------------------


class _BinaryReader:
    def __init__(self, file: Path) -> None:
        self.data, self.at = file.read_bytes(), 0

    def take(self, layout: str) -> tuple:
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += struct.calcsize("<" + layout)
        return values

    def text(self) -> str:
        end = self.data.index(b"\0", self.at)
        start, self.at = self.at, end + 1
        return os.fsdecode(self.data[start:end])


def _cameras(data: _BinaryReader) -> dict[int, ColmapCamera]:
    cameras = {}
    for _ in range(*data.take("Q")):
        index, number, width, height = data.take("iiQQ")
        if not 0 <= number < len(MODELS):
            raise ValueError(f"camera {index} of model {number}, which is not known")
        model, count = list(MODELS.items())[number]
        cameras[index] = ColmapCamera(model, (height, width), list(data.take(f"{count}d")))
    return cameras


def _images(data: _BinaryReader) -> Iterator[ColmapImage]:
    for _ in range(*data.take("Q")):
        index, *pose, camera = data.take("I7dI")
        yield ColmapImage(pose, camera, data.text())
        (points,) = data.take("Q")
        data.at += points * POINT
        if data.at > len(data.data):
            raise ValueError(f"image {index} announces {points} points, more than the file holds")


# -- text ---------------------------------------------------------------------------------------------------------------------


def _lines(file: Path) -> list[str]:
    return [line for line in os.fsdecode(file.read_bytes()).splitlines() if not line.startswith("#")]


def _cameras_of_text(lines: list[str]) -> dict[int, ColmapCamera]:
    cameras = {}
    for index, model, width, height, *params in map(str.split, filter(str.strip, lines)):
        cameras[int(index)] = ColmapCamera(model, (int(height), int(width)), [float(value) for value in params])
    return cameras


def _images_of_text(lines: list[str]) -> Iterator[ColmapImage]:
    """Yield the images, of two lines each; the second line, with its points, may be empty."""
    while lines and not lines[-1].strip():
        lines.pop()
    for line, points in zip_longest(lines[::2], lines[1::2], fillvalue=""):
        index, *numbers, name = line.split(maxsplit=9)
        if len(places := points.split()) % 3 or (places and not places[-1].lstrip("-").isdecimal()):
            raise ValueError(f"image {index} is not followed by a line of its points, which may be empty")
        yield ColmapImage([float(value) for value in numbers[:7]], int(numbers[7]), name)
