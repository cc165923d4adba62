"""Quadratic models of a fit's loss at one pose and lens: slope, curvature and noise.

The loss L = Σ ρ(r_p) over pixels p has the curvature H = Σ w_p J_p J_pᵀ and the gradient g = Σ s_p with scores s_p = w_p r_p
J_p. Noise of the pictures gives g the covariance S = Σ E[s_p s_qᵀ] over pairs of pixels, and the numbers that minimise L the
covariance H⁻¹ S H⁻¹ (Huber, The Behavior of Maximum Likelihood Estimates under Nonstandard Conditions, 1967). Errors of
edges, blur and shadows correlate in pixels nearby. So pairs less than POSE.correlation_length pixels apart count, with Bartlett's
weights, which keep S positive (Newey and West, A Simple, Positive Semi-Definite, Heteroskedasticity and Autocorrelation
Consistent Covariance Matrix, 1987).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ...render import jvp
from ..options import Settings
from .blur_estimate import estimate_blur
from .color_search import JUDGE_SPP, ColorSearch
from .gauss_newton import NormalEquations
from .jacobian import Rendered
from .likelihood.objective import PoseLevel, pose_levels
from .likelihood.support import evidence_of
from .pose import Pose
from .robust_loss import MIN_WIDTH, Comparison
from .settings import POSE
from .task import PoseTask


class LossModel(NamedTuple):
    """The quadratic model of a loss at one pose, by the entries of a step that the task seeks."""

    curvature: Tensor  # H (n, n)
    gradient: Tensor  # g (n,)
    scores: Tensor  # S (n, n), covariance of g
    loss: float  # comparable between poses
    slack: float  # rise of the loss that noise alone may explain
    per_loss: float  # gradient of `loss` relative to g


class ColorLoss:
    """The loss that ColorSearch minimises, for masks and for pictures that show the mesh's colours unlit."""

    def __init__(self, task: PoseTask, pose: Pose, settings: Settings) -> None:
        self.task, self.seed = task, settings.seed
        finest = min(1.0, settings.max_size / max(task.shots[0].camera.size))
        sharp = task.level(finest, 0.0, 1.0, max(settings.spp, JUDGE_SPP), task.dofs)
        with torch.no_grad():
            both = [task.images(sharp, pose, sharp.spp, (self.seed + k) % 2**32) for k in (0, 1)]
        self.level = sharp._replace(image_blur=estimate_blur(task, sharp, *both))
        self.c = MIN_WIDTH * task.extent

    def at(self, pose: Pose) -> LossModel:
        """Return the model at a pose, from the same samples at each."""
        task, level = self.task, self.level
        images, tangents = [], []
        for shot, (scene, camera, seed) in zip(level.shots, task.views(level, pose, self.seed), strict=True):
            moves = task.motion(level, shot, pose)
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
        normal = NormalEquations.from_tangents(residuals, tangents)
        scores = torch.zeros_like(normal.curvature)
        for r, J in zip(residuals, tangents, strict=True):
            scores += score_covariance((J * r).sum(-1).double())
        return LossModel(*normal, scores, *compared.loss(self.c), 2.0 / compared.count)

    def judged(self, pose: Pose) -> tuple[float, float]:
        """Return the loss, and the share of the render's edges that the pictures show."""
        found = ColorSearch(self.task, [self.level], pose, Settings(seed=self.seed))._judged(pose, self.level)
        return found.loss, found.edge_support


class PhotoLoss:
    """The objective of PoseSearch, for pictures in unknown light or before unknown things."""

    def __init__(self, task: PoseTask, pose: Pose, objective: PoseLevel) -> None:
        self.task, self.objective = task, objective.informed([pose]).focused(pose)
        self.level = task.level(1.0, 0.0, 1.0, objective.spp, task.dofs)

    def at(self, pose: Pose) -> LossModel:
        """Return the model at a pose, from the same samples at each."""
        model = self.objective.model([pose])
        assert isinstance(model.gradient, Tensor) and isinstance(model.curvature, Tensor)
        cost, curvature = float(model.cost), model.curvature[0]
        return LossModel(curvature, model.gradient[0], POSE.correlation_length**2 * curvature, cost, abs(cost), 1.0)

    def judged(self, pose: Pose) -> tuple[float, float]:
        """Return the loss, and the share of the render's edges that the pictures show."""
        return float(self.objective.costs([pose])[0]), evidence_of(self.objective, pose).edges


LossSource = ColorLoss | PhotoLoss


def loss_source(task: PoseTask, pose: Pose, settings: Settings) -> LossSource:
    """Return the loss that suits the pictures best, by what light does to the mesh's colours at a pose."""
    if task.aovs != ("alpha",):
        objective = pose_levels(task, pose, [None] * len(task.shots), settings)[-1]
        lights = [one.light for one in objective.comparisons([pose])]
        # A surface too small to show its light is compared by colours where the background is known.
        changes = [float(light.change()[0]) for light in lights if light is not None]
        if (task.clutter and not changes) or max(changes, default=0.0) > POSE.unchanged_colors:
            return PhotoLoss(task, pose, objective)
    return ColorLoss(task, pose, settings)


def score_covariance(scores: Tensor) -> Tensor:
    """Return S (n, n) from the scores (n, h, w) of one picture's pixels."""
    side = round(POSE.correlation_length)
    # Products of sums over windows count a pair of pixels once for each window that holds both: Bartlett's weights.
    padded = F.pad(scores[None], (side - 1,) * 4)
    sums = side * F.avg_pool2d(padded, side, stride=1)[0].flatten(1)
    return sums @ sums.T


def _padded(tangents: dict[Tensor, Tensor]) -> dict[Tensor, Tensor]:
    """Return derivatives of a part of the last axis, padded with zeros for the rest."""
    return {tensor: F.pad(dot, (0, tensor.shape[-1] - dot.shape[-1])) for tensor, dot in tangents.items()}
