"""The surface of a scene as points: samples of it, and the point of it that is nearest to any other."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..optional import require
from .appearance import OnMesh
from .scene import Scene

DENSE = 20_000  # samples in the tree
NEIGHBOURS = 12  # faces that are looked at exactly: those of so many samples that are nearest to a point


class NearestPoints(NamedTuple):
    position: np.ndarray  # (N, 3) float64
    face: np.ndarray  # (N,) int64, counted through all meshes
    b: np.ndarray  # (N, 3) float64, barycentrics


class SurfaceIndex:
    """All faces of a scene, for queries of the nearest point. A tree of samples finds the faces near a point, of which the
    nearest point is computed. Raises ImportError without SciPy."""

    def __init__(self, scene: Scene) -> None:
        self.meshes = scene.meshes
        corners = [mesh.verts.detach().cpu().double()[mesh.faces.cpu().long()].numpy() for mesh in scene.meshes]
        self.triangles = np.concatenate(corners)  # (F, 3, 3)
        self._first = np.cumsum([0, *(len(one) for one in corners)])
        low, high = self.triangles.min((0, 1)), self.triangles.max((0, 1))
        self._middle, self._extent = 0.5 * (low + high), float((high - low).max()) or 1.0
        across = np.cross(self.triangles[:, 1] - self.triangles[:, 0], self.triangles[:, 2] - self.triangles[:, 0])
        length = np.linalg.norm(across, axis=1)
        self.area = 0.5 * length
        self.normal = across / np.where(length > 0.0, length, 1.0)[:, None]  # (F, 3); zeros where a face has no area
        spatial: Any = require("scipy.spatial", "edgegrad[fit]", "looking for nearest points")
        dense = self.samples(DENSE, seed=1)
        # Faces that are too small for a sample are there by their middles.
        self._tree = spatial.cKDTree(np.concatenate([dense.position, self.triangles.mean(1)]))
        self._face = np.concatenate([dense.face, np.arange(len(self.triangles))])

    def samples(self, count: int, seed: int) -> NearestPoints:
        """Return points evenly over the area; the same seed gives the same points."""
        total = self.area.sum()
        if not total > 0.0:
            raise ValueError("mesh: expected faces with an area, got none; give a surface")
        random = np.random.default_rng(seed)
        # Stratified: one sample in each of `count` equal parts of the area.
        share = (np.arange(count) + random.random(count)) / count * total
        face = np.minimum(np.searchsorted(np.cumsum(self.area), share, side="right"), len(self.area) - 1)
        u, v = np.sqrt(random.random(count)), random.random(count)
        b = np.stack([1.0 - u, u * (1.0 - v), u * v], axis=1)
        return NearestPoints(np.einsum("nk,nkd->nd", b, self.triangles[face]), face, b)

    def rough_distance(self, points: np.ndarray) -> np.ndarray:
        """Return distances (…,) from points (…, 3) to the nearest sample: too large by up to about the spacing of samples."""
        return self._tree.query(points.reshape(-1, 3))[0].reshape(points.shape[:-1])

    def nearest(self, points: np.ndarray, neighbours: int = NEIGHBOURS) -> NearestPoints:
        """Return the nearest points of the surface to points (N, 3)."""
        from trimesh.triangles import closest_point, points_to_barycentric

        count = min(neighbours, len(self._face))
        face = self._face[self._tree.query(points, k=count)[1].reshape(len(points), count)]
        # closest_point() has tolerances that are meant for sizes about 1.
        triangles, around = (
            (one - self._middle) / self._extent
            for one in (self.triangles[face].reshape(-1, 3, 3), np.repeat(points, count, axis=0))
        )
        on_faces = closest_point(triangles, around) * self._extent + self._middle
        on_faces = on_faces.reshape(len(points), count, 3)
        best = np.linalg.norm(on_faces - points[:, None], axis=2).argmin(1)[:, None]
        face = np.take_along_axis(face, best, 1)[:, 0]
        position = np.take_along_axis(on_faces, best[:, :, None], 1)[:, 0]
        with np.errstate(all="ignore"):
            b = points_to_barycentric(self.triangles[face], position, method="cross")
        b = np.where(np.isfinite(b).all(1, keepdims=True), b, 1.0 / 3.0)  # of faces without area
        return NearestPoints(position, face, np.clip(b, 0.0, 1.0))

    def colors(self, places: NearestPoints) -> Tensor | None:
        """Return radiance (N, C) float64, or base colours of lit meshes; None where no mesh has any."""
        if all(mesh.channels is None for mesh in self.meshes):
            return None
        C = max(mesh.channels or 1 for mesh in self.meshes)
        found = torch.zeros(len(places.face), C, dtype=torch.float64)
        for i, mesh in enumerate(self.meshes):
            rows = (places.face >= self._first[i]) & (places.face < self._first[i + 1])
            if rows.any():
                face = torch.from_numpy(places.face[rows] - self._first[i])
                b = torch.from_numpy(places.b[rows])
                found[torch.from_numpy(rows)] = OnMesh(mesh.detach().to("cpu"), face, b).base_color().double()
        return found
