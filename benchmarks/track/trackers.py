"""How films are shown to trackers: one picture after the other, and what is kept of their answers.

A tracker is given by its name, `module:name`. What it names is a generator as edgegrad.fit.track, which takes
(mesh, frames, camera, init, depths=…), or a class that takes (mesh, camera, init) and whose update(image, depth) returns a pose;
for several objects it takes sequences and returns as many poses. Poses have `matrix` or R and t, and `lost`; the others that are
read where they are there: `covariance` (6, 6) of a rotation vector in radians and a shift of the object's centre in world units,
both in the axes of the world, `confidence`, `visible` and `features`.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from edgegrad.files.image import srgb_to_linear

from .films import Film

GENERATOR = "edgegrad.fit:track"


class Estimate(NamedTuple):
    """What a tracker says of one object in one picture."""

    matrix: np.ndarray  # (4, 4) mesh to world
    lost: bool = False
    covariance: np.ndarray | None = None  # (6, 6)
    confidence: float = math.nan
    visible: float = math.nan
    features: Mapping[str, float] = {}

    @staticmethod
    def of(pose: Any) -> Estimate:
        """Return what a pose of a tracker holds."""
        covariance = getattr(pose, "covariance", None)
        features: Mapping[str, float] = getattr(pose, "features", None) or {}
        return Estimate(
            _matrix(pose), bool(pose.lost), None if covariance is None else np.asarray(covariance, dtype=float),
            _number(pose, "confidence"), _number(pose, "visible"), {name: float(value) for name, value in features.items()},
        )  # fmt: skip


def _matrix(pose: Any) -> np.ndarray:
    if hasattr(pose, "matrix"):
        return np.asarray(pose.matrix, dtype=float)
    M = np.eye(4)
    M[:3, :3], M[:3, 3] = np.asarray(pose.R), np.asarray(pose.t)
    return M


def _number(pose: Any, name: str) -> float:
    value = getattr(pose, name, None)
    return math.nan if value is None else float(value)


class FilmTracker(Protocol):
    """A tracker at work on one film."""

    def update(self, image: np.ndarray, depth: Tensor | None) -> list[Estimate]:
        """Return an estimate for each object in the next picture (H, W, 3), uint8 sRGB."""
        ...


Maker = Callable[[Film], FilmTracker]


def maker(name: str) -> Maker:
    """Return what makes a tracker of this name. Raises ValueError or ImportError."""
    module, _, attribute = name.partition(":")
    found = getattr(import_module(module), attribute, None) if attribute else None
    if found is None:
        raise ValueError(f"--tracker: expected module:name of a tracker, such as {GENERATOR}, got {name}")
    parameters = inspect.signature(found).parameters
    if not inspect.isclass(found) and "frames" not in parameters:
        raise ValueError(f"--tracker: expected a class or a generator with the argument `frames`, got {name}")
    return (lambda film: Updated(found, film)) if inspect.isclass(found) else (lambda film: Generated(found, film))


class Updated:
    """A class with update()."""

    def __init__(self, kind: Callable[..., Any], film: Film) -> None:
        starts = [torch.tensor(start) for start in film.start]
        self.single = len(film.meshes) == 1
        given = (film.meshes[0], starts[0]) if self.single else (film.meshes, starts)
        self.tracker = kind(given[0], film.camera, given[1])

    def update(self, image: np.ndarray, depth: Tensor | None) -> list[Estimate]:
        found = self.tracker.update(torch.from_numpy(image), depth)
        return [Estimate.of(pose) for pose in ((found,) if self.single else found)]


class Generated:
    """A generator for each object, which reads pictures of linear radiance."""

    def __init__(self, track: Callable[..., Iterator[Any]], film: Film) -> None:
        self.image, self.depth = torch.empty(0), None
        self.poses = [
            track(mesh, self._images(), film.camera, torch.tensor(start), depths=self._depths())
            for mesh, start in zip(film.meshes, film.start, strict=True)
        ]

    def _images(self) -> Iterator[Tensor]:
        while True:
            yield self.image

    def _depths(self) -> Iterator[Tensor | None]:
        while True:
            yield self.depth

    def update(self, image: np.ndarray, depth: Tensor | None) -> list[Estimate]:
        self.image, self.depth = srgb_to_linear(torch.from_numpy(image).float() / 255.0), depth
        return [Estimate.of(next(poses)) for poses in self.poses]
