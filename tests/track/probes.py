"""Objects before cameras for tests of the tracker's terms, and steps of a pose in float64."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from kernel_parts import parts
from scenes import icosphere

import edgegrad as eg
from edgegrad.kernel.operators import kernel_camera
from edgegrad.kernel.request import pack_camera
from edgegrad.library import core

SIZE = 120, 160  # of an image


def camera_of(projection: str = "perspective", **others: Any) -> eg.Camera:
    """Return a camera whose frame is the world's."""
    focal = {"perspective": 180.0, "fisheye": 120.0, "panorama": 60.0, "orthographic": 38.0}[projection]
    K = torch.tensor([[focal, 0.0, 83.0], [0.0, 1.03 * focal, 58.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return eg.Camera(torch.eye(4, dtype=torch.float64), K, SIZE, projection, **others)


CAMERAS = {
    "perspective": camera_of(),
    "distorted": camera_of(distortion=torch.tensor([-0.2, 0.05, 0.002, -0.001]).double()),
    "fisheye": camera_of("fisheye", distortion=torch.tensor([0.02, -0.01, 0.0, 0.0]).double()),
    "panorama": camera_of("panorama"),
    "orthographic": camera_of("orthographic"),
}


def in_kernel(camera: eg.Camera) -> Any:
    return kernel_camera(pack_camera(camera))


def rotation(w: np.ndarray) -> np.ndarray:
    """Return exp([w]x) by its series, which needs no formula of the kernel's."""
    W = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    out, term = np.eye(3), np.eye(3)
    for k in range(1, 30):
        term = term @ W / k
        out = out + term
    return out


def stepped(pose: np.ndarray, d: np.ndarray, size: float) -> np.ndarray:
    """Return the pose (3, 4) after a step."""
    return np.concatenate([rotation(d[:3]) @ pose[:, :3], pose[:, 3:] + size * d[3:, None]], 1)


def project(camera: eg.Camera, X: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return pixel positions (N, 2) by the camera of the package."""
    return camera.project(torch.from_numpy(X @ pose[:, :3].T + pose[:, 3])).numpy()


def potato() -> tuple[np.ndarray, np.ndarray]:
    """Return a smooth body without symmetry, about the middle of its box."""
    ball = icosphere(3)
    x, y, z = ball.verts.double().numpy().T
    r = 1.0 + 0.2 * x * y + 0.15 * np.sin(2.0 * z + x)
    V = r[:, None] * np.stack([x, 0.8 * y, 1.2 * z], 1)
    return np.ascontiguousarray(V - 0.5 * (V.min(0) + V.max(0))), ball.faces.int().numpy()


POSE = np.concatenate([rotation(np.array([0.4, -0.7, 0.3])), np.array([[0.15], [-0.1], [4.2]])], 1)


def points(X: np.ndarray, normal: np.ndarray, colors: np.ndarray | None = None, texels: float = 1.0) -> Any:
    """Return the kernel's points on a surface."""
    colors = np.zeros((0, 0, 3), np.float32) if colors is None else colors.astype(np.float32)
    count = len(X) if colors.size else 0
    return core.SurfacePoints(
        np.ascontiguousarray(X), np.ascontiguousarray(normal), colors, np.full(count, texels, np.float32)
    )


NO_POINTS = points(np.zeros((0, 3)), np.zeros((0, 3)))


def probe(camera: eg.Camera, mesh: tuple[np.ndarray, np.ndarray], textured: Any = NO_POINTS, surface: Any = NO_POINTS,
          pose: np.ndarray = POSE) -> Any:  # fmt: skip
    return parts.TrackProbe(in_kernel(camera), *mesh, textured, surface, np.ascontiguousarray(pose))


def on_surface(mesh: tuple[np.ndarray, np.ndarray], count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) in faces, and the unit normals of these faces, outwards."""
    V, F = mesh
    rng = np.random.default_rng(seed)
    face, b = rng.integers(0, len(F), count), rng.dirichlet((1.0, 1.0, 1.0), count)
    corners = V[F[face]]
    N = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    X = np.einsum("nk,nkd->nd", b, corners)
    N *= np.sign((N * X).sum(1, keepdims=True))
    return X, N / np.linalg.norm(N, axis=1, keepdims=True)


def gradient_of(cost: Any, size: float, pose: np.ndarray, h: float = 1e-5) -> np.ndarray:
    """Return central differences (6,) of a function of the pose by steps."""
    return np.array(
        [(cost(stepped(pose, h * e, size)) - cost(stepped(pose, -h * e, size))) / (2.0 * h) for e in np.eye(6)]
    )


def tells_apart(found: np.ndarray, truth: np.ndarray, tolerance: float) -> None:
    """Check that vectors agree, and that a part that is 5 % off would be found."""
    scale = np.abs(truth).max()
    assert np.abs(found - truth).max() < tolerance * scale
    spoilt = found.copy()
    k = np.abs(truth).argmax()
    spoilt.reshape(-1)[k] *= 1.05
    assert np.abs(spoilt - truth).max() > 2.0 * tolerance * scale
