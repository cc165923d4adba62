"""Any rays against brute force in NumPy: closest hits and occlusion, with ends and ignored faces."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from combinations import diagonal
from kernel_parts import parts

import edgegrad as eg
from edgegrad.kernel.flat import flatten
from edgegrad.kernel.operators import kernel_scene
from edgegrad.library import core
from edgegrad.scene.scene import Scene

pytestmark = [pytest.mark.quick, pytest.mark.watched]


class Rays(NamedTuple):
    origins: np.ndarray  # (N, 3)
    directions: np.ndarray  # (N, 3)
    ends: np.ndarray  # (N,) in lengths of the direction
    ignored: list[np.ndarray]  # faces, by ray


class Truth(NamedTuple):
    face: np.ndarray  # (N,), −1: none
    certain: np.ndarray  # (N,): whether floats can decide


def triangle_soup(faces: int, scale: float, centre: np.ndarray) -> np.ndarray:
    """Corners (F, 3, 3) of triangles of size 0.3 in a cube of size 2, times the scale."""
    rng = np.random.default_rng(3)
    corners = rng.uniform(-1, 1, (faces, 1, 3)) + 0.3 * rng.normal(size=(faces, 3, 3))
    return scale * corners + centre


def rays_through(corners: np.ndarray, n: int, far: float, infinite: bool) -> Rays:
    """Return rays from points about `far` sizes of the scene away towards points near it."""
    rng = np.random.default_rng(4)
    faces, centre = len(corners), corners.mean((0, 1))
    size = np.abs(corners - centre).max()
    origins = centre + far * size * rng.normal(size=(n, 3))
    directions = (centre + 0.5 * size * rng.normal(size=(n, 3)) - origins) * rng.uniform(0.1, 10, (n, 1))
    distance = np.linalg.norm(centre - origins, axis=1) / np.linalg.norm(directions, axis=1)
    ends = np.full(n, np.inf) if infinite else distance * rng.uniform(0.0, 2.0, n)
    # None, a few, and more than the sixteen that are searched one by one; these come sorted.
    ignored = [np.sort(rng.choice(faces, k, replace=False)) for k in rng.choice([0, 2, 60], n)]
    return Rays(origins, directions, ends, ignored)


def brute_force(corners: np.ndarray, rays: Rays) -> Truth:
    """Möller and Trumbore 1997, every ray with every face, in double."""
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    s = rays.origins[:, None] - a
    p = np.cross(rays.directions[:, None], e2)
    determinant = (p * e1).sum(-1)
    q = np.cross(s, e1)
    u, v = (s * p).sum(-1) / determinant, (rays.directions[:, None] * q).sum(-1) / determinant
    t = (e2 * q).sum(-1) / determinant
    for i, faces in enumerate(rays.ignored):
        u[i, faces] = np.nan
    inside = np.minimum(np.minimum(u, v), 1 - u - v)  # < 0: next to the face
    with np.errstate(invalid="ignore"):
        hit = (inside >= 0) & (t >= 0) & (t <= rays.ends[:, None])
    t_hit = np.where(hit, t, np.inf)
    face = np.where(hit.any(1), t_hit.argmin(1), -1)
    # Floats are 1e-7 of the scene apart, and faces a tenth of it long: 1e-4 of a face or of a distance is far more.
    slack = 1e-4
    nearest = t_hit.min(1, keepdims=True)
    size = np.abs(corners - corners.mean((0, 1))).max() / np.linalg.norm(rays.directions, axis=1)[:, None]
    # Seen at a grazing angle, a face is so much narrower.
    normal, length = np.cross(e1, e2), np.linalg.norm(rays.directions, axis=1)[:, None]
    cosine = np.abs(determinant) / (np.linalg.norm(normal, axis=-1) * length)
    near_border = (np.abs(inside) * np.maximum(cosine, 1e-9) < slack) & (t <= nearest + slack * size)
    with np.errstate(invalid="ignore"):
        near_end = (inside > -slack) & (np.abs(t - rays.ends[:, None]) < slack * size)
        near_start = (inside > -slack) & (np.abs(t) < slack * size)
        tied = (inside > -slack) & (t != nearest) & (np.abs(t - nearest) < slack * size)
    return Truth(face, ~(near_border | near_end | near_start | tied).any(1))


def cast(corners: np.ndarray, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """The face of each ray and whether it is occluded, by the kernel."""
    faces = torch.arange(3 * len(corners)).reshape(-1, 3)
    mesh = eg.Mesh(torch.from_numpy(corners.reshape(-1, 3)), faces)
    n = len(rays.ends)
    face, hidden = np.empty(n, np.int32), np.empty(n, np.uint8)
    parts.cast_rays(
        kernel_scene(flatten(Scene([mesh]))),
        rays.origins,
        rays.directions,
        rays.ends,
        np.concatenate(rays.ignored).astype(np.int32),
        np.cumsum([0, *map(len, rays.ignored)]).astype(np.int64),
        face,
        hidden,
    )
    return face, hidden.astype(bool)


@pytest.mark.parametrize(("scale", "far", "infinite"), diagonal([1.0, 1e-12, 1e12], [0.3, 3.0, 1e6], [False, True]))
def test_any_rays(far: float, infinite: bool, scale: float) -> None:
    corners = triangle_soup(150, scale, scale * np.array([30.0, -70.0, 5.0]))
    rays = rays_through(corners, 1001, far, infinite)  # not whole packets
    truth = brute_force(corners, rays)
    face, hidden = cast(corners, rays)
    certain = truth.certain
    assert certain.mean() > 0.9
    assert (truth.face[certain] >= 0).mean() > 0.2, "too few rays hit"
    assert (truth.face[certain] < 0).mean() > 0.02, "too few rays miss"
    np.testing.assert_array_equal(face[certain], truth.face[certain])
    np.testing.assert_array_equal(hidden[certain], truth.face[certain] >= 0)
    # Without ends and ignored faces the answers differ: they were heeded.
    free = rays._replace(ends=np.full(len(rays.ends), np.inf), ignored=[np.empty(0, int)] * len(rays.ends))
    assert (brute_force(corners, free).face != truth.face).mean() > 0.04


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="Linux tells the state of threads")
def test_threads_of_embree_sleep_while_a_process_forks() -> None:
    """A child that is forked while one of them holds a lock would wait for it for ever."""
    corners = triangle_soup(50_000, 1.0, np.zeros(3))
    cast(corners, rays_through(corners, 10, 3.0, False))
    core.before_fork()
    try:
        lines = [(task / "stat").read_text() for task in Path("/proc/self/task").iterdir()]
    finally:
        core.after_fork(child=False)
    states = [line.rpartition(") ")[2][0] for line in lines if "(embree)" in line]
    assert states or os.cpu_count() == 1, "no thread of Embree is found by its name"
    assert set(states) <= {"S"}, states
