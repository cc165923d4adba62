"""Joint refinement of poses and of the lens that all pictures share.

Each place has a quadratic model of its loss by its pose and the lens (loss_model.py). The sum of these models is one by all
poses and the lens, whose damped Gauss-Newton steps lead to the most likely ones (Triggs et al., Bundle Adjustment: A Modern
Synthesis, 2000). Fits of single pictures have lenses of their own; a step of all their models finds the lens on which they
agree best.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...optim.levenberg_marquardt import LevenbergMarquardt, LevenbergMarquardtSettings, Model, Problem, Rest, minimise
from ...optim.loop import nothing
from .loss_model import LossModel, LossSource
from .pose import Pose
from .settings import CAMERA
from .task import FOCAL_LENGTH

# Poses move by at most 0.1 radians or object sizes in one step. The damping is that of steps that are taken back.
ADJUST = LevenbergMarquardtSettings(start_damping=1e-3, least_damping=1e-6, unseen_damping=0.0, trust_radius=0.1)
Poses = tuple[Pose, ...]


class Adjustment(NamedTuple):
    """Poses at one lens, and the covariance of all numbers."""

    poses: Poses
    covariance: Tensor  # (n, n), of the entries of all poses, place by place, and then of the lens
    loss: float
    evidence: list[LossModel]
    short: bool = False  # The last step was short.

    def covariance_of(self, k: int, source: LossSource) -> Tensor:
        """Return the covariance (m, m) of one place's pose and the lens, in the order of the entries that its task seeks."""
        rows = _rows([len(poses_of(source))] * len(self.poses), len(self.covariance))[k]
        return self.covariance[rows][:, rows]


def poses_of(source: LossSource) -> list[int]:
    """Return the entries of a step that move the pose."""
    return [entry for entry in source.task.dofs if entry < FOCAL_LENGTH]


def lens_of(source: LossSource, pose: Pose) -> Tensor:
    """Return the changes of the sought numbers of the lens, in the order of a step's entries."""
    found = torch.cat([pose.focal.log()[None], pose.principal, pose.distortion])
    return found[[entry - FOCAL_LENGTH for entry in source.task.dofs if entry >= FOCAL_LENGTH]]


class Bundle(Problem[Poses]):
    """Poses of all places and the lens as one descent. Its cost is in units of the noise of the pictures, so that a standard
    deviation costs ½. A prior of the settings' prior_deviation holds moves of poses, and the lens at the given one."""

    def __init__(self, sources: Sequence[LossSource]) -> None:
        self.sources = sources
        counts = [len(poses_of(source)) for source in sources]
        n = sum(counts) + len(sources[0].task.dofs) - counts[0]
        self.rows = _rows(counts, n)  # where the entries of each place are among all numbers
        self.units = torch.ones(n, dtype=torch.float64)
        self.units[sum(counts) :] = CAMERA.lens_unit
        self.noise: float | None = None  # of the first poses
        self.last: Adjustment | None = None  # what was evaluated last

    def model(self, points: Sequence[Poses]) -> Model:
        (poses,) = points
        evidence = [source.at(pose) for source, pose in zip(self.sources, poses, strict=True)]
        self.last = self._adjustment(poses, evidence)
        self.noise = self.noise or _noise(evidence)
        H = self._sum([one.curvature for one in evidence]) + self._prior(self.noise)
        gradient = self._sum([one.gradient for one in evidence])
        lens = lens_of(self.sources[0], poses[0])
        gradient[len(gradient) - len(lens) :] += self.noise / CAMERA.prior_deviation**2 * lens
        prior = 0.5 / CAMERA.prior_deviation**2 * float(lens.square().sum())
        cost = sum(one.loss / one.per_loss for one in evidence) / self.noise + prior
        slack = sum(one.slack / one.per_loss for one in evidence) / self.noise
        return Model(
            torch.tensor([[cost]], dtype=torch.float64), (gradient * self.units / self.noise)[None],
            (H * self.units * self.units[:, None] / self.noise)[None], torch.tensor([slack], dtype=torch.float64),
        )  # fmt: skip

    def moved(self, points: Sequence[Poses], steps: Tensor) -> list[Poses]:
        moves = [[move[own] for own in self.rows] for move in steps * self.units]
        return [self._moved(poses, parts) for poses, parts in zip(points, moves, strict=True)]

    def agreed(self, poses: Sequence[Pose]) -> Poses:
        """Return the most likely poses at a common lens, by the models at poses with lenses of their own. Each picture alone may
        have a lower loss with its own."""
        lenses = [lens_of(source, pose) for source, pose in zip(self.sources, poses, strict=True)]
        if all(lens.numel() == 0 or float((lens - lenses[0]).abs().max()) < 1e-9 for lens in lenses):
            return tuple(poses)
        evidence = [source.at(pose) for source, pose in zip(self.sources, poses, strict=True)]
        self.noise = _noise(evidence)
        # Poses count from where they are, the lens from the given one.
        here = [
            torch.cat([lens.new_zeros(len(own) - len(lens)), lens]) for own, lens in zip(self.rows, lenses, strict=True)
        ]
        slopes = [one.gradient - one.curvature @ x for one, x in zip(evidence, here, strict=True)]
        H = self._sum([one.curvature for one in evidence]) + self._prior(self.noise)
        end = -torch.linalg.solve(H, self._sum(slopes))
        return self._moved(poses, [end[own] - x for own, x in zip(self.rows, here, strict=True)])

    def _moved(self, poses: Sequence[Pose], moves: Sequence[Tensor]) -> Poses:
        places = zip(self.sources, poses, moves, strict=True)
        return tuple(source.task.moved(pose, source.task.dofs, move) for source, pose, move in places)

    def _sum(self, parts: Sequence[Tensor]) -> Tensor:
        """Return the sum, by all numbers, of vectors (m,) or matrices (m, m) by the numbers of each place."""
        total = torch.zeros((len(self.units),) * parts[0].dim(), dtype=torch.float64)
        for own, part in zip(self.rows, parts, strict=True):
            total[torch.meshgrid([own] * part.dim(), indexing="ij")] += part
        return total

    def _prior(self, noise: float) -> Tensor:
        """Return the curvature of the prior: one more pixel of the same noise, which shows each number to within
        `prior_deviation`."""
        return torch.eye(len(self.units), dtype=torch.float64) * noise / CAMERA.prior_deviation**2

    def _adjustment(self, poses: Poses, evidence: list[LossModel]) -> Adjustment:
        """Return the poses with the covariance of all numbers."""
        noise = _noise(evidence)
        prior = self._prior(noise)
        inverse = torch.linalg.inv(self._sum([one.curvature for one in evidence]) + prior)
        covariance = inverse @ (self._sum([one.scores for one in evidence]) + noise * prior) @ inverse
        return Adjustment(poses, covariance, sum(one.loss for one in evidence), evidence)


def adjust_bundle(
    sources: Sequence[LossSource], poses: Sequence[Pose], most: int = CAMERA.adjust_steps,
    after_step: Callable[[Adjustment], Any] = nothing,
) -> Adjustment:  # fmt: skip
    """Return the most likely poses and lens near the given ones, after at most so many steps. `after_step` is called with the
    best so far."""
    bundle, best = Bundle(sources), []

    def note(descents: LevenbergMarquardt[Poses]) -> None:
        if bundle.last is not None and descents.descents[0].point is bundle.last.poses:
            best[:] = [bundle.last]
        after_step(best[0])

    # The expected decrease of the cost by a step is half its square in standard deviations.
    short = 0.5 * CAMERA.short_step**2 * len(bundle.units)
    settings = replace(ADJUST, steps=most + 1, least_gain=short)
    found = minimise(bundle, [bundle.agreed(poses)], settings, note)
    if found.interrupted:
        raise KeyboardInterrupt
    return best[0]._replace(short=found.descents[0].rest is Rest.SHORT)


def _noise(evidence: Sequence[LossModel]) -> float:
    """Return the ratio of the covariance of the loss's gradient to the loss's curvature."""
    curvature = sum(float(one.curvature.trace()) for one in evidence)
    return sum(float(one.scores.trace()) for one in evidence) / max(curvature, 1e-300) or math.ulp(0.0)


def _rows(counts: Sequence[int], n: int) -> list[Tensor]:
    lens = torch.arange(sum(counts), n)
    firsts = [sum(counts[:k]) for k in range(len(counts))]
    return [torch.cat([torch.arange(a, a + count), lens]) for a, count in zip(firsts, counts, strict=True)]
