"""Cameras in files: this library's JSON, glTF, COLMAP, NeRF's transforms.json, and calibrations."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import torch

from ..camera.camera import Camera
from ..check import check_dtype, check_positive_int
from .formats import calibration, colmap, transforms
from .formats.context import UnreadLog
from .formats.part import FormatError, errors_with_path
from .formats.views import View, matched
from .parts import GLTFS, read_cameras
from .paths import PathLike, check_readable, check_suffix, write_json

CALIBRATIONS = (".yml", ".yaml", ".xml")
UNREAD = "not all of it is read"
SINGLE_EYE_ROUNDING = 1e-4  # units by which float32 may move the eyes of cameras that have no distance to compare with


def save_camera(path: PathLike, camera: Camera) -> None:
    """Write a camera, or a batch, as JSON. Missing folders are made.

    The keys are world_to_camera, K (rows, in pixels), size [H, W], projection and, of a lens that distorts, distortion.

    Parameters
    ----------
    path, camera : str or Path that ends in .json, Camera
        Others raise TypeError or ValueError; OSError where it cannot be written.
    """
    file = check_suffix(path, (".json",))
    if not isinstance(camera, Camera):
        raise TypeError(f"camera: expected a Camera, got {type(camera).__name__}")
    write_json(file, camera_fields(camera), indent=1)


def camera_fields(camera: Camera) -> dict[str, Any]:
    """Return a camera as JSON has it."""
    fields = {"world_to_camera": camera.world_to_camera.tolist(), "K": camera.K.tolist(), "size": list(camera.size)}
    lens = {} if camera.distortion is None else {"distortion": camera.distortion.tolist()}
    return {**fields, "projection": camera.projection, **lens}


def load_camera(
    path: PathLike, dtype: torch.dtype | None = None, size: tuple[int, int] | None = None, index: int = 0
) -> Camera:
    """Return a camera that save_camera() wrote, or one of a glTF or GLB file in its place in the scene.

    The JSON may lack "projection" (perspective) and "distortion" (none). Raises FileNotFoundError, TypeError, or ValueError
    that names the file and the key.

    Parameters
    ----------
    path : str or Path
    dtype : torch.float32, torch.float64 or None
        As in load_cameras().
    size : (H, W), only of a glTF
        Size in pixels, which a glTF does not state. Pixels are square: the height of view counts, aspectRatio does not.
    index : int, default 0
        Number of the camera in a glTF, in the order of their nodes.
    """
    file = check_readable(path, (".json", *GLTFS))
    is_gltf = file.suffix.lower() in GLTFS
    if not is_gltf and (size is not None or index != 0):
        raise ValueError(
            f"{path}: expected neither size nor index for a JSON file, which says its size; leave them out"
        )
    with errors_with_path(path):
        camera = _gltf_camera(path, size, index) if is_gltf else camera_from_fields(_json(file))
    return _typed(path, [camera], dtype, UnreadLog())[0]


def _json(file: Path) -> Any:
    try:
        return json.loads(file.read_bytes())  # in UTF-8, UTF-16 or UTF-32, with a byte order mark or without
    except UnicodeDecodeError as error:
        raise FormatError(
            f"expected JSON in UTF-8, got text in another encoding ({error}); save it as UTF-8"
        ) from error
    except (ValueError, RecursionError) as error:
        raise FormatError(f"expected JSON, got something else ({error}); export it again") from error


def camera_from_fields(fields: Any) -> Camera:
    """Return the camera of save_camera()'s keys in float64. Raises FormatError."""
    known = {"world_to_camera", "K", "size", "projection", "distortion"}
    try:
        if isinstance(fields, dict) and "frames" in fields:
            raise ValueError("expected one camera, got the frames of a transforms.json; read it by load_cameras()")
        if not isinstance(fields, dict) or not known & set(fields):
            got = ", ".join(sorted(fields)) or "an empty object" if isinstance(fields, dict) else type(fields).__name__
            raise ValueError(
                f"expected a JSON object with {', '.join(sorted(known))}, as save_camera writes it, or with frames, as a "
                f"transforms.json, which load_cameras reads; got {got}"
            )
        for key in sorted(known - {"projection", "distortion"} - set(fields)):
            raise ValueError(f"{key}: expected this key, got only {', '.join(sorted(fields)) or 'an empty object'}")
        for key in sorted(set(fields) - known):
            raise ValueError(f"{key}: expected only the keys {', '.join(sorted(known))}; remove it")
        for key in ("world_to_camera", "K", "distortion")[: 3 if "distortion" in fields else 2]:
            try:
                fields[key] = torch.tensor(fields[key], dtype=torch.float64)
            except (TypeError, ValueError) as error:
                raise ValueError(f"{key}: expected rows of numbers ({error})") from error
        if not isinstance(fields["size"], list):
            raise ValueError(f"size: expected [height, width], got {fields['size']!r}")
        return Camera(**fields)
    except (TypeError, ValueError) as error:
        raise FormatError(str(error)) from error


def _gltf_camera(path: PathLike, size: tuple[int, int] | None, index: int) -> Camera:
    found = list(_gltf_cameras(path, size).values())
    if not isinstance(index, int) or not 0 <= index < len(found):
        raise ValueError(f"index: expected that of one of {len(found)} cameras in the file, from 0, got {index!r}")
    if isinstance(camera := found[index], FormatError):
        raise camera
    return camera


def _gltf_cameras(path: PathLike, size: tuple[int, int] | None) -> dict[str, Camera | FormatError]:
    if size is None:
        raise ValueError("size: expected (height, width) in pixels for the cameras of a glTF, got None; pass size=")
    return read_cameras(path, _whole(size))


def load_cameras(
    path: PathLike,
    size: tuple[int, int] | None = None,
    images: PathLike | None = None,
    dtype: torch.dtype | None = None,
) -> dict[str, View]:
    """Return the cameras of a file or folder by name, each with its image: `View(camera, image)`.

    A camera describes the pixels that its image stores: read_image(view.image) applies no EXIF orientation, unless the
    camera's size shows that it describes the upright image. Where an image has another size than the file of cameras says, a
    warning tells which. The camera is then scaled to the image, or View.image is None where the sizes are not in proportion.

    - COLMAP: a folder with cameras and images, text or binary, or with sparse/0 in it; names are the images'.
    - transforms.json of NeRF, instant-ngp and nerfstudio; names are the frames' file_path. A frame's own keys take precedence
      over the file's, whatever the key: its camera_angle_x over the file's fl_x. Keys that are null count as absent.
    - .yml, .yaml or .xml of OpenCV's calibration program: camera_matrix, distortion_coefficients, image_width, image_height,
      fisheye_model and extrinsic_parameters. A stereo pair is named by its matrices, "M1" and "M2": the first is at the
      origin, the second at R and T, which may stand in extrinsics.yml next to intrinsics.yml.
    - .yaml of ROS (camera_info), by camera_name; and of Kalibr (camchain), pinhole with radtan or equidistant: "cam0", "cam1"
      …, the first at the origin.
    - .gltf and .glb; names are the nodes'. And .json of save_camera(); names are numbers.

    Cameras of one size can be joined by Camera.stack. Distorted lenses are mapped to this library's; where one cannot be, the
    error names it. One warning names all keys that nothing reads, unless cameras do not depend on them. FileNotFoundError,
    TypeError and ValueError name the file; ImportError says that PyYAML is missing (edgegrad[cameras]).

    Parameters
    ----------
    path : str or Path
    size : (H, W)
        Pixels, where the file does not state them.
    images : str or Path
        Folder of COLMAP's images, by default `images` next to the reconstruction or up to two folders above it. Or the folder
        of a transforms.json's images, found by as much of the end of file_path as leads to a file; by default they are next to
        the file or below it.
    dtype : torch.float32, torch.float64 or None
        None: float64 where float32 would move an eye by more than a millionth of the extent of all eyes, as in map
        coordinates, or by more than 1e-4 units where all eyes are at one place; else float32. A warning tells where the
        requested type rounds more than that.
    """
    unread = UnreadLog()
    views = matched(_views(path, size, images, unread), unread)
    cameras = _typed(path, [view.camera for view in views.values()], dtype, unread)
    return {name: View(c, view.image) for (name, view), c in zip(views.items(), cameras, strict=True)}


def _views(path: PathLike, size: tuple[int, int] | None, images: PathLike | None, unread: UnreadLog) -> dict[str, View]:
    folder = Path(path) if isinstance(path, (str, os.PathLike)) else None
    if folder is not None and folder.is_dir():
        place = colmap.find(folder)
        if place is None and (folder / "transforms.json").is_file():
            return _views(folder / "transforms.json", size, images, unread)
        if place is None:
            raise FileNotFoundError(
                f"{path}: expected cameras and images of COLMAP (.bin or .txt) or transforms.json, got a folder without; "
                "name the one that has them"
            )
        with errors_with_path(path):
            views = _some(colmap.read(place, None if images is None else Path(images), unread))
        colmap.note_others(folder, place, unread)
        return views
    file = check_readable(path, (".json", *CALIBRATIONS, *GLTFS))
    whole = None if size is None else _whole(size)
    with errors_with_path(path):
        if file.suffix.lower() != ".json":
            _check_no_images(images)
        if file.suffix.lower() in GLTFS:
            return _views_of_gltf(_gltf_cameras(path, size), unread)
        if file.suffix.lower() in CALIBRATIONS:
            return calibration.read(file, whole, unread)
        fields = _json(file)
        if isinstance(fields, dict) and "frames" in fields:
            return transforms.read(fields, file.parent, None if images is None else Path(images), whole, unread)
        _check_no_images(images)
        camera = camera_from_fields(fields)
        return {str(i): View(one, None) for i, one in enumerate(camera if camera.batch is not None else [camera])}


def _views_of_gltf(found: dict[str, Camera | FormatError], unread: UnreadLog) -> dict[str, View]:
    """Return views of the cameras that can be read, and note the others. Raises FormatError where none can."""
    views = {name: View(camera, None) for name, camera in found.items() if isinstance(camera, Camera)}
    for name, error in found.items():
        if isinstance(error, FormatError):
            if not views:
                raise error
            unread.note(f"camera {name[:60]!r}", f"left out: {error}")
    return _some(views)


def _typed(path: PathLike, cameras: list[Camera], dtype: torch.dtype | None, unread: UnreadLog) -> list[Camera]:
    """Return the cameras in the requested type, by default float64 where float32 would move eyes too far, and warn of what was
    not read."""
    if check_dtype(dtype) is not torch.float64:
        with errors_with_path(path):  # numbers beyond the range of float32
            rounded = [camera.to(torch.float32) for camera in cameras]
        eyes = torch.cat([camera.eye.reshape(-1, 3) for camera in cameras])
        moved = float((torch.cat([c.to(torch.float64).eye.reshape(-1, 3) for c in rounded]) - eyes).abs().max())
        extent = float((eyes.amax(0) - eyes.amin(0)).max())
        precise = moved > (1e-6 * extent if extent > 0.0 else SINGLE_EYE_ROUNDING)
        if precise and dtype is torch.float32:
            unread.note("eyes in float64", f"moved by up to {moved:.2g}, for they are rounded to float32 as dtype says")
        cameras = cameras if precise and dtype is None else rounded
    unread.warn(path, UNREAD)
    return cameras


def _check_no_images(images: PathLike | None) -> None:
    if images is not None:
        raise FormatError("images: expected none for a file that names no images, got a folder; leave it out")


def _some(views: dict[str, View]) -> dict[str, View]:
    if not views:
        raise FormatError("expected cameras, got none; export it with them")
    return views


def _whole(size: tuple[int, int]) -> tuple[int, int]:
    height, width = (check_positive_int("size", side, most=1 << 24) for side in size)
    return height, width
