"""The search of fit_pose: which hypotheses it begins with, and what its answer stands on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor

from ...scene.symmetries import Symmetries
from ..options import Settings
from ..placement import Pose
from .hypotheses import HypothesisSearch, Mode, turned
from .likelihood.support import Evidence, enough_support, evidence_of
from .photo.match import matches
from .photo.template_views import ball, spread
from .replay_log import ReplayLog
from .result import Step
from .settings import POSE
from .task import PoseTask

Report = Callable[[str], Any]
Groups = Sequence[tuple[Pose, Sequence[Pose]]]
MATCHES = 12  # views of a global search that are refined


class PoseSearch:
    """The state of a search. `best`, `loss` and `history` are valid after each step."""

    def __init__(
        self, task: PoseTask, start: Pose, depths: Sequence[Tensor | None], settings: Settings, log: ReplayLog | None = None,
        further: bool = True, *, proposals: Callable[[Report], Groups] | None = None, symmetries: Symmetries | None = None,
    ) -> None:  # fmt: skip
        """`further`: compare other hypotheses than the start. `proposals` make them; by default poses turned from the start."""
        self.task, self.start, self.depths, self.settings = task, start, depths, settings
        self.further, self.proposals, self.symmetries = further, proposals, symmetries
        self.log = log or ReplayLog()
        self.enough = enough_support(task)
        self.best, self.loss, self.edge_support = start, math.nan, math.nan
        self.evidence: Evidence | None = None  # for the answer
        self.modes: list[Mode] = []
        self.history: list[Step] = []
        self.after_step: Callable[[], Any] = lambda: None
        self.report: Report = lambda _: None

    @property
    def planned(self) -> int:
        """About the largest number of steps on three levels."""
        rounds = (*POSE.first_rounds, *POSE.later_rounds, *POSE.last_rounds)
        most = [steps for steps, _ in rounds] + [POSE.last_steps] * POSE.noise_rounds
        return sum(min(steps, self.settings.steps) for steps in most)

    @property
    def rests(self) -> bool:
        """Whether the first mode is at rest."""
        return bool(self.modes) and self.modes[0].rests

    @property
    def ambiguous(self) -> list[Pose]:
        """Poses that may be the answer, too."""
        return ambiguous(self.modes) if self.edge_support >= self.enough else []

    @property
    def information(self) -> Tensor | None:
        """The inverse covariance (n, n) of the answer; None before it."""
        return None if self.evidence is None else self.modes[0].information

    def run(self) -> None:
        """Search; raise ValueError when nothing in the pictures depends on the pose."""
        groups: Groups = [(self.start, turned(self.task, self.start) if self.further else [self.start])]
        if self.proposals is not None:
            groups = self._proposed(self.proposals)
        search = HypothesisSearch(
            self.task, groups, self.depths, self.settings, self.symmetries, self.further, log=self.log
        )
        search.report = self.report

        def after_step() -> None:
            self.history, self.best, self.loss = list(search.history), search.likeliest, search.cost
            if not self.log.replaying:
                self.after_step()

        search.after_step = after_step
        modes = search.run()
        if not modes:
            raise ValueError(
                f"{self.task.names.init}: expected a pose at which the picture changes when the object moves, got one at which "
                "it does not; is the object out of view?"
            )
        evidence = evidence_of(modes[0].level, modes[0].pose)
        self.modes, self.best, self.loss = modes, modes[0].pose, modes[0].cost
        self.evidence, self.edge_support = evidence, evidence.edges
        self.history.append(Step(self.history[-1].size, self.loss, self.best, True, {}))

    def _proposed(self, proposals: Callable[[Report], Groups]) -> Groups:
        """Return the groups that proposals make, as logged."""
        found = self.log.replay(lambda: [
            (tuple(about), [tuple(pose) for pose in poses]) for about, poses in proposals(self.report)
        ])  # fmt: skip
        return [(Pose(*about), [Pose(*pose) for pose in poses]) for about, poses in found]


def ambiguous(modes: Sequence[Mode]) -> list[Pose]:
    """Return the poses of modes with hardly less mass than the first."""
    return [mode.pose for mode in modes[1:] if modes[0].log_mass - mode.log_mass < POSE.ambiguous_nats]


def around(task: PoseTask, pose: Pose, count: int) -> list[Pose]:
    """Return the pose, and others rotated from it about the object's centre."""
    return [_turned(task, pose, R @ pose.R) for R in ball(count, POSE.start_radius)]


def everywhere(task: PoseTask, pose: Pose, count: int) -> list[Pose]:
    """Return poses at the same place with rotations all over SO(3)."""
    return [_turned(task, pose, R) for R in spread(count)]


def anywhere(task: PoseTask, seed: int, report: Report) -> Groups:
    """Return the best matches of views with the whole first picture, each in the part of the picture around it."""
    return [(pose, [pose]) for pose in matches(task, seed, report)[:MATCHES]]


def _turned(task: PoseTask, pose: Pose, R: Tensor) -> Pose:
    return pose._replace(R=R, t=task.center_at(pose) - pose.scale * (R @ task.center))
