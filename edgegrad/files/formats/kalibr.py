"""Kalibr's camera chains (camchain.yaml): cameras of a rig, each placed relative to the one before."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from ...camera.camera import Camera
from .context import UnreadLog
from .keys import image_size, matrix, note_unread
from .part import FormatError
from .views import View

NAME = re.compile(r"cam(\d+)")
BROWN_CONRADY, EQUIDISTANT = ("radtan", "none"), ("equidistant", "equi")
READ = {"camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution", "T_cn_cnm1"}
HARMLESS = {"cam_overlaps", "rostopic", "timeshift_cam_imu"}
INSTEAD = {"T_cam_imu": "poses are those to the first camera"}


def is_chain(fields: Mapping[str, Any]) -> bool:
    return any(NAME.fullmatch(name) and isinstance(value, dict) for name, value in fields.items())


def read(fields: Mapping[str, Any], unread: UnreadLog) -> dict[str, View]:
    """Return views by the chain's names. The first camera is at the origin of the world. Raises FormatError."""
    names = sorted(filter(NAME.fullmatch, fields), key=lambda name: int(name[3:]))
    views: dict[str, View] = {}
    pose = np.eye(4)
    for name in names:
        given = fields[name]
        if not isinstance(given, dict):
            raise FormatError(f"{name}: expected the keys of a camera of Kalibr, got {type(given).__name__}")
        given = {key: value for key, value in given.items() if value is not None}
        try:
            if "T_cn_cnm1" in given:
                pose = _matrix(given, "T_cn_cnm1", (4, 4)) @ pose
            elif views:
                unread.note(f"{name} without T_cn_cnm1", f"it stands where {list(views)[-1]} does")
            views[name] = View(_camera(given, pose), None)
        except (FormatError, ValueError) as error:
            raise FormatError(f"{name}: {error}") from error
        note_unread(given, READ | HARMLESS, unread, INSTEAD)
    note_unread(fields, names, unread)
    return views


def _camera(given: Mapping[str, Any], pose: np.ndarray) -> Camera:
    model, bend = given.get("camera_model", "pinhole"), given.get("distortion_model", "none")
    if model != "pinhole":
        raise FormatError(
            f"camera_model: expected pinhole, got {model!r}; undistort the images, or calibrate as pinhole"
        )
    if bend not in BROWN_CONRADY + EQUIDISTANT:
        known = ", ".join(BROWN_CONRADY + EQUIDISTANT)
        raise FormatError(f"distortion_model: expected one of {known}, got {bend!r}; undistort the images")
    fx, fy, cx, cy = _matrix(given, "intrinsics", (1, 4))[0]
    width, height = _matrix(given, "resolution", (1, 2))[0]
    coefficients = None
    if bend != "none":
        coefficients = torch.tensor(_matrix(given, "distortion_coeffs", (1, 4))[0], dtype=torch.float64)
    R, t, K = (
        torch.tensor(values, dtype=torch.float64)
        for values in (pose[:3, :3], pose[:3, 3], np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    )
    make = Camera.fisheye if bend in EQUIDISTANT else Camera.from_opencv
    return make(R, t, K, image_size(width, height), coefficients)


def _matrix(given: Mapping[str, Any], key: str, shape: tuple[int, int]) -> np.ndarray:
    if key not in given:
        raise FormatError(f"{key}: expected this key, got only {', '.join(map(str, given)) or 'none'}")
    found = matrix(key, given[key])
    if found.shape != shape:
        raise FormatError(f"{key}: expected {shape[0]} × {shape[1]} numbers, got {found.shape[0]} × {found.shape[1]}")
    return found
