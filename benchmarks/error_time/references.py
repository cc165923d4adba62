"""References of the methods, with their own errors.

They are exact pixel integrals where possible, else long runs of edgegrad. Finite differences check these for translation and
rotation of the whole object.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from oracles.exact import exact_image, one_thread
from torch import Tensor

from edgegrad.files.paths import replacing

from ..scenes import ReportScene
from .methods import Edgegrad, FiniteDifferences, Method, rigid

EXACT = ("triangle", "slivers")  # untextured, and few enough faces
SEED = 1 << 40  # seeds of references are none that a method uses
PARTS = ("whole", "interior", "boundary")
Values = dict[str, Any]
Keep = Callable[
    [str, Callable[[], Values]], Values
]  # what is in the file of a name, or else what the function computes


@dataclass(frozen=True)
class Effort:
    """Lengths of long runs: numbers of samples, at least `factor` times the default and at most `most`.

    There are many runs, because each draws its own lines of intersection where faces intersect too often.
    """

    surface_samples: int = 1 << 23
    edge_samples: int = 1 << 20
    factor: float = 16.0
    most: int = 1 << 23
    runs: int = 16
    check_spp: int = 256  # of the finite differences
    check_seeds: int = 4


# Lit scenes are shaded in PyTorch, point by point.
LIT = Effort(1 << 18, 1 << 21, 64.0, 1 << 21, runs=4)
# Of light that is scattered more than once each sample follows a path.
BOUNCED = Effort(1 << 18, 1 << 19, 64.0, 1 << 21, runs=4, check_spp=64)
QUICK = Effort(1 << 16, 1 << 14, 4.0, 1 << 21, runs=2, check_spp=16, check_seeds=2)


@dataclass
class Reference:
    """The gradient and its two terms, with what is known about its error. All errors are relative to the whole."""

    kind: str  # in words
    interior: Tensor  # (V, 3) float64
    boundary: Tensor  # (V, 3)
    # Of each part and metric: the standard error, from the spread of the runs; none for exact ones.
    error: dict[str, dict[str, float]] = field(default_factory=dict)
    # Of translation and rotation: distance to finite differences, and the standard error of the two together.
    check: dict[str, dict[str, float]] = field(default_factory=dict)

    def metrics(self, scene: ReportScene, part: str = "whole") -> dict[str, Tensor]:
        vertex = {"whole": self.interior + self.boundary, "interior": self.interior, "boundary": self.boundary}[part]
        return rigid(scene, vertex)


def reference(
    scene: ReportScene, folder: Path, effort: Effort, say: Callable[[str], None] = lambda text: None
) -> Reference:
    """From reference-NAME.pt in `folder` if it is there for the same scene and effort, else computed and written there.

    Each run on the way there has a file of its own until all are done: Ctrl-C loses one of them, not the others.
    """
    key = f"{scene.fingerprint} {effort}"

    def keep(name: str, compute: Callable[[], Values]) -> Values:
        path = folder / f"reference-{scene.name}{name}.pt"
        if path.exists():
            try:
                stored: Values = torch.load(path, weights_only=True)
                if stored.pop("key") == key:
                    return stored
            except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError, TypeError, ValueError, AttributeError):
                say(f"{path.name} cannot be read: it is computed again")
        found = compute()
        with replacing(path) as temporary:
            torch.save({"key": key, **found}, temporary)
        return found

    def whole() -> Values:
        found = exact(scene) if scene.name in EXACT else long_run(scene, effort, keep)
        found.check = check(scene, found, effort, keep)
        return vars(found)

    found = Reference(**keep("", whole))
    for path in folder.glob(f"reference-{scene.name}-*.pt"):  # of single runs
        path.unlink()
    return found


def _in_no_file(name: str, compute: Callable[[], Values]) -> Values:
    return compute()


def _runs(keep: Keep, name: str, method: Method, budget: float, count: int) -> list[dict[str, Tensor]]:
    """Return the metrics of `count` runs."""
    return [
        keep(f"-{name}-{run}", lambda run=run: method.gradient(budget, SEED + run).metrics()) for run in range(count)
    ]


def exact(scene: ReportScene) -> Reference:
    """Compute the reference by exact pixel integrals in float64."""

    def gradient(visibility: bool) -> Tensor:
        verts = scene.verts.requires_grad_()
        image = exact_image(scene.moved(verts), scene.camera, visibility=visibility)
        if not image.requires_grad:  # colours are constant over faces: nothing changes inside
            return torch.zeros_like(verts)
        return torch.autograd.grad((image * scene.adjoint.double()).sum(), verts, materialize_grads=True)[0]

    with one_thread():
        whole, interior = gradient(True), gradient(False)
    return Reference("exact pixel integrals", interior, whole - interior)


def long_run(scene: ReportScene, effort: Effort, keep: Keep = _in_no_file) -> Reference:
    """Compute the reference as the mean of long runs of each term; their spread gives its error."""
    runs: dict[str, list[Tensor]] = {}
    factors = {}
    for part, least in (("interior", effort.surface_samples), ("boundary", effort.edge_samples)):
        method = Edgegrad(scene, part)
        default = method.samples[part == "boundary"]
        factors[part] = min(max(effort.factor, least / default), effort.most / default) if default else 1.0
        runs[part] = [run["vertex"] for run in _runs(keep, part, method, factors[part], effort.runs)]
    runs["whole"] = [a + b for a, b in zip(runs["interior"], runs["boundary"], strict=True)]
    result = Reference(
        f"edgegrad, {effort.runs} runs at × {factors['interior']:.0f} default surface samples, "
        f"× {factors['boundary']:.0f} edge samples",
        torch.stack(runs["interior"]).mean(0), torch.stack(runs["boundary"]).mean(0),
    )  # fmt: skip
    norms = {name: float(value.norm()) for name, value in result.metrics(scene).items()}
    for part in PARTS:
        several = [rigid(scene, vertex) for vertex in runs[part]]
        result.error[part] = {
            name: standard_error([run[name] for run in several]) / max(norm, 1e-300) for name, norm in norms.items()
        }
    return result


def check(
    scene: ReportScene, found: Reference, effort: Effort, keep: Keep = _in_no_file
) -> dict[str, dict[str, float]]:
    """Return the distance of the reference to finite differences, which are independent of edgegrad's gradients."""
    method = FiniteDifferences(scene)
    runs = _runs(keep, "check", method, effort.check_spp, effort.check_seeds)
    result = {}
    for name in ("translation", "rotation"):
        several, correct = [run[name] for run in runs], found.metrics(scene)[name]
        norm = max(float(correct.norm()), 1e-300)
        own = found.error["whole"][name] if found.error else 0.0
        result[name] = {
            "difference": float((torch.stack(several).mean(0) - correct).norm()) / norm,
            "standard_error": ((standard_error(several) / norm) ** 2 + own**2) ** 0.5,
        }
    return result


def disagrees(check: dict[str, float]) -> bool:
    """Return True if chance and the step of the finite differences (2 % allowed) do not explain the distance."""
    return check["difference"] > 4.0 * check["standard_error"] + 0.02


def standard_error(runs: list[Tensor]) -> float:
    """Return the standard error of the mean of runs: the root of the summed variances of its components."""
    if len(runs) < 2:
        return float("nan")
    return float((torch.stack(runs).var(0).sum() / len(runs)).sqrt())
