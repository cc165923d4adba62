"""OpenCV's calibrations, YAML and XML, by OpenCV."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...camera.camera import Camera
from ...optional import require
from .part import Fault
from .views import View

MATRICES = ("camera_matrix", "cameraMatrix", "intrinsic", "K", "M1")
COEFFICIENTS = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "distortion", "D", "D1")


def read(file: Path, size: tuple[int, int] | None, dtype: torch.dtype) -> dict[str, View]:
    """One camera for each row of extrinsic_parameters (a rotation vector and a shift), or one at the origin, named "camera".
    Raises Fault, or ImportError without OpenCV."""
    cv2: Any = require("cv2", "edgegrad[cameras]", "reading OpenCV's calibrations")
    try:
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
        root = storage.root()
    except (cv2.error, SystemError) as error:
        raise Fault("expected YAML or XML of cv2.FileStorage, got a file that OpenCV does not read") from error

    def matrix(*names: str) -> np.ndarray | None:
        for name in names:
            node = root.getNode(name)
            if not node.empty():
                try:
                    found = node.mat()
                except cv2.error:
                    found = None
                if found is None:
                    raise Fault(f"{name}: expected a matrix of OpenCV, got something else; save it by cv2.FileStorage")
                return found.astype(np.float64)
        return None

    def number(name: str) -> float:
        node = root.getNode(name)
        return float(node.real()) if node.isInt() or node.isReal() else 0.0

    K, distortion, poses = matrix(*MATRICES), matrix(*COEFFICIENTS), matrix("extrinsic_parameters")
    if K is None:
        raise Fault(
            f"{MATRICES[0]}: expected this key, or one of {', '.join(MATRICES[1:])}, got none; save K by this name"
        )
    if number("image_height") and number("image_width"):
        size = int(number("image_height")), int(number("image_width"))
    if size is None:
        raise Fault("image_width: expected this key and image_height, got none; pass size=(height, width)")
    fisheye = bool(number("fisheye_model"))
    poses = np.zeros((1, 6)) if poses is None else poses
    if poses.ndim != 2 or poses.shape[1] != 6:
        raise Fault(
            f"extrinsic_parameters: expected (N, 6), rotation vectors and shifts, got {poses.shape}; save them so"
        )
    views = {}
    for i, pose in enumerate(poses):
        R, t, k = (torch.tensor(values, dtype=dtype) for values in (cv2.Rodrigues(pose[:3])[0], pose[3:], K))
        coefficients = None if distortion is None else torch.tensor(distortion.reshape(-1), dtype=dtype)
        make = Camera.fisheye if fisheye else Camera.from_opencv
        try:
            views["camera" if len(poses) == 1 else f"view {i}"] = View(make(R, t, k, size, coefficients), None)
        except ValueError as error:
            raise Fault(str(error)) from error
    return views
