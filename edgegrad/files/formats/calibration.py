"""Calibrations: OpenCV's, YAML and XML, of one camera or a stereo pair; ROS's camera_info; Kalibr's chains (kalibr.py)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...camera.camera import Camera
from . import kalibr
from .context import UnreadLog
from .keys import image_size, matrix, note_unread, read_keys
from .part import FormatError
from .views import View

MATRICES = ("camera_matrix", "cameraMatrix", "intrinsic", "K", "k", "M1")
COEFFICIENTS = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "dist_coeff", "distortion", "D", "d", "D1")
# A stereo pair has matrices and coefficients of the first and the second camera.
PAIRS = {
    ("M1", "M2"): ("D1", "D2"),
    ("K1", "K2"): ("D1", "D2"),
    ("cameraMatrix1", "cameraMatrix2"): ("distCoeffs1", "distCoeffs2"),
}
SIZES = ("image_size", "imageSize", "size", "resolution")  # (width, height)
BROWN_CONRADY, FISHEYES = ("plumb_bob", "rational_polynomial"), ("equidistant", "fisheye")
# These keys describe the calibration's procedure, or follow from the rest: rectified cameras, essential matrices.
HARMLESS = {
    "calibration_time", "nframes", "nr_of_frames", "board_width", "board_height", "square_size", "marker_size", "aspectRatio",
    "fix_aspect_ratio", "flags", "flagValue", "avg_reprojection_error", "per_view_reprojection_errors", "image_points",
    "grid_points", "rms", "R1", "R2", "P1", "P2", "Q", "E", "F", "rectification_matrix", "projection_matrix", "camera_name",
    "header",
}  # fmt: skip


class _Fields:
    """The keys of a file, and which of them were asked for."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.values, self.read = values, set[str]()

    def matrix(self, *names: str) -> np.ndarray | None:
        """Return the matrix of the first name that is there."""
        for name in names:
            if name in self.values:
                self.read.add(name)
                found = matrix(name, self.values[name])
                return found if found.size else None
        return None

    def number(self, *names: str) -> float:
        """Return a number, or 0 where it is not there."""
        self.read.update(names)
        return next((float(self.values[n]) for n in names if isinstance(self.values.get(n), (int, float))), 0.0)

    def size(self, otherwise: tuple[int, int] | None) -> tuple[int, int]:
        """Return the image size (H, W). Raises FormatError."""
        height, width = self.number("image_height", "height"), self.number("image_width", "width")
        for name in SIZES:
            pair = self.values.get(name)
            if isinstance(pair, list) and len(pair) == 2 and all(isinstance(side, (int, float)) for side in pair):
                self.read.add(name)
                width, height = width or pair[0], height or pair[1]
        if height and width:
            return image_size(width, height)
        if otherwise is None:
            raise FormatError("image_width: expected this key and image_height, got none; pass size=(height, width)")
        return otherwise


def read(file: Path, size: tuple[int, int] | None, unread: UnreadLog) -> dict[str, View]:
    """Return views by name: that of a matrix of a pair, of a camera of ROS or Kalibr, else "camera", or "view 0" … for several
    poses. Raises FormatError, or ImportError without PyYAML."""
    values = read_keys(file)
    if kalibr.is_chain(values):
        return kalibr.read(values, unread)
    fields = _Fields(values)
    pair = next((pair for pair in PAIRS if all(name in values for name in pair)), None)
    try:
        views = _single(fields, size) if pair is None else _stereo(fields, pair, file, size, unread)
    except ValueError as error:
        raise FormatError(str(error)) from error
    known = fields.read | HARMLESS
    if "distortion_model" in values:  # of ROS, whose R and P rectify
        known |= {"R", "P", "r", "p"}
        projection = next(
            (matrix(n, values[n]) for n in ("projection_matrix", "P", "p") if n in values), np.zeros((3, 4))
        )
        # Its entry (0, 3) is −fx times the baseline of a stereo pair.
        if projection.size == 12 and projection.reshape(3, 4)[0, 3]:
            unread.note("the projection matrix's shift to the other camera", "this one stands at the origin")
    note_unread(values, known, unread)
    return views


def _single(fields: _Fields, size: tuple[int, int] | None) -> dict[str, View]:
    K, distortion = _lens(fields, MATRICES, COEFFICIENTS)
    poses = fields.matrix("extrinsic_parameters")
    poses = np.zeros((1, 6)) if poses is None else poses
    if poses.ndim != 2 or poses.shape[1] != 6:
        raise FormatError(
            f"extrinsic_parameters: expected (N, 6), rotation vectors and shifts, got {poses.shape}; save them so"
        )
    whole, fisheye = fields.size(size), _is_fisheye(fields)
    named = fields.values.get("camera_name")
    name = named if isinstance(named, str) and named else "camera"
    return {
        name if len(poses) == 1 else f"view {i}": _view(pose[:3], pose[3:], K, distortion, whole, fisheye)
        for i, pose in enumerate(poses)
    }


def _stereo(
    fields: _Fields, pair: tuple[str, str], file: Path, size: tuple[int, int] | None, unread: UnreadLog
) -> dict[str, View]:
    """Return the first camera at the origin and the second at R and T. These stand in this file, or in extrinsics next to
    intrinsics, as OpenCV's example of stereo calibration writes them."""
    places = fields
    sibling = file.with_name(f"extrinsics{file.suffix}")
    if not {"R", "T"} <= fields.values.keys() and file.stem == "intrinsics" and sibling.is_file():
        places = _Fields(read_keys(sibling))
    R, T = places.matrix("R"), places.matrix("T")
    if R is None or T is None:
        unread.note(f"the pose of {pair[1]}", "R and T are not there, so it stands where the first does")
        R, T = np.zeros(3), np.zeros(3)
    if R.size not in (3, 9) or T.size != 3:
        raise FormatError(f"R, T: expected a rotation of 9 or 3 numbers and a shift of 3, got {R.size} and {T.size}")
    whole, fisheye = fields.size(size), _is_fisheye(fields)
    views = {}
    for name, coefficients, turn, shift in zip(pair, PAIRS[pair], (np.zeros(3), R), (np.zeros(3), T), strict=True):
        K, distortion = _lens(fields, (name,), (coefficients,))
        views[name] = _view(turn, shift, K, distortion, whole, fisheye)
    return views


def _lens(
    fields: _Fields, matrices: tuple[str, ...], coefficients: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray | None]:
    K, distortion = fields.matrix(*matrices), fields.matrix(*coefficients)
    if K is None:
        if fields.values.keys() >= {"R", "T"}:
            raise FormatError(
                "expected the matrices of cameras, got how a pair stands alone; name the file of its intrinsics"
            )
        others = f", or one of {', '.join(matrices[1:])}" * (len(matrices) > 1)
        raise FormatError(
            f"{matrices[0]}: expected this key{others}, got {', '.join(fields.values) or 'none'}; save K by this name"
        )
    return K.reshape(3, 3) if K.size == 9 else K, distortion


def _is_fisheye(fields: _Fields) -> bool:
    """Return whether the lens is a fisheye of OpenCV, else Brown and Conrady's. Raises FormatError for others."""
    if fields.number("xi"):
        raise FormatError("xi: expected none, got a lens of cv2.omnidir; undistort the images")
    model = fields.values.get("distortion_model", "")
    fields.read.add("distortion_model")
    if model not in ("", *BROWN_CONRADY, *FISHEYES):
        known = ", ".join(BROWN_CONRADY + FISHEYES)
        raise FormatError(f"distortion_model: expected one of {known}, got {model!r}; undistort the images")
    return model in FISHEYES or bool(fields.number("fisheye_model"))


def _view(
    turn: np.ndarray, shift: np.ndarray, K: np.ndarray, distortion: np.ndarray | None, size: tuple[int, int], fisheye: bool,
) -> View:  # fmt: skip
    """Return the view of a camera whose rotation is a matrix or a rotation vector."""
    turn = turn.reshape((3, 3) if turn.size == 9 else 3)
    R, t, k = (torch.tensor(values, dtype=torch.float64) for values in (turn, shift.reshape(3), K))
    coefficients = None if distortion is None else torch.tensor(distortion.reshape(-1), dtype=torch.float64)
    make = Camera.fisheye if fisheye else Camera.from_opencv
    return View(make(R, t, k, size, coefficients), None)
