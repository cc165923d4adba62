"""Messages of cameras, each wording once. test_bad_input.py checks that every argument is named."""

from __future__ import annotations

import pytest
import torch
from messages import CAMERA, POSE, K, T, V, bad_calls, camera, check_message, put

import edgegrad as eg

pytestmark = pytest.mark.watched


def look_at(**fields: object) -> eg.Camera:
    return eg.Camera.look_at(**{"eye": (0.0, 0.0, 4.0), "target": (0.0, 0.0, 0.0), **fields})


CAMERAS = {
    "pose without last row": (
        lambda: camera(world_to_camera=POSE[:3]),
        V,
        "world_to_camera: expected shape (4, 4)",
        "(3, 4)",
    ),
    "pose transposed": (
        lambda: camera(world_to_camera=POSE.mT),
        V,
        "world_to_camera: expected the last row",
        "transposed?",
    ),
    "pose with a scale": (
        lambda: camera(world_to_camera=torch.diag(torch.tensor([2.0, 2, 2, 1]))),
        V,
        "world_to_camera: expected a rotation in the upper 3 × 3, got one with |R Rᵀ − 1| up to 3",
    ),
    "pose with a reflection": (
        lambda: camera(world_to_camera=torch.diag(torch.tensor([1.0, -1, 1, 1]))),
        V,
        "world_to_camera: expected a rotation, got a reflection",
    ),
    "K of another shape": (lambda: camera(K=K[:2]), V, "K: expected shape (3, 3) or (B, 3, 3), got (2, 3)"),
    "K transposed": (lambda: camera(K=K.mT), V, "K: expected the last row", "transposed?"),
    "K singular": (lambda: camera(K=put(K, (1, 1), 0.0)), V, "K: expected focal lengths that are not zero", "singular"),
    "batches that differ": (
        lambda: camera(world_to_camera=POSE.expand(2, 4, 4), K=K.expand(3, 3, 3)),
        V,
        "K: expected a batch of 2 like world_to_camera, got 3",
    ),
    "size is a number": (lambda: camera(size=8), T, "size: expected (height, width), got 8"),
    "size of floats": (lambda: camera(size=(8.0, 8)), T, "size: expected an int, got float (8.0)"),
    "size zero": (lambda: camera(size=(0, 8)), V, "size: expected an int from 1 to 65536, got 0"),
    "size too large": (lambda: look_at(size=(8, 100_000)), V, "size: expected an int from 1 to 65536, got 100000"),
    "projection": (
        lambda: camera(projection="cylinder"),
        V,
        "projection: expected one of 'perspective', 'fisheye', 'panorama', 'orthographic', got 'cylinder'",
    ),
    "projection is a list": (lambda: camera(projection=[]), V, "projection: expected one of", "got []"),
    "crop of no height": (lambda: camera().crop(0, 0, 0, 4), V, "height: expected an int from 1 to 65536, got 0"),
    "eye in 2-D": (lambda: look_at(eye=(0.0, 1.0)), V, "eye: expected shape (3,), got (2,)"),
    "eye on target": (
        lambda: look_at(eye=(0, 0, 0)),
        V,
        "target: expected a point apart from eye, got both at [0.0, 0.0, 0.0]",
    ),
    "up along the view": (lambda: look_at(up=(0, 0, 1)), V, "up: expected a direction apart from the line of sight"),
    "up of zero": (lambda: look_at(up=(0, 0, 0)), V, "up: expected a direction", "[0.0, 0.0, 0.0]"),
    "fov_y too wide": (lambda: look_at(fov_y=180.0), V, "fov_y: expected degrees between 0 and 180, got 180"),
    "fov_y of two": (lambda: look_at(fov_y=torch.ones(2)), V, "fov_y: expected one number, got shape (2,)"),
    "height negative": (
        lambda: eg.Camera.orthographic((0, 0, 4), (0, 0, 0), height=-1.0),
        V,
        "height: expected world units above 0, got -1",
    ),
    "OpenCV, t": (
        lambda: eg.Camera.from_opencv(POSE[:3, :3], POSE[3], K, (8, 8)),
        V,
        "t: expected 3 numbers, got shape (4,)",
    ),
    "OpenGL, pose": (
        lambda: eg.Camera.from_opengl(K, (8, 8), 40.0),
        V,
        "camera_to_world: expected shape (4, 4) or (B, 4, 4), got (3, 3)",
    ),
    "OpenGL, neither": (
        lambda: eg.Camera.from_opengl(POSE, (8, 8)),
        T,
        "from_opengl: expected one of fov_y, fov_x and K, got none",
    ),
    "OpenGL, both": (
        lambda: eg.Camera.from_opengl(POSE, (8, 8), 40.0, K),
        T,
        "expected one of fov_y, fov_x and K, got fov_y and K",
    ),
    "stack of nothing": (lambda: eg.Camera.stack([]), V, "cameras: expected at least one camera, got none"),
    "stack of tensors": (lambda: eg.Camera.stack([POSE]), T, "cameras[0]: expected a Camera, got Tensor"),
    "stack of sizes": (
        lambda: eg.Camera.stack([CAMERA, CAMERA.resized((4, 8))]),
        V,
        "cameras[1]: expected a single perspective camera of size (8, 8), got Camera(perspective, 4 × 8",
    ),
}


@bad_calls(CAMERAS)
def test_messages_of_cameras(call, error, parts):
    check_message(call, error, *parts)
