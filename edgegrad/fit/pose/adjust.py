"""The last steps of a fit of cameras: poses of an object in one or several places, and the lens that all pictures share.

Each place has the evidence of its pictures (evidence.py), a quadratic model of their loss by the pose there and the lens. Their
sum is a model by all poses and the one lens, which a Gauss-Newton step solves (Triggs et al., Bundle Adjustment: A Modern
Synthesis, 2000). Models may be of different lenses, as from fits of single pictures: the lens that is solved for is where they
agree best.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .evidence import Evidence, Source
from .pose import Pose
from .task import ZOOM
from .uncertainty import WIDEST

MOST = 12  # steps
STILL = 0.5  # standard deviations of a number, on average: the samples of renders move steps as far
LONGEST = 0.1  # radians or object sizes, of a pose in one step
DAMPING = 1e-3  # of the diagonal of the curvature, after a step that was taken back; ten times as much after the next


class Adjusted(NamedTuple):
    """Poses at one lens, and the covariance of all numbers."""

    poses: list[Pose]
    covariance: Tensor  # (n, n), of the entries of all poses, place by place, and then of the lens
    loss: float  # the sum over all places
    evidence: list[Evidence]
    short: bool  # whether the last step was
    agreed: bool  # whether all poses have the same lens

    def covariance_of(self, k: int, source: Source) -> Tensor:
        """(m, m) of one place's pose and of the lens, in the order of the entries that its task seeks."""
        rows = _rows([len(poses_of(source))] * len(self.poses), len(self.covariance))[k]
        return self.covariance[rows][:, rows]


def poses_of(source: Source) -> list[int]:
    """The entries of a step that move the pose."""
    return [entry for entry in source.task.free if entry < ZOOM]


def lens_of(source: Source, pose: Pose) -> Tensor:
    """Return how far the sought numbers of the lens are from the given ones, in the order of a step's entries."""
    found = torch.cat([pose.focal.log()[None], pose.principal, pose.distortion])
    return found[[entry - ZOOM for entry in source.task.free if entry >= ZOOM]]


def adjusted(
    sources: Sequence[Source], poses: Sequence[Pose], most: int = MOST, after_step: Callable[[Adjusted], None] | None = None
) -> Adjusted:  # fmt: skip
    """The most likely poses and lens, from poses nearby. `after_step` is called before each step with the best so far."""
    best = _model(sources, list(poses))
    damping = 0.0
    for _ in range(most):
        if after_step is not None:
            after_step(best)
        moves = _step(sources, best, damping)
        if best.agreed and _is_still(sources, best, moves):
            return best._replace(short=True)
        there = [
            source.task.moved(pose, source.task.free, move)
            for source, pose, move in zip(sources, best.poses, moves, strict=True)
        ]
        found = _model(sources, there)
        slack = sum(evidence.slack for evidence in best.evidence)
        # Single pictures may each have a lower loss with a lens of their own.
        if not best.agreed or found.loss <= best.loss + slack:
            best, damping = found, 0.0 if damping <= DAMPING else 0.1 * damping
        else:
            damping = max(DAMPING, 10.0 * damping)
    return best


def _model(sources: Sequence[Source], poses: list[Pose]) -> Adjusted:
    """Return the sum of the models of all places."""
    evidence = [source.at(pose) for source, pose in zip(sources, poses, strict=True)]
    rows, n = _places(sources)
    H, S = torch.zeros(n, n, dtype=torch.float64), torch.zeros(n, n, dtype=torch.float64)
    for own, one in zip(rows, evidence, strict=True):
        H[own[:, None], own] += one.curvature
        S[own[:, None], own] += one.scores
    # Numbers that the pictures do not show are one more pixel of the same noise gave them to WIDEST.
    noise = _noise(evidence)
    prior = torch.eye(n, dtype=torch.float64) * noise / WIDEST**2
    inverse = torch.linalg.inv(H + prior)
    covariance = inverse @ (S + noise * prior) @ inverse
    lenses = torch.stack([lens_of(source, pose) for source, pose in zip(sources, poses, strict=True)])
    agreed = bool((lenses - lenses[0]).abs().max() < 1e-9) if lenses.numel() else True
    return Adjusted(poses, covariance, sum(one.loss for one in evidence), evidence, False, agreed)


def _step(sources: Sequence[Source], model: Adjusted, damping: float) -> list[Tensor]:
    """Return the moves (m,) of each place, by the entries that its task seeks."""
    rows, n = _places(sources)
    A, b = torch.zeros(n, n, dtype=torch.float64), torch.zeros(n, dtype=torch.float64)
    lenses = [lens_of(source, pose) for source, pose in zip(sources, model.poses, strict=True)]
    for own, one, lens in zip(rows, model.evidence, lenses, strict=True):
        H = one.curvature + damping * torch.diag(one.curvature.diagonal())
        # Poses are steps from where they are, and the lens is counted from the given one.
        here = torch.cat([lens.new_zeros(len(own) - len(lens)), lens])
        A[own[:, None], own] += H
        b[own] += H @ here - one.gradient
    x = torch.linalg.solve(A + torch.eye(n, dtype=torch.float64) * _noise(model.evidence) / WIDEST**2, b)
    moves = []
    for own, lens in zip(rows, lenses, strict=True):
        move = x[own]
        move[len(own) - len(lens) :] -= lens
        moves.append(move)
    longest = max(
        (float(m[: len(m) - len(lens)].abs().max()) for m, lens in zip(moves, lenses, strict=True)), default=0.0
    )
    shorter = min(1.0, LONGEST / max(longest, 1e-300)) if model.agreed else 1.0
    return [shorter * move for move in moves]


def _is_still(sources: Sequence[Source], model: Adjusted, moves: Sequence[Tensor]) -> bool:
    """Whether a step is short by the covariance of what it moves."""
    rows, n = _places(sources)
    whole = torch.zeros(n, dtype=torch.float64)
    for own, move in zip(rows, moves, strict=True):
        whole[own] = move
    return float(whole @ torch.linalg.solve(model.covariance, whole)) <= STILL**2 * n


def _noise(evidence: Sequence[Evidence]) -> float:
    """Return the covariance of the loss's gradient, as a part of its curvature."""
    curvature = sum(float(one.curvature.trace()) for one in evidence)
    return sum(float(one.scores.trace()) for one in evidence) / max(curvature, 1e-300) or math.ulp(0.0)


def _places(sources: Sequence[Source]) -> tuple[list[Tensor], int]:
    """Return where the entries of each place are among all numbers, and how many numbers there are."""
    counts = [len(poses_of(source)) for source in sources]
    n = sum(counts) + len(sources[0].task.free) - counts[0]
    return _rows(counts, n), n


def _rows(counts: Sequence[int], n: int) -> list[Tensor]:
    lens = torch.arange(sum(counts), n)
    firsts = [sum(counts[:k]) for k in range(len(counts))]
    return [torch.cat([torch.arange(a, a + count), lens]) for a, count in zip(firsts, counts, strict=True)]
