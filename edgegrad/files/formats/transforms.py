"""NeRF's transforms.json, as instant-ngp, nerfstudio and the synthetic scenes have it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from ...camera.camera import Camera
from ..image import IMAGES, read_size
from .part import Fault
from .views import View

PINHOLES, FISHEYES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV"), ("OPENCV_FISHEYE",)


def read(fields: Mapping[str, Any], folder: Path, size: tuple[int, int] | None, dtype: torch.dtype) -> dict[str, View]:
    """By the frames' file_path. What a frame says goes before what the file says of all. Raises Fault."""
    frames = fields["frames"]
    if not isinstance(frames, list) or not frames:
        raise Fault("frames: expected a list of frames, got none; export it again")
    views: dict[str, View] = {}
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict) or "transform_matrix" not in frame:
            raise Fault(f"frames[{i}]: expected transform_matrix, 4 × 4, got none; export it again")
        name = str(frame.get("file_path", i))
        try:
            image = _image(folder, name) if "file_path" in frame else None
            views[name] = View(_camera({**fields, **frame}, image, size, dtype), image)
        except (TypeError, ValueError, KeyError) as error:
            raise Fault(f"frames[{i}], {name}: {error}") from error
    return views


def _image(folder: Path, name: str) -> Path | None:
    """Beside the file or below it; the synthetic scenes leave out the ending."""
    for ending in ("", *IMAGES):
        file = folder / f"{name}{ending}"
        if file.is_file() and file.resolve().is_relative_to(folder.resolve()):
            return file
    return None


def _camera(given: Mapping[str, Any], image: Path | None, size: tuple[int, int] | None, dtype: torch.dtype) -> Camera:
    if "w" in given and "h" in given:
        H, W = int(given["h"]), int(given["w"])
    elif size is not None:
        H, W = size
    elif image is not None:
        H, W = read_size(image)
    else:
        raise ValueError(
            "w and h: expected the image's size, or the image itself, got neither; pass size=(height, width)"
        )
    pose = torch.tensor(given["transform_matrix"], dtype=dtype)
    model = given.get("camera_model", "OPENCV_FISHEYE" if given.get("is_fisheye") else "OPENCV")
    if model not in PINHOLES + FISHEYES:
        raise ValueError(
            f"camera_model: expected one of {', '.join(PINHOLES + FISHEYES)}, got {model!r}; undistort the images"
        )
    focals: list[float] = []
    for key, angle, pixels in (("fl_x", "camera_angle_x", W), ("fl_y", "camera_angle_y", H)):
        if key in given:
            focals.append(float(given[key]))
        elif angle in given:
            focals.append(0.5 * pixels / math.tan(0.5 * float(given[angle])))
    if not focals:
        raise ValueError("fl_x: expected this key or camera_angle_x, got neither; export it again")
    cx, cy = float(given.get("cx", 0.5 * W)), float(given.get("cy", 0.5 * H))
    K = torch.tensor([[focals[0], 0.0, cx], [0.0, focals[-1], cy], [0.0, 0.0, 1.0]], dtype=dtype)
    k1, k2, k3, k4, p1, p2 = (float(given.get(key, 0.0)) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    camera = Camera.from_opengl(pose, (H, W), K=K)
    if model in FISHEYES:
        return camera.replace(projection="fisheye", distortion=torch.tensor([k1, k2, k3, k4], dtype=dtype))
    if k4 != 0.0:
        raise ValueError(f"k4: expected 0 of a lens that is no fisheye, got {k4:g}; undistort the images")
    coefficients = [k1, k2, p1, p2, k3] if k3 else [k1, k2, p1, p2]
    return camera.replace(distortion=torch.tensor(coefficients, dtype=dtype)) if any(coefficients) else camera
