"""Kinds of cases: what is drawn, how it is fitted, when a fit is right, and how often it must be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import edgegrad as eg
from edgegrad.fit import FitOptions, PoseParameter, fit_camera, fit_pose, fit_poses, fit_scene
from edgegrad.fit.placement import Pose

from . import photographs
from .cases import Case, Placed, Recipe, beside, drawn
from .objects import Sources


@dataclass(frozen=True)
class Kind:
    """Cases of one kind.

    Attributes
    ----------
    degrees, shift : largest errors of a fit that is right, the shift as a share of the object's size
    must : share of fits that must be right, and the same in words
    recipe : how pictures are drawn; None: a real photograph
    medoid : whether fits are compared with the one nearest to all others, because the true pose is not known
    """

    degrees: float
    shift: float
    must: float = 0.0
    recipe: Recipe | None = None
    medoid: bool = False


class Found(NamedTuple):
    """The result of a fit: the pose of one object, by which camera, and what the fit says of it."""

    pose: Placed
    camera: eg.Camera
    fit: Any


KINDS = {
    "easy15": Kind(0.5, 0.003, 0.97, Recipe(fixed=True, start=(5.0, 15.0, 0.05))),
    "easy30": Kind(0.5, 0.003, 0.95, Recipe(fixed=True, start=(10.0, 30.0, 0.1))),
    "lit": Kind(1.0, 0.01, 0.92, Recipe()),
    "covered": Kind(1.5, 0.03, 0.9, Recipe(covered=True)),
    "plain": Kind(2.0, 0.03, 0.8, Recipe(plain=True)),
    "global": Kind(1.0, 0.01, 0.9, Recipe(start=None)),
    "shadow": Kind(1.5, 0.03, 0.0, Recipe(shadow=True)),
    "two": Kind(2.0, 0.03, 0.8, Recipe(count=2)),
    "three": Kind(2.0, 0.03, 0.8, Recipe(count=3)),
    "camera": Kind(1.0, 0.01, 0.9, Recipe(start=(10.0, 10.0, 0.05))),
    "focal": Kind(1.5, 0.1, 0.8, Recipe(start=(10.0, 10.0, 0.05))),  # The distance goes with the focal length.
    "global-mask": Kind(1.0, 0.01, 0.9, Recipe(mask=True, start=None)),
    "mask": Kind(1.0, 0.01, 0.9, Recipe(mask=True)),
    # Fits that said they had converged and had not.
    "stone": Kind(2.0, 0.03, 0.0, Recipe(only="stone", plain=True)),
    "beside": Kind(2.0, 0.03, 0.0, Recipe(others=2, plain=True)),
    "clutter": Kind(2.0, 0.03, 0.0, Recipe(boards=True, plain=True, start=(12.0, 12.0, 0.08))),
    "squirrel": Kind(0.3, 0.006, 1.0, medoid=True),
    "gelatin": Kind(1.5, 0.03, 0.95),
    "gelatin-depth": Kind(1.5, 0.03, 0.95),
    "cracker": Kind(0.5, 0.01, medoid=True),
    "bottle": Kind(2.0, 0.01, 1.0),
    "bottle-depth": Kind(1.0, 0.014, 1.0),
}
MADE = [name for name, kind in KINDS.items() if kind.recipe]
REAL = [name for name, kind in KINDS.items() if not kind.recipe]


def cases(name: str, seed: int, sources: Sources, folder: Path | None = None) -> list[Case]:
    """Return the cases of a kind and a seed, one for each object that one fit seeks."""
    recipe = KINDS[name].recipe
    return drawn(name, recipe, seed, sources) if recipe else [_photograph(name, seed, folder or Path())]


def _photograph(name: str, seed: int, folder: Path) -> Case:
    """Return a real photograph with a start around the pose that is known about."""
    what, _, depth = name.partition("-")
    if what == "gelatin":
        case = photographs.gelatin_box(folder, bool(depth))
    elif what == "bottle":
        case = photographs.bottle(folder, 200 + seed % 2, bool(depth))
    else:
        case = photographs.squirrel(folder) if what == "squirrel" else photographs.cracker_box(folder)
    rng = np.random.default_rng([7, seed])
    low, high = (3.0, 15.0) if what == "squirrel" else (5.0, 12.0)
    return case.started(rng.uniform(low, high), rng.uniform(0.0, 0.05), rng)


def fitted(name: str, seed: int, given: list[Case], settings: object = None) -> list[Found]:
    """Return the fit of each object. Settings that are not None are passed on to fit_pose()."""
    case, options = given[0], FitOptions(seed=0, progress=False)
    starts = [one.start.matrix for one in given if one.start is not None]
    if name in ("camera", "focal"):
        still = case.mesh.transformed(case.truth.R.float(), case.truth.t.float())
        fit = fit_camera(still, case.picture, beside(name, case, seed), focal=name == "focal", options=options)
        # The pose of the object before the case's camera.
        to_camera = case.camera.world_to_camera.double()
        moved = to_camera.inverse() @ fit.camera.world_to_camera.double() @ case.truth.matrix
        return [Found(Placed.from_matrix(moved), case.camera.replace(K=fit.camera.K), fit)]
    if name == "clutter":
        sought = {"pose": PoseParameter(Pose(starts[0][:3, :3], starts[0][:3, 3]))}
        region = replace(options, loss="region", method="gauss-newton", spp=8)
        fits = [fit_scene(case.mesh, case.picture, case.camera, sought, options=region)]
        return [Found(Placed(fit.poses["pose"].R, fit.poses["pose"].t), case.camera, fit) for fit in fits]
    if len(given) > 1:
        fits = fit_poses([one.mesh for one in given], case.picture, case.camera, init=starts, options=options)
        return [Found(Placed(fit.R, fit.t), case.camera, fit) for fit in fits]
    further: dict[str, Any] = {} if settings is None else {"settings": settings}
    fit = fit_pose(
        case.mesh, case.picture, case.camera, case.mask, starts[0] if starts else None, depths=case.depth,
        search=True if starts else "global", options=options, **further,
    )  # fmt: skip
    return [Found(Placed(fit.R, fit.t), case.camera, fit)]
