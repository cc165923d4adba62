"""Joint refinement of poses and of the lens that all pictures share.

Each place has a quadratic model of its loss by its pose and the lens (loss_model.py). The sum of these models is one by all
poses and the lens; a Gauss-Newton step solves it (Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000). The models may
be of different lenses, as from fits of single pictures: the step then finds the lens on which they agree best.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .loss_model import LossModel, LossSource
from .pose import Pose
from .task import FOCAL_LENGTH
from .uncertainty import PRIOR_DEVIATION

MAX_ADJUST_STEPS = 12
SHORT_STEP_DEVIATIONS = (
    0.5  # Mean step in standard deviations that counts as short: noise of the renders moves steps as far.
)
MAX_POSE_MOVE = 0.1  # Longest move of a pose in one step, in radians or object sizes.
RETRY_DAMPING = (
    1e-3  # Relative to the curvature's diagonal, after a rejected step; each further rejection multiplies it by ten.
)


class Adjustment(NamedTuple):
    """Poses at one lens, and the covariance of all numbers."""

    poses: list[Pose]
    covariance: Tensor  # (n, n), of the entries of all poses, place by place, and then of the lens
    loss: float
    evidence: list[LossModel]
    short: bool  # The last step was short.
    agreed: bool  # All poses have the same lens.

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


def adjust_bundle(
    sources: Sequence[LossSource], poses: Sequence[Pose], most: int = MAX_ADJUST_STEPS,
    after_step: Callable[[Adjustment], None] | None = None,
) -> Adjustment:  # fmt: skip
    """Return the most likely poses and lens near the given ones. `after_step` is called before each step with the
    best so far."""
    best = _model(sources, list(poses))
    damping = 0.0
    for _ in range(most):
        if after_step is not None:
            after_step(best)
        moves = _step(sources, best, damping)
        if best.agreed and _is_still(sources, best, moves):
            return best._replace(short=True)
        there = [
            source.task.moved(pose, source.task.dofs, move)
            for source, pose, move in zip(sources, best.poses, moves, strict=True)
        ]
        found = _model(sources, there)
        slack = sum(evidence.slack for evidence in best.evidence)
        # Each picture alone may have a lower loss with a lens of its own, so the first common lens is always accepted.
        if not best.agreed or found.loss <= best.loss + slack:
            best, damping = found, 0.0 if damping <= RETRY_DAMPING else 0.1 * damping
        else:
            damping = max(RETRY_DAMPING, 10.0 * damping)
    return best


def _model(sources: Sequence[LossSource], poses: list[Pose]) -> Adjustment:
    """Return the sum of the models of all places."""
    evidence = [source.at(pose) for source, pose in zip(sources, poses, strict=True)]
    rows, n = _places(sources)
    H, S = torch.zeros(n, n, dtype=torch.float64), torch.zeros(n, n, dtype=torch.float64)
    for own, one in zip(rows, evidence, strict=True):
        H[own[:, None], own] += one.curvature
        S[own[:, None], own] += one.scores
    # The prior is one more pixel of the same noise, which shows each number to within PRIOR_DEVIATION.
    noise = _noise(evidence)
    prior = torch.eye(n, dtype=torch.float64) * noise / PRIOR_DEVIATION**2
    inverse = torch.linalg.inv(H + prior)
    covariance = inverse @ (S + noise * prior) @ inverse
    lenses = torch.stack([lens_of(source, pose) for source, pose in zip(sources, poses, strict=True)])
    agreed = bool((lenses - lenses[0]).abs().max() < 1e-9) if lenses.numel() else True
    return Adjustment(poses, covariance, sum(one.loss for one in evidence), evidence, False, agreed)


def _step(sources: Sequence[LossSource], model: Adjustment, damping: float) -> list[Tensor]:
    """Return the moves (m,) of each place, by the entries that its task seeks."""
    rows, n = _places(sources)
    A, b = torch.zeros(n, n, dtype=torch.float64), torch.zeros(n, dtype=torch.float64)
    lenses = [lens_of(source, pose) for source, pose in zip(sources, model.poses, strict=True)]
    for own, one, lens in zip(rows, model.evidence, lenses, strict=True):
        H = one.curvature + damping * torch.diag(one.curvature.diagonal())
        # Poses count from where they are, the lens from the given one.
        here = torch.cat([lens.new_zeros(len(own) - len(lens)), lens])
        A[own[:, None], own] += H
        b[own] += H @ here - one.gradient
    x = torch.linalg.solve(A + torch.eye(n, dtype=torch.float64) * _noise(model.evidence) / PRIOR_DEVIATION**2, b)
    moves = []
    for own, lens in zip(rows, lenses, strict=True):
        move = x[own]
        move[len(own) - len(lens) :] -= lens
        moves.append(move)
    longest = max(
        (float(m[: len(m) - len(lens)].abs().max()) for m, lens in zip(moves, lenses, strict=True)), default=0.0
    )
    shorter = min(1.0, MAX_POSE_MOVE / max(longest, 1e-300)) if model.agreed else 1.0
    return [shorter * move for move in moves]


def _is_still(sources: Sequence[LossSource], model: Adjustment, moves: Sequence[Tensor]) -> bool:
    """Return whether a step is short by the covariance of what it moves."""
    rows, n = _places(sources)
    whole = torch.zeros(n, dtype=torch.float64)
    for own, move in zip(rows, moves, strict=True):
        whole[own] = move
    return float(whole @ torch.linalg.solve(model.covariance, whole)) <= SHORT_STEP_DEVIATIONS**2 * n


def _noise(evidence: Sequence[LossModel]) -> float:
    """Return the ratio of the covariance of the loss's gradient to the loss's curvature."""
    curvature = sum(float(one.curvature.trace()) for one in evidence)
    return sum(float(one.scores.trace()) for one in evidence) / max(curvature, 1e-300) or math.ulp(0.0)


def _places(sources: Sequence[LossSource]) -> tuple[list[Tensor], int]:
    """Return where the entries of each place are among all numbers, and how many numbers there are."""
    counts = [len(poses_of(source)) for source in sources]
    n = sum(counts) + len(sources[0].task.dofs) - counts[0]
    return _rows(counts, n), n


def _rows(counts: Sequence[int], n: int) -> list[Tensor]:
    lens = torch.arange(sum(counts), n)
    firsts = [sum(counts[:k]) for k in range(len(counts))]
    return [torch.cat([torch.arange(a, a + count), lens]) for a, count in zip(firsts, counts, strict=True)]
