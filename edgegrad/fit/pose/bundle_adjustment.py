"""Joint refinement of poses and of the lens that all pictures share.

Each place has the objective of pose fits by its pose and the lens. The sum of these is one objective of all poses and the lens,
whose damped Gauss-Newton steps lead to the most likely ones (Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000). Fits
of single pictures have lenses of their own; a step of all their models finds the lens on which they agree best.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean
from typing import NamedTuple

import torch
from torch import Tensor

from ...optim.levenberg_marquardt import LevenbergMarquardtSettings, Model, Problem
from ..placement import Pose
from .likelihood.objective import PoseLevel
from .settings import CAMERA
from .task import FOCAL_LENGTH

Poses = tuple[Pose, ...]


class Adjustment(NamedTuple):
    """Poses at one lens, and the objective there."""

    poses: Poses
    costs: list[float]  # of each place
    gradients: list[Tensor]  # (m,) of each place by its pose and the lens, the entries that its task seeks
    covariances: list[Tensor]  # (m, m)

    @property
    def loss(self) -> float:
        """The mean cost of the places."""
        return sum(self.costs) / len(self.costs)

    def gradient(self, dofs: Sequence[int]) -> Tensor:
        """Return the gradient (m,) of the mean cost by the entries of a step, of the poses' entries the norm over all places."""
        each = torch.stack(self.gradients) / len(self.gradients)
        return torch.where(torch.tensor(dofs) < FOCAL_LENGTH, each.norm(dim=0), each.sum(0))


class Bundle(Problem[Poses]):
    """Poses of all places and the lens as one descent.

    Its cost is in units of the noise of the pictures, so that a standard deviation costs ½: errors of neighbouring pixels have
    common causes, and count as one. A prior of the settings' prior_deviation holds moves of poses, and the lens at the given
    one. The numbers (n,) of a step are those of all poses, place by place, and then those of the lens in their own unit.
    """

    def __init__(self, levels: Sequence[PoseLevel]) -> None:
        self.levels = levels
        places, m = len(levels), len(levels[0].dofs)
        lens = sum(entry >= FOCAL_LENGTH for entry in levels[0].dofs)
        self.n = places * (m - lens) + lens
        # The curvature of the prior: one more pixel of the same noise shows each number to within `prior_deviation`.
        units = torch.ones(self.n, dtype=torch.float64)
        units[self.n - lens :] = CAMERA.lens_unit
        self.prior = (units / CAMERA.prior_deviation).square().diag()
        *own, shared = units.diag().split([m - lens] * places + [lens])
        self.entries = [torch.cat([rows, shared]) for rows in own]  # (m, n), the entries of each place's step
        self.last: Adjustment | None = None  # what was evaluated last
        self.noise = fmean(level.temperature for level in self.levels)  # pixels that count as one

    def settings(self, most: int) -> LevenbergMarquardtSettings:
        """Return how a descent goes on, by at most so many steps."""
        # Poses move by at most 0.1 radians or object sizes in one step. The damping is that of steps that are taken back. The
        # expected decrease of the cost by a step is half its square in standard deviations.
        return LevenbergMarquardtSettings(
            steps=most + 1, start_damping=1e-3, least_damping=1e-6, unseen_damping=0.0, trust_radius=0.1,
            least_gain=0.5 * CAMERA.short_step**2 * self.n,
        )  # fmt: skip

    def model(self, points: Sequence[Poses]) -> Model:
        (poses,) = points
        costs, gradients, curvatures = self._models(poses)
        lens, known = self._lens(0, poses[0]), CAMERA.prior_deviation**-2
        noise = self.noise
        cost = sum(costs) / noise + 0.5 * known * float(lens.square().sum())
        gradient = self._sum(gradients) / noise + known * self.entries[0].T @ lens
        curvature = self._sum(curvatures) / noise + self.prior
        covariance = torch.linalg.inv(curvature)
        self.last = Adjustment(poses, costs, gradients, [E @ covariance @ E.T for E in self.entries])
        # Renders of other samples would differ by more than a step does at the end.
        slack = torch.tensor([sum(map(abs, costs)) / noise], dtype=torch.float64)
        return Model(torch.tensor([[cost]], dtype=torch.float64), gradient[None], curvature[None], slack)

    def moved(self, points: Sequence[Poses], steps: Tensor) -> list[Poses]:
        moves = [[own @ step for own in self.entries] for step in steps]
        return [self._moved(poses, parts) for poses, parts in zip(points, moves, strict=True)]

    def agreed(self, poses: Sequence[Pose]) -> Poses:
        """Return the most likely poses at a common lens, by the models at poses with lenses of their own. Each picture alone may
        have a lower cost with its own."""
        here = [self._lens(k, pose) for k, pose in enumerate(poses)]  # Poses count from where they are.
        if all(float((x - here[0]).abs().max()) < 1e-9 for x in here):
            return tuple(poses)
        _, gradients, curvatures = self._models(poses)
        slopes = [g - H @ x for g, H, x in zip(gradients, curvatures, here, strict=True)]
        H = self._sum(curvatures) + self.noise * self.prior
        end = -torch.linalg.solve(H, self._sum(slopes))
        return self._moved(poses, [own @ end - x for own, x in zip(self.entries, here, strict=True)])

    def _models(self, poses: Sequence[Pose]) -> tuple[list[float], list[Tensor], list[Tensor]]:
        """Return cost, gradient (m,) and curvature (m, m) of each place at its pose."""
        models = [level.model([pose]) for level, pose in zip(self.levels, poses, strict=True)]
        gradients = [model.gradient for model in models if isinstance(model.gradient, Tensor)]
        curvatures = [model.curvature for model in models if isinstance(model.curvature, Tensor)]
        return [float(model.cost) for model in models], [g[0] for g in gradients], [H[0] for H in curvatures]

    def _moved(self, poses: Sequence[Pose], moves: Sequence[Tensor]) -> Poses:
        places = zip(self.levels, poses, moves, strict=True)
        first, *others = (level.moved([pose], move[None])[0] for level, pose, move in places)
        lens = {"focal": first.focal, "principal": first.principal, "distortion": first.distortion}
        return first, *(one._replace(**lens) for one in others)  # one lens, bit for bit

    def _lens(self, k: int, pose: Pose) -> Tensor:
        """Return the step (m,) from the given lens to that of a pose, with zeros for the entries of the pose."""
        found = torch.cat([pose.R.new_zeros(FOCAL_LENGTH), pose.focal.log()[None], pose.principal, pose.distortion])
        return found[list(self.levels[k].dofs)]

    def _sum(self, parts: Sequence[Tensor]) -> Tensor:
        """Return the sum, by all numbers, of gradients (m,) or curvatures (m, m) by the entries of each place."""
        pairs = zip(self.entries, parts, strict=True)
        return torch.stack([E.T @ part if part.dim() == 1 else E.T @ part @ E for E, part in pairs]).sum(0)
