"""Cameras in files: this library's, and those of others."""

from __future__ import annotations

import json
import os
from pathlib import Path

import torch

from ..camera.camera import Camera
from ..check import check_positive_int
from .formats import calibration, colmap, transforms
from .formats.part import Fault, naming
from .formats.source import Unsupported
from .formats.views import View
from .parts import GLTFS, read_cameras
from .paths import PathLike, check_readable, check_suffix, replacing

CALIBRATIONS = (".yml", ".yaml", ".xml")
UNREAD = "not all of it is read"


def save_camera(path: PathLike, camera: Camera) -> None:
    """Writes a camera, or a batch, as JSON: world_to_camera, K (rows, in pixels), size [H, W], projection, and
    distortion if it has any.

    Missing folders are made. Raises ValueError (a name that does not end in .json), TypeError or OSError.
    """
    file = check_suffix(path, (".json",))
    if not isinstance(camera, Camera):
        raise TypeError(f"camera: expected a Camera, got {type(camera).__name__}")
    fields = {
        "world_to_camera": camera.world_to_camera.tolist(),
        "K": camera.K.tolist(),
        "size": list(camera.size),
        "projection": camera.projection,
    }
    if camera.distortion is not None:
        fields["distortion"] = camera.distortion.tolist()
    with replacing(file) as temporary:
        temporary.write_text(json.dumps(fields, indent=1) + "\n", encoding="utf-8")


def load_camera(
    path: PathLike, dtype: torch.dtype = torch.float32, size: tuple[int, int] | None = None, index: int = 0
) -> Camera:
    """A camera as save_camera writes it; "projection" may be left out (perspective), and "distortion" (none). Or one of a glTF or
    GLB file, where it stands in the scene.

    size   (H, W) of a glTF's camera, which has none; pixels are square, and its height of view counts, not its aspectRatio
    index  which of a glTF's, in the order of their nodes

    Raises FileNotFoundError, TypeError, or ValueError that names the file and the key.
    """
    file = check_readable(path, (".json", *GLTFS))
    if file.suffix.lower() in GLTFS:
        return _gltf_camera(path, dtype, size, index)
    if size is not None or index != 0:
        raise ValueError(
            f"{path}: expected neither size nor index for a JSON file, which says its size; leave them out"
        )
    known = {"world_to_camera", "K", "size", "projection", "distortion"}
    try:
        fields = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(fields, dict):
            raise ValueError(f"expected a JSON object with {', '.join(sorted(known))}, got {type(fields).__name__}")
        for key in sorted(known - {"projection", "distortion"} - set(fields)):
            raise ValueError(f"{key}: expected this key, got only {', '.join(sorted(fields)) or 'an empty object'}")
        for key in sorted(set(fields) - known):
            raise ValueError(f"{key}: expected only the keys {', '.join(sorted(known))}; remove it")
        for key in ("world_to_camera", "K", "distortion")[: 3 if "distortion" in fields else 2]:
            try:
                fields[key] = torch.tensor(fields[key], dtype=dtype)
            except (TypeError, ValueError) as error:
                raise ValueError(f"{key}: expected rows of numbers ({error})") from error
        if not isinstance(fields["size"], list):
            raise ValueError(f"size: expected [height, width], got {fields['size']!r}")
        return Camera(**fields)
    except (TypeError, ValueError) as error:  # what json and UTF-8 raise are ValueErrors too
        raise ValueError(f"{path}: {error}") from error


def _gltf_camera(path: PathLike, dtype: torch.dtype, size: tuple[int, int] | None, index: int) -> Camera:
    if size is None:
        raise ValueError(
            f"{path}: size: expected (height, width) in pixels for the camera of a glTF, got None; pass size="
        )
    with naming(path):
        found = read_cameras(path, _whole(size), dtype)
        if not isinstance(index, int) or not 0 <= index < len(found):
            raise ValueError(f"index: expected that of one of {len(found)} cameras in the file, from 0, got {index!r}")
        return list(found.values())[index]


def load_cameras(
    path: PathLike,
    size: tuple[int, int] | None = None,
    images: PathLike | None = None,
    dtype: torch.dtype = torch.float32,
) -> dict[str, View]:
    """The cameras of a file or folder by name, each with its image: `View(camera, image)`.

    - a folder with COLMAP's cameras and images, text or binary, or with sparse/0 in it; names are the images'
    - transforms.json of NeRF, instant-ngp and nerfstudio; names are the frames' file_path. What a frame says goes before what the
      file says of all, whatever the key: its camera_angle_x before the file's fl_x. Keys that are null count as absent
    - .yml, .yaml or .xml of OpenCV's calibration: camera_matrix, distortion_coefficients, image_width, image_height,
      fisheye_model and extrinsic_parameters, as its calibration program has them. A stereo pair by the names of its matrices,
      "M1" and "M2": the first at the origin, the second by R and T, which may stand in extrinsics.yml beside intrinsics.yml
    - .yaml of ROS (camera_info), by camera_name; and of Kalibr (camchain), pinhole with radtan or equidistant: "cam0", "cam1" …,
      the first at the origin
    - .gltf and .glb; names are the nodes'
    - .json of save_camera; names are numbers

    size    (H, W) pixels, where the file does not say it
    images  the folder of COLMAP's images; else `images` beside the reconstruction or up to two folders above
    dtype   of the cameras

    Stack those of one size by Camera.stack. Distorted lenses are mapped to this library's; where one cannot be, the error names
    it. One warning names what a file says and nobody reads, unless cameras do not depend on it. Raises FileNotFoundError,
    TypeError, ValueError that names the file, or ImportError without OpenCV or PyYAML (edgegrad[cameras]).
    """
    folder = Path(path) if isinstance(path, (str, os.PathLike)) else None
    if folder is not None and folder.is_dir():
        place, unread = colmap.find(folder), Unsupported()
        if place is None and (folder / "transforms.json").is_file():
            return load_cameras(folder / "transforms.json", size, images, dtype)
        if place is None:
            raise FileNotFoundError(
                f"{path}: expected cameras and images of COLMAP (.bin or .txt) or transforms.json, got a folder without; "
                "name the one that has them"
            )
        with naming(path):
            views = _some(colmap.read(place, None if images is None else Path(images), dtype, unread))
        colmap.note_others(folder, place, unread)
        unread.say(path, UNREAD)
        return views
    file = check_readable(path, (".json", *CALIBRATIONS, *GLTFS))
    whole, unread = None if size is None else _whole(size), Unsupported()
    with naming(path):
        if file.suffix.lower() in GLTFS:
            if whole is None:
                raise ValueError(
                    "size: expected (height, width) in pixels for the cameras of a glTF, got None; pass size="
                )
            return _some({name: View(camera, None) for name, camera in read_cameras(path, whole, dtype).items()})
        if file.suffix.lower() in CALIBRATIONS:
            views = calibration.read(file, whole, dtype, unread)
            unread.say(path, UNREAD)
            return views
        fields = json.loads(file.read_text(encoding="utf-8"))
        if isinstance(fields, dict) and "frames" in fields:
            views = transforms.read(fields, file.parent, whole, dtype, unread)
            unread.say(path, UNREAD)
            return views
        camera = load_camera(path, dtype)
        return {str(i): View(one, None) for i, one in enumerate(camera if camera.batch is not None else [camera])}


def _some(views: dict[str, View]) -> dict[str, View]:
    if not views:
        raise Fault("expected cameras, got none; export it with them")
    return views


def _whole(size: tuple[int, int]) -> tuple[int, int]:
    height, width = (check_positive_int("size", side, most=1 << 24) for side in size)
    return height, width
