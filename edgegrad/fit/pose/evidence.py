"""The evidence of pictures about a pose and a lens: slope, curvature and noise of a fit's loss at one pose.

With the loss L = Σ ρ(r_p) over pixels p, its curvature is H = Σ w_p J_p J_pᵀ, its gradient g = Σ s_p with the scores s_p = w_p
r_p J_p, and the noise of the pictures gives g the covariance S = Σ E[s_p s_qᵀ] over pairs of pixels. Numbers that minimise L have
the covariance H⁻¹ S H⁻¹ (Huber, The Behavior of Maximum Likelihood Estimates under Nonstandard Conditions, 1967). Errors of
edges, blur and shadows are correlated in pixels nearby. So pairs count that are less than TOGETHER pixels apart, by Bartlett's
weights, which keep S positive (Newey and West, A Simple, Positive Semi-Definite, Heteroskedasticity and Autocorrelation
Consistent Covariance Matrix, 1987). Where errors are independent, S is the sum over single pixels; where they are correlated, a
block of pixels counts as one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from ...render import jvp
from .gauss_newton import Normal
from .jacobian import Rendered
from .observed import motion
from .photo.cover import covers, weighted
from .photo.level import PhotoLevel, photo_levels
from .photo.search import AS_THEY_ARE
from .pose import Pose
from .robust import NARROWEST, Comparison
from .search import FINAL_SPP, Search
from .soft import softness
from .task import Level, PoseTask
from .uncertainty import TOGETHER


class Evidence(NamedTuple):
    """The quadratic model of a loss at one pose, by the entries of a step that the task seeks."""

    curvature: Tensor  # H (n, n)
    gradient: Tensor  # g (n,)
    scores: Tensor  # S (n, n), the covariance of g
    loss: float  # to compare poses by
    slack: float  # by how much the loss may rise by noise alone
    per_loss: float  # the gradient of `loss`, as a part of g


class Source(Protocol):
    """Pictures that are compared with renders of one object in one place."""

    task: PoseTask
    level: Level

    def at(self, pose: Pose) -> Evidence:
        """Return the evidence at a pose, from the same samples at each."""
        ...

    def judged(self, pose: Pose) -> tuple[float, float]:
        """Return the loss, and the share of the render's edges that the pictures show."""
        ...


class Colours:
    """Pictures that show the mesh's colours as they are, or masks: what Search compares."""

    def __init__(self, task: PoseTask, pose: Pose, max_size: int, spp: int, seed: int) -> None:
        self.task, self.seed = task, seed
        finest = min(1.0, max_size / max(task.shots[0].camera.size))
        sharp = task.level(finest, 0.0, 1.0, max(spp, FINAL_SPP), task.free)
        with torch.no_grad():
            both = [task.images(sharp, pose, sharp.spp, (seed + k) % 2**32) for k in (0, 1)]
        self.level = sharp._replace(soft=softness(task, sharp, *both))
        self.c = NARROWEST * task.extent

    def at(self, pose: Pose) -> Evidence:
        task, level = self.task, self.level
        images, tangents = [], []
        for shot, (scene, camera, seed) in zip(level.shots, task.views(level, pose, self.seed), strict=True):
            moves = motion(task, level, shot, pose)
            if task.reverse_alone:
                W = camera.world_to_camera
                moved = F.pad(torch.cat([moves.linear, moves.shift[..., None]], -1), (0, 0, 0, 1))
                by_tensor = {W: W @ moved, camera.K: moves.K, camera.distortion: moves.distortion}
                own = {tensor: dot for tensor, dot in by_tensor.items() if tensor is not None and dot is not None}
                channels, dots = jvp(scene, camera, _padded(own), level.spp, seed, aovs=task.channels)
            else:
                rendered = Rendered(scene, camera, task.channels, level.spp, seed)
                channels, dots = rendered.images, rendered.derivatives(moves)
            images.append(task.layers(level, shot, channels))
            tangents.append(task.layers(level, shot, dots, slopes=True))
        compared = Comparison(task, level, images)
        residuals, tangents = compared.residuals(self.c), compared.tangents(self.c, tangents)
        normal = Normal.of(residuals, tangents)
        scores = torch.zeros_like(normal.curvature)
        for r, J in zip(residuals, tangents, strict=True):
            scores += noise_of((J * r).sum(-1).double())
        return Evidence(*normal, scores, *compared.loss(self.c), 2.0 / compared.count)

    def judged(self, pose: Pose) -> tuple[float, float]:
        found = Search(self.task, [self.level], pose, 1, 0.5, self.seed)._judged(pose, self.level)
        return found.loss, found.explained


class Photographs:
    """Pictures in unknown light or before unknown things, by the terms of PhotoSearch, which are log likelihoods."""

    def __init__(self, task: PoseTask, pose: Pose, levels: Sequence[PhotoLevel], seed: int) -> None:
        self.task, self.seed = task, seed
        last = levels[-1]
        views = last.see(pose, seed)
        last, weights = last.focused(views), covers(views)
        self.photo = last if weights is None else weighted(last, weights)
        self.level = self.photo.plain

    def at(self, pose: Pose) -> Evidence:
        normal, loss = self.photo.equations(pose, self.seed)
        return Evidence(*normal, TOGETHER**2 * normal.curvature, loss, abs(loss), 1.0)

    def judged(self, pose: Pose) -> tuple[float, float]:
        return self.photo.equations(pose, self.seed)[1], self.photo.explained(pose, self.seed)


def source_of(task: PoseTask, pose: Pose, max_size: int, spp: int, seed: int) -> Source:
    """The terms that suit pictures best, by what a light does to the mesh's colours at a pose."""
    if task.aovs != ("alpha",):
        levels = photo_levels(task, pose, [None] * len(task.shots), max_size, spp, seed)
        lit = [] if task.colourless else [seen.lit for seen in levels[-1].see(pose, seed)]
        # Of a surface that is too small for a light to be told, colours are compared where the background is known.
        changes = [one.change() for one in lit if one is not None]
        if (task.clutter and not changes) or max(changes, default=0.0) > AS_THEY_ARE:
            return Photographs(task, pose, levels, seed)
    return Colours(task, pose, max_size, spp, seed)


def noise_of(scores: Tensor) -> Tensor:
    """S (n, n) from the scores (n, h, w) of one picture's pixels."""
    side = round(TOGETHER)
    # The products of sums over all windows have each pair of pixels as often as windows hold both: Bartlett's weights.
    padded = F.pad(scores[None], (side - 1,) * 4)
    sums = side * F.avg_pool2d(padded, side, stride=1)[0].flatten(1)
    return sums @ sums.T


def _padded(tangents: dict[Tensor, Tensor]) -> dict[Tensor, Tensor]:
    """Derivatives of a part of the last axis, with zeros for the rest."""
    return {tensor: F.pad(dot, (0, tensor.shape[-1] - dot.shape[-1])) for tensor, dot in tangents.items()}
