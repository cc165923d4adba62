"""The kernel's tracker: what it needs of a mesh, its updates, and its state."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from ..camera.camera import Camera
from ..library import core
from .operators import kernel_camera
from .request import pack_camera
from .threads import threads


class SurfacePoints(NamedTuple):
    """Points on a surface. Those of a texture have colours at blurs of 1, 2, 4 … texels."""

    X: np.ndarray  # (N, 3) float64, relative to the object's centre
    normal: np.ndarray  # (N, 3) float64, unit
    colors: np.ndarray  # (levels, N, 3) linear albedo; (0, 0, 3) where there is none
    texels: np.ndarray  # (N,) to a world unit


class Shape(NamedTuple):
    """A rigid object."""

    verts: np.ndarray  # (V, 3) float64, world units, relative to the centre
    faces: np.ndarray  # (F, 3) int32
    spacing: list[float]  # as of Flat
    textured: SurfacePoints
    surface: SurfacePoints
    center: np.ndarray  # (3,) of the box of the object before
    size: float  # length of the diagonal of that box


class Found(NamedTuple):
    """One object after an update."""

    R: np.ndarray  # (3, 3) from the mesh to the camera
    c: np.ndarray  # (3,) the centre in the camera's frame
    covariance: np.ndarray  # (6, 6) of a step: a rotation vector in the camera's frame, and a shift in sizes
    features: dict[str, float]
    times: dict[str, float]  # seconds of the parts of the update


class KernelTracker:
    """Follows rigid objects in the frame of a camera."""

    def __init__(self, camera: Camera) -> None:
        # World and camera have one frame, so that poses are those of the camera.
        here = camera.to("cpu").detach().replace(world_to_camera=torch.eye(4, dtype=camera.world_to_camera.dtype))
        self._tracker = core.Tracker(kernel_camera(pack_camera(here)))

    def add(self, shape: Shape, R: np.ndarray, c: np.ndarray) -> None:
        """Add an object at a pose. Others may cover it."""
        points = [_kernel_points(p) for p in (shape.textured, shape.surface)]
        self._tracker.add(
            _array(shape.verts), np.ascontiguousarray(shape.faces, np.int32), shape.spacing, *points, _array(R), _array(c),
            threads(),
        )  # fmt: skip

    def update(self, frame: np.ndarray, depth: np.ndarray | None) -> list[Found]:
        """Return what the next frame (H, W, C) shows: uint8 of sRGB, or float32 of linear radiance; `depth` (H, W) float32."""
        image = np.ascontiguousarray(frame)
        given = {"bytes": image, "linear": None} if image.dtype == np.uint8 else {"bytes": None, "linear": image}
        depth = None if depth is None else np.ascontiguousarray(depth)
        rows = self._tracker.update(**given, depth=depth, threads=threads())
        return [Found(r["pose"][:, :3], r["pose"][:, 3], r["covariance"], r["features"], r["times"]) for r in rows]

    def place(self, index: int, R: np.ndarray, c: np.ndarray) -> None:
        """Move an object to a pose, at rest."""
        self._tracker.place(index, _array(R), _array(c))

    def is_in_view(self, index: int) -> bool:
        """Return whether the camera sees the outline of an object."""
        return self._tracker.is_in_view(index)

    def save(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Return all numbers of an object that the next update depends on, and its histograms."""
        return self._tracker.save(index)

    def load(self, index: int, numbers: Any, colors: Any) -> None:
        """Restore an object to what save() returned."""
        self._tracker.load(index, _array(numbers), np.ascontiguousarray(colors, np.float32))


def _array(values: Any) -> np.ndarray:
    return np.ascontiguousarray(values, np.float64)


def _kernel_points(points: SurfacePoints) -> Any:
    colors = np.ascontiguousarray(points.colors, np.float32)
    return core.SurfacePoints(
        _array(points.X), _array(points.normal), colors, np.ascontiguousarray(points.texels, np.float32)
    )
