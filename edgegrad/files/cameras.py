"""Cameras in files: this library's, and those of others."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import torch

from ..camera.camera import Camera
from ..check import check_positive_int
from .formats import calibration, colmap, transforms
from .formats.part import Fault, naming
from .formats.source import Unsupported
from .formats.views import View, matched
from .parts import GLTFS, read_cameras
from .paths import PathLike, check_readable, check_suffix, replacing

CALIBRATIONS = (".yml", ".yaml", ".xml")
UNREAD = "not all of it is read"
ALONE = 1e-4  # units by which float32 may move the eyes of cameras that have no distance to compare with


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
    path: PathLike, dtype: torch.dtype | None = None, size: tuple[int, int] | None = None, index: int = 0
) -> Camera:
    """A camera as save_camera writes it; "projection" may be left out (perspective), and "distortion" (none). Or one of a glTF or
    GLB file, where it stands in the scene.

    dtype  as in load_cameras
    size   (H, W) of a glTF's camera, which has none; pixels are square, and its height of view counts, not its aspectRatio
    index  which of a glTF's, in the order of their nodes

    Raises FileNotFoundError, TypeError, or ValueError that names the file and the key.
    """
    file = check_readable(path, (".json", *GLTFS))
    if file.suffix.lower() in GLTFS:
        return _typed(path, [_gltf_camera(path, size, index)], dtype, Unsupported())[0]
    if size is not None or index != 0:
        raise ValueError(
            f"{path}: expected neither size nor index for a JSON file, which says its size; leave them out"
        )
    with naming(path):
        camera = _our_camera(_json(file))
    return _typed(path, [camera], dtype, Unsupported())[0]


def _json(file: Path) -> Any:
    """Raises Fault."""
    try:
        return json.loads(file.read_bytes())  # in UTF-8, UTF-16 or UTF-32, with a byte order mark or without
    except UnicodeDecodeError as error:
        raise Fault(f"expected JSON in UTF-8, got text in another encoding ({error}); save it as UTF-8") from error
    except (ValueError, RecursionError) as error:
        raise Fault(f"expected JSON, got something else ({error}); export it again") from error


def _our_camera(fields: Any) -> Camera:
    """In float64. Raises Fault."""
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
        raise Fault(str(error)) from error


def _gltf_camera(path: PathLike, size: tuple[int, int] | None, index: int) -> Camera:
    if size is None:
        raise ValueError(
            f"{path}: size: expected (height, width) in pixels for the camera of a glTF, got None; pass size="
        )
    with naming(path):
        found = list(read_cameras(path, _whole(size)).values())
        if not isinstance(index, int) or not 0 <= index < len(found):
            raise ValueError(f"index: expected that of one of {len(found)} cameras in the file, from 0, got {index!r}")
        return _sound(found[index])


def load_cameras(
    path: PathLike,
    size: tuple[int, int] | None = None,
    images: PathLike | None = None,
    dtype: torch.dtype | None = None,
) -> dict[str, View]:
    """The cameras of a file or folder by name, each with its image: `View(camera, image)`.

    A camera speaks of the pixels that its image stores: read_image(view.image) does not apply an EXIF orientation, unless the
    camera's size tells that it speaks of the upright image. Where an image has another size than the file of cameras says, a
    warning tells which: the camera is scaled to it, or, where they are not in proportion, View.image is None.

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
    images  the folder of COLMAP's images; else `images` beside the reconstruction or up to two folders above. Or that of a
            transforms.json's images, by as much of the end of file_path as leads to one; else they are beside the file or below
    dtype   torch.float32 or torch.float64, of the cameras. None: float64 where float32 would move an eye by more than a millionth
            of the extent of all eyes, as in coordinates of a map, or where all are at one place by more than 1e-4 units; else
            float32. A warning tells where cameras are rounded to less than that, as dtype says

    Stack those of one size by Camera.stack. Distorted lenses are mapped to this library's; where one cannot be, the error names
    it. One warning names what a file says and nobody reads, unless cameras do not depend on it. Raises FileNotFoundError,
    TypeError, ValueError that names the file, or ImportError without OpenCV or PyYAML (edgegrad[cameras]).
    """
    unread = Unsupported()
    views = matched(_views(path, size, images, unread), unread)
    cameras = _typed(path, [view.camera for view in views.values()], dtype, unread)
    return {name: View(c, view.image) for (name, view), c in zip(views.items(), cameras, strict=True)}


def _views(
    path: PathLike, size: tuple[int, int] | None, images: PathLike | None, unread: Unsupported
) -> dict[str, View]:
    """In float64."""
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
        with naming(path):
            views = _some(colmap.read(place, None if images is None else Path(images), unread))
        colmap.note_others(folder, place, unread)
        return views
    file = check_readable(path, (".json", *CALIBRATIONS, *GLTFS))
    whole = None if size is None else _whole(size)
    with naming(path):
        if file.suffix.lower() != ".json":
            _check_no_images(images)
        if file.suffix.lower() in GLTFS:
            if whole is None:
                raise ValueError(
                    "size: expected (height, width) in pixels for the cameras of a glTF, got None; pass size="
                )
            return _of_gltf(read_cameras(path, whole), unread)
        if file.suffix.lower() in CALIBRATIONS:
            return calibration.read(file, whole, unread)
        fields = _json(file)
        if isinstance(fields, dict) and "frames" in fields:
            return transforms.read(fields, file.parent, None if images is None else Path(images), whole, unread)
        _check_no_images(images)
        camera = _our_camera(fields)
        return {str(i): View(one, None) for i, one in enumerate(camera if camera.batch is not None else [camera])}


def _of_gltf(found: dict[str, Camera | Fault], unread: Unsupported) -> dict[str, View]:
    """Return views of the cameras that can be read, and note the others. Raises Fault where none can."""
    views = {name: View(camera, None) for name, camera in found.items() if isinstance(camera, Camera)}
    for name, fault in found.items():
        if isinstance(fault, Fault):
            if not views:
                raise fault
            unread.note(f"camera {name[:60]!r}", f"left out: {fault}")
    return _some(views)


def _sound(camera: Camera | Fault) -> Camera:
    """Raises Fault in place of one."""
    if isinstance(camera, Fault):
        raise camera
    return camera


def _typed(path: PathLike, cameras: list[Camera], dtype: torch.dtype | None, unread: Unsupported) -> list[Camera]:
    """In the type that is wanted, else in float64 where float32 would move eyes too far. Says what there is to say."""
    if dtype not in (None, torch.float32, torch.float64):
        raise TypeError(f"dtype: expected torch.float32, torch.float64 or None, got {dtype!r}")
    if dtype is not torch.float64:
        with naming(path):  # numbers beyond the range of float32
            rounded = [camera.to(torch.float32) for camera in cameras]
        eyes = torch.cat([camera.eye.reshape(-1, 3) for camera in cameras])
        moved = float((torch.cat([c.to(torch.float64).eye.reshape(-1, 3) for c in rounded]) - eyes).abs().max())
        extent = float((eyes.amax(0) - eyes.amin(0)).max())
        precise = moved > (1e-6 * extent if extent > 0.0 else ALONE)
        if precise and dtype is torch.float32:
            unread.note("eyes in float64", f"moved by up to {moved:.2g}, for they are rounded to float32 as dtype says")
        cameras = cameras if precise and dtype is None else rounded
    unread.say(path, UNREAD)
    return cameras


def _check_no_images(images: PathLike | None) -> None:
    if images is not None:
        raise Fault("images: expected none for a file that names no images, got a folder; leave it out")


def _some(views: dict[str, View]) -> dict[str, View]:
    if not views:
        raise Fault("expected cameras, got none; export it with them")
    return views


def _whole(size: tuple[int, int]) -> tuple[int, int]:
    height, width = (check_positive_int("size", side, most=1 << 24) for side in size)
    return height, width
