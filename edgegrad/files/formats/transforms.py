"""NeRF's transforms.json, as instant-ngp, nerfstudio and the synthetic scenes have it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from os.path import isfile, normpath  # isfile: False also of names that no file can have
from pathlib import Path, PureWindowsPath
from typing import Any, NamedTuple

import torch

from ...camera.camera import Camera
from ..image import IMAGES, read_size
from ..paths import StoredPath
from .context import UnreadLog, unique_name
from .keys import image_size, note_unread
from .part import FormatError
from .views import View

PINHOLES, FISHEYES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV"), ("OPENCV_FISHEYE",)
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
READ = {
    "frames", "file_path", "transform_matrix", "w", "h", "fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "cx", "cy",
    "camera_model", "is_fisheye", *COEFFICIENTS,
}  # fmt: skip
# Cameras and images do not depend on these: how instant-ngp trains, where nerfstudio's points and lists of images are.
HARMLESS = {
    "aabb", "aabb_scale", "scale", "offset", "up", "sharpness", "n_frames", "n_extra_learnable_dims", "render_aabb",
    "enable_depth_loading", "enable_ray_loading", "integer_depth_scale", "white_transparent", "black_transparent", "fix_premult",
    "colmap_im_id", "ply_file_path", "train_filenames", "val_filenames", "test_filenames", "depth_file_path", "depth_path",
    "rotation", "orientation_override", "camera_label", "bounding_box",
}  # fmt: skip
INSTEAD = {
    "applied_transform": "cameras stay in the world that it made, not in that from before",
    "applied_scale": "cameras stay in the world that it made, not in that from before",
    "mask_path": "left out; read_mask() reads it",
}


class Found(NamedTuple):
    file: Path | None
    outside: bool  # of the folder, which is not searched


def read(
    fields: Mapping[str, Any], folder: Path, images: Path | None, size: tuple[int, int] | None, unread: UnreadLog
) -> dict[str, View]:
    """Return views by the frames' file_path. A frame's own keys take precedence over the file's. Raises FormatError. Images lie
    in `folder`, that of the file, or below it; or in `images` or below it."""
    frames = fields["frames"]
    if not isinstance(frames, list) or not frames:
        raise FormatError("frames: expected a list of frames, got none; export it again")
    shared = _given(fields)
    views: dict[str, View] = {}
    lost: list[str] = []
    outside: list[str] = []
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict) or "transform_matrix" not in frame:
            raise FormatError(f"frames[{i}]: expected transform_matrix, 4 × 4, got none; export it again")
        own = _given(frame)
        name = str(own.get("file_path", i))
        try:
            found = Found(None, False)
            if "file_path" in own:
                found = _next_to(folder, name) if images is None else Found(_below(images, name), False)
                if found.file is None:
                    (outside if found.outside else lost).append(name)
            view = View(_camera(own, shared, found, size), found.file)
        except (FormatError, TypeError, ValueError, KeyError, OverflowError) as error:
            raise FormatError(f"frames[{i}], {name}: {error}") from error
        views[unique_name(views, name, f"{name} (frame {i})")] = view
        note_unread(own, READ | HARMLESS, unread, INSTEAD)
    note_unread(shared, READ | HARMLESS, unread, INSTEAD)
    for names, why in (
        (lost, "no such file"),
        (outside, "outside of the file's folder, where nobody looks; pass their folder as images="),
    ):
        if names:
            unread.note(f"{len(names)} of {len(frames)} images, as {names[0]!r}", f"View.image is None: {why}")
    _check_apart(views, images)
    return views


def _check_apart(views: Mapping[str, View], images: Path | None) -> None:
    """Raise FormatError where two paths lead to one file."""
    known: dict[Path, tuple[str, tuple[str, ...]]] = {}
    for name, view in views.items():
        if images is not None and view.image is not None:
            other, parts = known.setdefault(view.image, (name, _parts(name)))
            if parts != _parts(name) and " (frame " not in name:
                raise FormatError(
                    f"images: expected a folder that has {other!r} and {name!r} apart, got {images}, where both are "
                    f"{view.image.name}; pass the one above"
                )


def _given(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys that are not null."""
    return {key: value for key, value in fields.items() if value is not None}


def _next_to(folder: Path, name: str) -> Found:
    """Look next to the file or below it. The synthetic scenes leave out the ending, and Windows writes backslashes."""
    inside = folder.resolve()
    outside = PureWindowsPath(name).is_absolute() or normpath(name.replace("\\", "/")).startswith(("..", "/"))
    for stem in dict.fromkeys((name, name.replace("\\", "/"))):
        for ending in ("", *IMAGES):
            file = folder / f"{stem}{ending}"
            if isfile(file):
                if file.resolve().is_relative_to(inside):
                    return Found(file, False)
                outside = True
    return Found(None, outside)


def _below(images: Path, name: str) -> Path | None:
    """Look for as much of the path's end as leads to a file."""
    parts = _parts(name)
    for first in range(len(parts)):
        for ending in ("", *IMAGES):
            file = images.joinpath(*parts[first:-1], f"{parts[-1]}{ending}")
            if isfile(file):
                return file
    return None


def _parts(name: str) -> tuple[str, ...]:
    return tuple(part for part in name.replace("\\", "/").split("/") if part not in ("", ".", "..") and ":" not in part)


def _camera(own: Mapping[str, Any], shared: Mapping[str, Any], found: Found, size: tuple[int, int] | None) -> Camera:
    given = {**shared, **own}
    if "w" in given and "h" in given:
        H, W = image_size(float(given["w"]), float(given["h"]))
    elif size is not None:
        H, W = size
    elif found.file is not None:
        H, W = read_size(StoredPath(found.file))
    else:
        why = ": it is outside of the file's folder, where nobody looks" * found.outside
        raise ValueError(
            f"w and h: expected the image's size, or the image itself, got neither{why}; pass size=(height, width), or the "
            "images' folder as images="
        )
    pose = torch.tensor(given["transform_matrix"], dtype=torch.float64)
    model = _model(own, shared)
    fx, fy = _focals(own, shared, (W, H))
    cx, cy = float(given.get("cx", 0.5 * W)), float(given.get("cy", 0.5 * H))
    K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)
    k1, k2, k3, k4, p1, p2 = (float(given.get(key, 0.0)) for key in COEFFICIENTS)
    camera = Camera.from_opengl(pose, (H, W), K=K)
    if model in FISHEYES:
        if p1 or p2:
            raise ValueError(f"p1, p2: expected 0 of a fisheye, got {p1:g} and {p2:g}; undistort the images")
        return camera.replace(projection="fisheye", distortion=torch.tensor([k1, k2, k3, k4], dtype=torch.float64))
    if k4 != 0.0:
        raise ValueError(f"k4: expected 0 of a lens that is no fisheye, got {k4:g}; undistort the images")
    coefficients = [k1, k2, p1, p2, k3] if k3 else [k1, k2, p1, p2]
    return camera.replace(distortion=torch.tensor(coefficients, dtype=torch.float64)) if any(coefficients) else camera


def _model(own: Mapping[str, Any], shared: Mapping[str, Any]) -> str:
    for fields in (own, shared):
        if "camera_model" in fields or "is_fisheye" in fields:
            model = fields.get("camera_model", "OPENCV_FISHEYE" if fields.get("is_fisheye") else "OPENCV")
            break
    else:
        model = "OPENCV"
    if model not in PINHOLES + FISHEYES:
        raise ValueError(
            f"camera_model: expected one of {', '.join(PINHOLES + FISHEYES)}, got {model!r}; undistort the images"
        )
    return model


def _focals(own: Mapping[str, Any], shared: Mapping[str, Any], pixels: tuple[int, int]) -> tuple[float, float]:
    """Return the focal lengths of x and y in pixels. Raises ValueError. Where a frame has one of them alone, the file's pixels
    keep their shape."""
    (fx, fy), (file_x, file_y) = (
        (_focal(fields, "fl_x", "camera_angle_x", pixels[0]), _focal(fields, "fl_y", "camera_angle_y", pixels[1]))
        for fields in (own, shared)
    )
    if fx is None and fy is None:
        fx, fy = file_x, file_y
    elif fx is None and fy is not None:
        fx = fy * file_x / file_y if file_x and file_y else file_x
    elif fy is None and fx is not None:
        fy = fx * file_y / file_x if file_x and file_y else file_y
    fx, fy = fy if fx is None else fx, fx if fy is None else fy  # pixels are square
    if fx is None or fy is None:
        raise ValueError("fl_x: expected this key or camera_angle_x, got neither; export it again")
    return fx, fy


def _focal(fields: Mapping[str, Any], key: str, angle: str, pixels: int) -> float | None:
    if key in fields:
        return float(fields[key])
    if angle not in fields:
        return None
    if not 0.0 < (given := float(fields[angle])) < math.pi:  # nor NaN
        raise ValueError(f"{angle}: expected radians between 0 and π, got {given:g}; of degrees take math.radians()")
    return 0.5 * pixels / math.tan(0.5 * given)
