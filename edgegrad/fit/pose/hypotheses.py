"""The search for a pose: hypotheses, of which the likeliest are refined from level to level, and the modes that remain.

Hypotheses are the start, poses turned from it, or matches of views with the whole picture. Damped Gauss-Newton steps lower
the costs of those about one start in lockstep, and after a few steps the unlikely ones go (successive halving, Jamieson and
Talwalkar, Non-stochastic Best Arm Identification, 2016). Low resolution separates some directions badly, such as a turn out of
the image plane from a shift. So on the next level, further hypotheses are drawn along the directions that the likeliest one
leaves open.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...optim.levenberg_marquardt import LevenbergMarquardt, LevenbergMarquardtSettings, Rest
from ...scene.symmetries import Symmetries
from ..options import Settings
from ..placement import Pose, angle
from .camera_motion import moved_poses
from .likelihood.objective import PoseLevel, pose_levels
from .replay_log import Replayed, ReplayLog
from .result import Step
from .settings import POSE
from .task import ROTATION, STEP_PARTS, TRANSLATION, PoseTask

Round = tuple[int, int]


class Mode(NamedTuple):
    """A pose at which the pictures' likelihood has a maximum."""

    pose: Pose
    cost: float  # −log likelihood ratio to pictures without the object, nats of independent pixels
    curvature: Tensor  # (n, n), of the cost
    rests: bool  # The last step was short.
    level: PoseLevel  # with the noise by which this is the cost
    temperature: float = 1.0  # pixels that count as one

    @property
    def information(self) -> Tensor:
        """The inverse covariance (n, n) of the entries of a step."""
        return self.curvature / self.temperature

    @property
    def log_mass(self) -> float:
        """The logarithm of the posterior's mass about the mode (Laplace's approximation), up to a constant. Errors of
        neighbouring pixels have common causes, which a temperature accounts for."""
        known = self.information + torch.eye(len(self.curvature), dtype=torch.float64)
        return -self.cost / self.temperature - 0.5 * float(torch.logdet(known))


class Group:
    """Hypotheses that are compared in one part of the pictures, each with the descent that it is on."""

    def __init__(self, levels: list[PoseLevel], poses: Sequence[Pose], log: ReplayLog) -> None:
        self.levels, self.poses, self.log = levels, list(poses), log
        self.descents: LevenbergMarquardt[Pose] | None = None
        self.level = levels[0]

    def enter(self, k: int, settings: Settings) -> None:
        """Begin descents on level k; of fewer levels the last serves."""
        self.level = self.levels[min(k, len(self.levels) - 1)].informed(self.poses)
        self.begin(settings)

    def begin(self, settings: Settings) -> None:
        last = self.level.last
        self.descents = LevenbergMarquardt(Replayed(self.level, self.log), self.poses, LevenbergMarquardtSettings(
            steps=settings.steps + 1, start_damping=POSE.fine_damping if last else POSE.coarse_damping,
            least_damping=0.1 * POSE.fine_damping, most_damping=POSE.most_damping, unseen_damping=1e-5,
            trust_radius=POSE.longest_step, least_gain=POSE.least_gain * self.level.temperature,
            shortest_step=settings.step_tolerance * self.level.coarseness,
        ))  # fmt: skip

    @property
    def costs(self) -> list[float]:
        assert self.descents is not None
        return [descent.mean_cost for descent in self.descents.descents]

    def keep(self, rows: Sequence[int]) -> None:
        """Keep these hypotheses alone."""
        assert self.descents is not None
        self.descents.descents = [self.descents.descents[row] for row in rows]
        self.poses = [descent.point for descent in self.descents.descents]

    def open_ends(self, row: int) -> list[Pose]:
        """Return poses about a hypothesis along the directions in which its cost rises least."""
        assert self.descents is not None
        descent = self.descents.descents[row]
        values, vectors = torch.linalg.eigh(descent.curvature)
        steps = []
        for value, vector in zip(values[: POSE.weak_directions].tolist(), vectors.T, strict=False):
            size = POSE.weak_deviations * POSE.open_length / math.sqrt(max(value, 1e-9))
            size = min(size, POSE.turns[-1] / float(vector.abs().max()))
            steps += [size * vector, -size * vector]
        return moved_poses(self.level.task, [descent.point] * len(steps), self.level.dofs, torch.stack(steps))


class HypothesisSearch:
    """Refinement of hypotheses. `likeliest` and `history` are valid after each step."""

    def __init__(
        self, task: PoseTask, groups: Sequence[tuple[Pose, Sequence[Pose]]], depths: Sequence[Tensor | None],
        settings: Settings, symmetries: Symmetries | None = None, further: bool = True, coarse: bool = True,
        log: ReplayLog | None = None,
    ) -> None:  # fmt: skip
        """`groups` have a pose, about which pictures are compared, and hypotheses. `further`: draw more of them. `coarse`: begin
        on the coarsest level, and not on the last one."""
        self.task, self.depths, self.settings, self.symmetries = task, depths, settings, symmetries
        self.further, self.coarse, self.log = further, coarse, log or ReplayLog()
        self.groups: list[Group] = []
        self.given = groups
        self.likeliest = groups[0][1][0]
        self.cost = math.inf
        self.history: list[Step] = []
        self.after_step: Callable[[], Any] = lambda: None
        self.report: Callable[[str], Any] = lambda _: None

    def run(self) -> list[Mode]:
        """Return the modes, the one with the largest mass first; none where nothing in the pictures depends on the poses."""
        for about, poses in self.given:
            self.groups.append(Group(pose_levels(self.task, about, self.depths, self.settings), poses, self.log))
        deepest = max(len(group.levels) for group in self.groups)
        for k in range(deepest - 1 if self.coarse else 0):
            self.report(f"{sum(len(group.poses) for group in self.groups)} hypotheses on level {k + 1} of {deepest}")
            for group in self.groups:
                group.enter(k, self.settings)
            self._halve(POSE.first_rounds if k == 0 else POSE.later_rounds)
            if self.further:
                best = min(self.groups, key=lambda group: min(group.costs))
                order = sorted(range(len(best.poses)), key=best.costs.__getitem__)
                drawn = 2 if k == 0 else 1  # The coarsest level tells hypotheses apart least.
                best.poses += [pose for row in order[:drawn] for pose in best.open_ends(row)]
        for group in self.groups:
            group.enter(deepest - 1, self.settings)
        self._halve(POSE.last_rounds)
        for _ in range(POSE.noise_rounds):
            noises = [group.level.contour_noises for group in self.groups]
            for group in self.groups:
                group.level = group.level.informed(group.poses[:1]).focused(group.poses[0])
            if noises == [group.level.contour_noises for group in self.groups] and self._rests():
                break
            for group in self.groups:
                group.begin(self.settings)
            self._halve(((POSE.last_steps, POSE.modes),))
        return self._modes()

    def _rests(self) -> bool:
        """Whether the likeliest hypothesis has a short next step by as many pixels as count as one now."""
        group = min(self.groups, key=lambda group: min(group.costs))
        assert group.descents is not None
        return group.descents.descents[0].predicted < POSE.least_gain * group.level.temperature

    def _halve(self, rounds: Sequence[Round]) -> None:
        """Take steps, and keep the likeliest hypotheses after each round."""
        for steps, kept in rounds:
            for group in self.groups:
                assert group.descents is not None
                for _ in range(min(steps + (group.descents.steps == 0), self.settings.steps + 1)):
                    if group.descents.resting:
                        break
                    group.descents.advance()
                    self._note(group)
            self._keep(kept)

    def _keep(self, most: int) -> None:
        """Keep the likeliest hypotheses that differ."""
        ranked = sorted(
            ((cost, g, row) for g, group in enumerate(self.groups) for row, cost in enumerate(group.costs)),
            key=lambda one: one[0],
        )
        kept: list[tuple[int, int]] = []
        for cost, g, row in ranked:
            pose = self._descent(g, row).point
            alone = all(self.apart(pose, self._descent(*other).point) > POSE.distinct for other in kept)
            level = self.groups[g].level
            unlikely = bool(level.contour_noises) and cost - ranked[0][0] > POSE.unlikely_nats * level.temperature
            if math.isfinite(cost) and alone and not unlikely and len(kept) < most:
                kept.append((g, row))
        kept = kept or [(ranked[0][1], ranked[0][2])]
        for g, group in enumerate(self.groups):
            group.keep([row for at, row in kept if at == g])
        self.groups = [group for group in self.groups if group.poses]

    def _descent(self, g: int, row: int) -> Any:
        descents = self.groups[g].descents
        assert descents is not None
        return descents.descents[row]

    def _note(self, group: Group) -> None:
        """Add the likeliest hypothesis of a group to the history, and make it the answer so far."""
        assert group.descents is not None
        first, descents = not self.history, group.descents.descents  # The history begins with the start.
        best = descents[0] if first else min(descents, key=lambda descent: descent.mean_cost)
        if not best.accepted:
            return
        norms = norms_of(group.level.dofs, best.gradient)
        better = first or best.mean_cost <= min(min(other.costs) for other in self.groups)
        if better:
            self.likeliest, self.cost = best.point, best.mean_cost
        self.history.append(Step(group.level.size, best.mean_cost, best.point, better, norms))
        self.after_step()

    def _modes(self) -> list[Mode]:
        """Return the ends of all descents that differ, the one with the largest mass first. Steps that gain less than errors of
        the pictures do are short, too: where nothing shows a direction, descents wander along it."""
        short = Rest.SHORT, Rest.DAMPED
        found = [
            (Mode(one.point, one.mean_cost, one.curvature, one.rest in short, group.level), one.predicted)
            for group in self.groups if group.descents is not None
            for one in group.descents.descents if one.accepted and one.rest is not Rest.FLAT
        ]  # fmt: skip
        kept: list[tuple[Mode, float]] = []
        for mode, gain in sorted(found, key=lambda pair: pair[0].cost):
            if all(self.apart(mode.pose, other.pose) > POSE.same_mode for other, _ in kept):
                kept.append((mode, gain))
        T = kept[0][0].level.temperature if kept else 1.0
        modes = [mode._replace(temperature=T, rests=mode.rests or gain < POSE.least_gain * T) for mode, gain in kept]
        return sorted(modes, key=lambda mode: -mode.log_mass)

    def apart(self, one: Pose, other: Pose) -> float:
        """Return how far apart two poses are, in radians or object sizes, whichever is more, up to symmetries."""
        if self.symmetries is not None:
            other = other.closest(self.symmetries, one)
        return max(angle(one.R, other.R), self.task.between(one, other))


def norms_of(dofs: Sequence[int], gradient: Tensor) -> dict[str, float]:
    """Return the norm of the gradient by each part of a step whose entries are `dofs`."""
    squares = dict(zip(dofs, gradient.square().tolist(), strict=True))
    sums = {name: [squares[entry] for entry in entries if entry in squares] for name, entries in STEP_PARTS.items()}
    return {name: math.sqrt(sum(part)) for name, part in sums.items() if part}


def probabilities(modes: Sequence[Mode]) -> list[float]:
    """Return how the posterior's mass divides among modes."""
    return torch.tensor([mode.log_mass for mode in modes], dtype=torch.float64).softmax(0).tolist() if modes else []


def turned(task: PoseTask, pose: Pose) -> list[Pose]:
    """Return the pose, and poses turned from it about each axis of the camera to both sides."""
    steps = [torch.zeros(3, dtype=torch.float64)]
    for size in POSE.turns:
        for axis in range(3):
            for sign in (1.0, -1.0):
                steps.append(torch.zeros(3, dtype=torch.float64).index_fill(0, torch.tensor([axis]), sign * size))
    return moved_poses(task, [pose] * len(steps), range(ROTATION, TRANSLATION), torch.stack(steps))
