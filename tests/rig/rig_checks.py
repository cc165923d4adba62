"""Rigs of glTF samples against their reference, and samples that are changed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from rig_files import Sample, places, simple_skin

import edgegrad as eg


def meshes_of(posed: Any) -> list[eg.Mesh]:
    return [posed] if isinstance(posed, eg.Mesh) else list(posed.meshes)


def check(sample: Sample, rig: eg.rig.Rig, posed: Any, animation: int | None, t: float) -> None:
    """Check vertices to 1e-6 of the size of what is shown."""
    expected = places(sample, animation, t)
    found = meshes_of(posed)
    assert len(found) == len(expected)
    low, high = (np.array([getattr(p.positions.reshape(-1, 3), side)(0) for p in expected]) for side in ("min", "max"))
    size = np.linalg.norm(high.max(0) - low.min(0))
    for mesh, place in zip(found, expected, strict=True):
        corners = mesh.verts[mesh.faces].double().numpy()
        assert np.abs(corners - place.positions).max() <= 1e-6 * size
        if place.normals is not None and mesh.normals is not None:
            index = mesh.faces if mesh.normal_faces is None else mesh.normal_faces
            assert np.abs(mesh.normals[index].double().numpy() - place.normals).max() <= 2e-6


def malformed(change: Callable[[Sample], Any], make: Callable[[], Sample] = simple_skin) -> Sample:
    sample = make()
    change(sample)
    return sample


def primitive(sample: Sample) -> dict[str, Any]:
    return sample.tree["meshes"][0]["primitives"][0]
