"""The search of fit_pose in photographs: hypotheses, and colours as they are where the light leaves them unchanged."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ...scene.symmetries import Symmetries
from ..options import Settings
from .color_search import ColorSearch
from .hypotheses import HypothesisSearch, Mode, turned
from .likelihood.objective import PoseLevel, pose_levels
from .likelihood.support import Evidence, enough_support, evidence_of
from .photo.match import matches
from .photo.template_views import ball, spread
from .pose import Pose, angle
from .replay_log import ReplayLog
from .result import Step
from .settings import POSE
from .task import PoseTask, PyramidLevel
from .uncertainty import information_of

Report = Callable[[str], Any]
Groups = Sequence[tuple[Pose, Sequence[Pose]]]
MATCHES = 12  # views of a global search that are refined


class PoseSearch:
    """The state of a search, with the attributes of ColorSearch."""

    def __init__(
        self, task: PoseTask, start: Pose, depths: Sequence[Tensor | None], settings: Settings, log: ReplayLog | None = None,
        further: bool = True, *, proposals: Callable[[Report], Groups] | None = None, symmetries: Symmetries | None = None,
    ) -> None:  # fmt: skip
        """`further`: compare other hypotheses than the start. `proposals` make them; by default poses turned from the start."""
        self.task, self.start, self.depths, self.settings = task, start, depths, settings
        self.further, self.proposals, self.symmetries = further, proposals, symmetries
        self.enough = enough_support(task)
        self.best, self.loss, self.converged, self.edge_support = start, math.nan, False, math.nan
        self.information: Tensor | None = None  # inverse covariance of the answer
        self.evidence: Evidence | None = None  # for the answer
        self.ambiguous: list[Pose] = []  # poses that may be the answer, too
        self.modes: list[Mode] = []
        self.history: list[Step] = []
        self.log = log or ReplayLog()
        self.after_step: Callable[[], Any] = lambda: None
        self.report: Report = lambda _: None
        # Before a uniform background, unlit colours are compared first, and so are masks of plain meshes.
        bare = task.aovs == ("alpha",) or (not task.clutter and "alpha" not in task.aovs)
        self.colors_first = bare and proposals is None and all(depth is None for depth in depths)
        self.seed = settings.seed
        self._levels: dict[tuple[float, ...], PoseLevel] = {}  # by the numbers of the pose that they are about

    @property
    def planned(self) -> int:
        """About the number of steps."""
        rounds = (*POSE.first_rounds, *POSE.later_rounds)
        return sum(min(steps, self.settings.steps) for steps, _ in rounds) + min(POSE.last_steps, self.settings.steps)

    def run(self) -> None:
        """Search; raise ValueError when nothing in the pictures depends on the pose."""
        if not (self.colors_first and self._colors_suffice()):
            self._photograph()
        self.evidence = self._evidence(self.best)
        size = self.history[-1].size if self.history else self.task.shots[0].camera.size
        self.history.append(Step(size, self.loss, self.best, True, {}))

    def _colors_suffice(self) -> bool:
        """Compare colours as they are; return whether the pictures show the render's edges at the end."""
        self._adopt(self._by_colors(self.start, self.task.pyramid(self.start, self.settings)))
        return self.edge_support >= self.enough or not self.further

    def _photograph(self) -> None:
        """Search by the terms of photographs; colours refine an unlit result, or that of a mask, which is more precise."""
        task, begins, modes = self.task, len(self.history), self._refined()
        share = self._evidence(modes[0].pose).edges if modes else 0.0
        if self.colors_first and share < enough_support(task):
            self._forget(slice(begins, None))
            return
        if not modes:
            raise ValueError(
                f"{task.names.init}: expected a pose at which the picture changes when the object moves, got one at which "
                "it does not; is the object out of view?"
            )
        self._forget(slice(0, begins))
        # Where colours did not fit, convergence needs more, since the terms of photographs match much that is no photograph.
        self.enough = POSE.sure_support if self.colors_first else enough_support(task)
        self._take(modes, share)
        if all(depth is None for depth in self.depths) and not task.colorless and self._is_unlit(modes[0].pose):
            before = len(self.history)
            colors = self._by_colors(self.best, task.pyramid(self.best, self.settings)[-2:])
            if colors.converged and self._as_likely(colors.best, self.best):
                self._adopt(colors)
            else:
                self._forget(slice(before, None))

    def _refined(self) -> list[Mode]:
        """Return the modes, the likeliest first, as logged."""
        before = len(self.history)
        found = self.log.replay(self._search)
        del self.history[before:]
        self.history += [Step(size, loss, Pose.from_numbers(pose), *rest) for size, loss, pose, *rest in found["steps"]]
        self.modes = [
            Mode(Pose.from_numbers(pose), cost, torch.tensor(rows, dtype=torch.float64), rests)
            for pose, cost, rows, rests in found["modes"]
        ]
        return self.modes

    def _search(self) -> dict[str, Any]:
        groups: Groups
        if self.proposals is not None:
            groups = self.proposals(self.report)
        else:
            groups = [(self.start, turned(self.task, self.start) if self.further else [self.start])]
        search = HypothesisSearch(self.task, groups, self.depths, self.settings, self.symmetries, self.further)
        search.report, before, answered = self.report, list(self.history), bool(self.history)

        def after_step() -> None:
            self.history = [*before, *search.history]
            if not answered:
                self.best, self.loss = search.likeliest, search.cost
            self.after_step()

        search.after_step = after_step
        modes = search.run()
        steps = [(one.size, one.loss, one.pose.numbers, one.best, dict(one.gradient)) for one in search.history]
        return {
            "steps": steps,
            "modes": [(mode.pose.numbers, mode.cost, mode.curvature.tolist(), mode.rests) for mode in modes],
        }

    def _take(self, modes: Sequence[Mode], share: float) -> None:
        """Make the likeliest mode the answer, which the pictures show a share of the edges of."""
        best = modes[0]
        self.best, self.loss, self.edge_support = best.pose, best.cost, share
        self.information = information_of(best.curvature)
        self.converged = best.rests and share >= self.enough
        self.ambiguous = ambiguous(modes) if share >= self.enough else []

    def _evidence(self, pose: Pose) -> Evidence:
        return Evidence(*self.log.replay(lambda: list(evidence_of(self._last_level(pose), pose))))

    def _as_likely(self, pose: Pose, other: Pose) -> bool:
        """Return whether the terms of photographs do not clearly prefer another pose, up to where it comes to rest."""
        if angle(pose.R, other.R) > POSE.same_mode:
            return False

        def costs() -> list[float]:
            return self._last_level(other).costs([pose, other]).tolist()

        here, there = self.log.replay(costs)
        return here - there < POSE.correlation_length**2

    def _is_unlit(self, pose: Pose) -> bool:
        """Return whether the light leaves the mesh's colours as they are. This holds for pictures, not for a pose. At a wrong
        pose the fitted light makes up for a part of the error, so the least change counts: at this pose, and at the start."""
        if self.task.aovs == ("alpha",):
            return True

        def change() -> list[float]:
            level, found = self._last_level(pose), []
            for one in level.comparisons([pose, self.start]):
                found.append(
                    torch.full((2,), math.inf, dtype=torch.float32) if one.light is None else one.light.change()
                )
            return [float(torch.stack(found).amax(0).min())]

        return float(self.log.replay(change)[0]) < POSE.unchanged_colors

    def _last_level(self, pose: Pose) -> PoseLevel:
        """Return the finest level of what surrounds a pose, with the noise and the blur that it leaves."""
        key = tuple(pose.numbers)
        if key not in self._levels:
            level = pose_levels(self.task, pose, self.depths, self.settings)[-1].informed([pose])
            self._levels[key] = level.focused(pose)
        return self._levels[key]

    def _by_colors(self, start: Pose, levels: list[PyramidLevel]) -> ColorSearch:
        """Search by unlit colours from a start, with its steps added to the history."""
        search = ColorSearch(self.task, levels, start, self.settings, self.log)
        before = list(self.history)

        def after_step() -> None:
            self.history = [*before, *search.history]
            if not before:
                self.best, self.loss, self.edge_support = search.best, search.loss, search.edge_support
            self.after_step()

        search.after_step = after_step
        search.run()
        self.history = [*before, *search.history[:-1]]  # The last entry is the final comparison.
        return search

    def _adopt(self, search: ColorSearch) -> None:
        self.best, self.loss, self.edge_support = search.best, search.loss, search.edge_support
        self.converged, self.information, self.enough = search.converged, search.information, search.enough

    def _forget(self, lost: slice) -> None:
        self.history[lost] = [step._replace(best=False) for step in self.history[lost]]

    def first_end(self) -> float:
        """Return the share of the render's edges that the pictures show where the start alone leads."""
        if not self.task.clutter:
            levels = self.task.pyramid(self.start, self.settings)
            return ColorSearch(self.task, levels, self.start, self.settings).first_end()
        search = HypothesisSearch(self.task, [(self.start, [self.start])], self.depths, self.settings, further=False)
        self.modes = search.run()
        return self._evidence(self.modes[0].pose).edges if self.modes else 0.0


def ambiguous(modes: Sequence[Mode]) -> list[Pose]:
    """Return the poses of modes that are hardly less likely than the first."""
    doubt = POSE.ambiguous_nats * POSE.correlation_length**2
    return [mode.pose for mode in modes[1:] if mode.cost - modes[0].cost < doubt]


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
