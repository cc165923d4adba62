"""Pose errors: ADD, ADI, MSSD, MSPD and VSD.

Poses are (4, 4) from the mesh to the camera, points (N, 3) vertices of the mesh, all in float64 and millimetres (or any one
unit).

ADD, ADI    Hinterstoisser et al., "Model Based Training, Detection and Pose Estimation of Texture-Less 3D Objects in Heavily
            Cluttered Scenes", ACCV 2012
VSD         Hodaň et al., "BOP: Benchmark for 6D Object Pose Estimation", ECCV 2018
MSSD, MSPD  Hodaň et al., "BOP Challenge 2020 on 6D Object Localization", ECCVW 2020
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor

from ..camera.camera import Camera
from ..optional import require
from .depth import depth_image, pixel_rays

__all__ = ["add", "adi", "depth_image", "mspd", "mssd", "vsd"]

BOUND_POINTS = 256  # for lower bounds


def add(estimate: Tensor, truth: Tensor, points: Tensor) -> float:
    """Return the average distance of points, for objects without symmetries: the mean over the points of |E x − T x|."""
    return float((_moved(estimate, points) - _moved(truth, points)).norm(dim=-1).mean())


def adi(estimate: Tensor, truth: Tensor, points: Tensor) -> float:
    """Return the average distance to the nearest point, for objects with symmetries: the mean over x of the least |E y − T x|.
    Raises ImportError without SciPy."""
    spatial: Any = require("scipy.spatial", "edgegrad[fit]", "ADI")
    tree = spatial.cKDTree(_moved(estimate, points).numpy())
    return float(tree.query(_moved(truth, points).numpy())[0].mean())


def mssd(estimate: Tensor, truth: Tensor, points: Tensor, symmetries: Tensor) -> float:
    """Return the maximum symmetry-aware surface distance: the least over symmetries S of the largest |E x − T S x|.

    symmetries  (T, 4, 4) with the identity, as Symmetries.transforms() returns them
    """

    def apart(some: Tensor, x: Tensor) -> Tensor:
        return (_moved(estimate, x) - _moved(truth @ some, x)).norm(dim=-1)

    return _least_largest(apart, symmetries, points)


def mspd(estimate: Tensor, truth: Tensor, points: Tensor, symmetries: Tensor, camera: Camera) -> float:
    """Return the maximum symmetry-aware projection distance in pixels: as mssd, of the points' projections."""

    def apart(some: Tensor, x: Tensor) -> Tensor:
        return (camera.project(_moved(estimate, x)) - camera.project(_moved(truth @ some, x))).norm(dim=-1)

    return _least_largest(apart, symmetries, points)


def vsd(
    estimate: Tensor, truth: Tensor, measured: Tensor, camera: Camera, diameter: float, taus: Sequence[float], delta: float = 15.0
) -> list[float]:  # fmt: skip
    """Return the visible surface discrepancy, 0 … 1, for each tau.

    Of the pixels in which the object is visible in either pose, it is the share in which it is not visible in both, or the
    distances differ by tau diameters or more. Symmetries need no mention, for only what is visible counts.

    estimate, truth  (H, W) depth images of the object in the two poses, by depth_image()
    measured         (H, W) depth image of the scene; 0 where the sensor measured nothing: the object counts as visible there,
                     as in BOP19
    delta            mm; the object is visible where it is at most so far behind the measured depth
    """
    length = pixel_rays(camera).norm(dim=-1)  # distances from the eye are compared, not depths
    mine, theirs, scene = (depth.double() * length for depth in (estimate, truth, measured))
    unknown = scene == 0
    seen_truly = (theirs > 0) & ((theirs - scene <= delta) | unknown)
    seen = (mine > 0) & ((mine - scene <= delta) | unknown | seen_truly)
    both, either = seen & seen_truly, seen | seen_truly
    count = int(either.sum())
    if count == 0:
        return [1.0 for _ in taus]
    apart = (mine - theirs).abs()[both] / diameter
    alone = count - int(both.sum())
    return [(int((apart >= tau).sum()) + alone) / count for tau in taus]


def _moved(pose: Tensor, points: Tensor) -> Tensor:
    """Return points (…, N, 3) moved by poses (…, 4, 4)."""
    return points @ pose[..., :3, :3].mT + pose[..., None, :3, 3]


def _least_largest(apart: Callable[[Tensor, Tensor], Tensor], symmetries: Tensor, points: Tensor) -> float:
    """Return the least over symmetries (T, 4, 4) of the largest distance (T, N) that `apart` returns for points (N, 3). The
    largest distance of a few points is a lower bound. Symmetries are tried with all points in the order of their bounds,
    until the next bound exceeds the least distance found. This is exact and tries few of hundreds of symmetries."""
    few = points[:: max(1, len(points) // BOUND_POINTS)]
    bounds, order = apart(symmetries, few).amax(-1).sort()
    best = math.inf
    for bound, i in zip(bounds.tolist(), order.tolist(), strict=True):
        if bound >= best:
            break
        best = min(best, float(apart(symmetries[i], points).max()))
    return best
