"""Gauss-Newton from coarse to fine by colours as they are, or by masks, from one start.

Renders are blurred like the pictures, so blur and compression cost no exactness.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..edge_support import MIN_EDGE_SUPPORT, edge_amount, edge_support
from ..options import Settings
from .blur_estimate import estimate_blur
from .gauss_newton import INITIAL_DAMPING, PROBES_MEMORY, GaussNewton
from .pose import Pose, angle
from .replay_log import DescentState, ReplayLog
from .residuals import PoseResiduals
from .result import Step
from .robust_loss import LOSS_NOISE, MIN_WIDTH, Comparison
from .settings import POSE
from .target_images import blurred
from .task import STEP_PARTS, PoseTask, PyramidLevel

JUDGE_SPP = 64  # samples a pixel when candidates are compared
EQUAL_SUPPORT = 0.95  # A share of edges this much lower counts as equal, for noise.
BLUR_CHANGE = 0.25  # The last level is repeated where the blur was estimated wrong by more pixels.


class Score(NamedTuple):
    """How well a pose matches, by renders with many samples that are blurred like the pictures."""

    loss: float
    edge_support: float  # share of the render's edges that the pictures show
    edges: float  # total edge strength of the render

    def beats(self, best: Score) -> bool:
        """Return whether this is the better answer: its loss is lower, and it shows as much of the pictures' edges. Occluders
        and light contribute to the loss. Another place may lower that part, most of all a place out of view."""
        return self.loss < best.loss and self.edge_support * self.edges > EQUAL_SUPPORT * best.edge_support * best.edges


class ColorCandidate(NamedTuple):
    """A refined pose."""

    judged: Score  # on the finest level
    pose: Pose
    short: bool  # The last step was short.


class ColorSearch:
    """The state of a search. `best`, `loss` and `history` are valid after each step, and `log` at any time: a search
    given it resumes."""

    enough = MIN_EDGE_SUPPORT
    ambiguous = ()  # Ambiguous poses are not known.

    def __init__(
        self, task: PoseTask, levels: list[PyramidLevel], start: Pose, settings: Settings, log: ReplayLog | None = None
    ) -> None:  # fmt: skip
        self.task, self.levels, self.start = task, levels, start
        self.settings, self.steps, self.seed = settings, settings.steps, settings.seed
        self.generator = torch.Generator().manual_seed(self.seed)
        self.best, self.loss, self.converged, self.edge_support = start, math.nan, False, math.nan
        self.information: Tensor | None = None  # inverse covariance of the answer
        self.history: list[Step] = []
        self.log = log or ReplayLog()
        self.after_step: Callable[[], Any] = lambda: None
        self._answered = False  # Later candidates do not show until they win.

    @property
    def planned(self) -> int:
        """The largest number of steps of the first refinement."""
        return self.steps * len(self.levels)

    def run(self) -> None:
        """Search; raise ValueError when nothing in the pictures depends on the pose."""
        found = self._judge(*self._down(self.start, self.levels))
        if not self.history:
            raise ValueError(
                f"{self.task.names.init}: expected a pose at which the picture changes when the object moves, got one at which "
                "it does not; is the object out of view, or of the background's colour?"
            )
        # All candidates have the same samples, so a fit never ends at a worse pose than its start.
        stays = found.short and angle(found.pose.R, self.start.R) < POSE.same_mode  # The start was the answer already.
        start = self._judge(self.start, stays)
        best = found if found.judged.beats(start.judged) else start
        self._take(best)
        known = self.log.replay(self._information)
        self.information = torch.tensor(known, dtype=torch.float64).reshape((len(self.task.dofs),) * 2)
        self.history.append(Step(self.levels[-1].size, self.loss, self.best, True, {}))

    def _take(self, end: ColorCandidate) -> None:
        self.loss, self.edge_support = end.judged.loss, end.judged.edge_support
        self.best, self._answered = end.pose, True
        self.converged = end.short and end.judged.edge_support >= MIN_EDGE_SUPPORT

    def _down(self, pose: Pose, levels: list[PyramidLevel]) -> tuple[Pose, bool]:
        """Refine through the levels; return the pose, and whether the last step was short."""
        *coarser, last = levels
        for level in coarser:
            pose, *_ = self._follow(level, pose)
        (soft,) = self.log.replay(lambda: [self._softness(pose)])
        pose, _, short = self._follow(last._replace(image_blur=soft), pose)
        (softer,) = self.log.replay(lambda: [self._softness(pose)])
        if abs(softer - soft) > BLUR_CHANGE:  # It was estimated at another place.
            pose, _, short = self._follow(last._replace(image_blur=softer), pose)
        return pose, short

    def _follow(self, level: PyramidLevel, origin: Pose) -> tuple[Pose, float, bool]:
        """Take steps on one level; return the pose, its loss, and whether the last step was short."""
        task = self.task
        search = GaussNewton(PROBES_MEMORY if task.reverse_alone else 0.0)
        last = level.shots is self.levels[-1].shots
        if (state := self.log.next_descent()) is None:
            state = DescentState(origin, origin, math.inf)
        else:
            search.load(state.search)
            self.generator.set_state(state.random)
            for step in state.steps:
                self._note(step)
        while not state.done:
            seed = (self.seed + len(self.history)) % 2**32
            seen = PoseResiduals(task, level, state.pose, level.spp, seed, self.generator)
            c = seen.compared.scale() if state.c == math.inf else state.c
            loss, slack = seen.compared.loss(c)
            if state.still:  # A rise at the same place is noise.
                slack = math.inf
            norms = {}
            if taken := search.observe(loss, partial(seen.equations, c, first=not search.accepted), slack):
                state = state._replace(here=state.pose)
                norms = norms_of(level.dofs, 2.0 / seen.compared.count * search.gradient)
                c = min(c, seen.compared.scale())
                search.loss = loss = seen.compared.loss(c)[0]
            state = state._replace(c=c, search=search.state(), random=self.generator.get_state())
            if search.flat:
                self.log.record(state := state._replace(done=True))
                break
            move = search.step()
            still = float(move.abs().max()) < self.settings.step_tolerance * level.coarseness
            short = still and search.damping <= INITIAL_DAMPING  # Rejected points alone do not count.
            settled = search.settled and not last
            good = taken and loss <= state.lowest + LOSS_NOISE * abs(state.lowest)
            step = Step(level.size, loss, state.pose, good, norms)
            state = state._replace(
                pose=task.moved(state.here, level.dofs, move), lowest=loss if good else state.lowest, short=short, still=still,
                done=short or settled or search.seen >= self.steps, steps=(*state.steps, step),
            )  # fmt: skip
            self.log.record(state)
            self._note(step)
            self.after_step()
        return state.here, search.loss, state.short

    def _note(self, step: Step) -> None:
        if step.best and not self._answered:
            self.best, self.loss = step.pose, step.loss
        self.history.append(step)

    def _sharp(self, pose: Pose, level: PyramidLevel) -> list[list[Tensor]]:
        """Return the layers of renders of two seeds with many samples."""
        seeds = self.seed, (self.seed + 1) % 2**32
        return [PoseResiduals(self.task, level, pose, JUDGE_SPP, seed).compared.layers for seed in seeds]

    def _softness(self, pose: Pose) -> float:
        return estimate_blur(self.task, self.levels[-1], *self._sharp(pose, self.levels[-1]))

    def _information(self) -> list[float]:
        """Return the inverse covariance of the best pose, by rows: JᵀJ over the variance of the residuals. The search ends
        within its tolerance of the least loss, and knows the pose no better than that."""
        level = self.levels[-1]._replace(image_blur=self._softness(self.best))
        seen = PoseResiduals(self.task, level, self.best, level.spp, self.seed, self.generator)
        c = seen.compared.scale()
        curvature = seen.equations(c, first=True).curvature / max(seen.compared.variance(c), 1e-30)
        values, vectors = torch.linalg.eigh(0.5 * (curvature + curvature.T))
        known = (values.clamp(min=1e-30).reciprocal() + self.settings.step_tolerance**2).reciprocal()
        return ((vectors * known) @ vectors.T).flatten().tolist()

    def first_end(self) -> float:
        """Return the share of the render's edges that the pictures show where the start leads."""
        return self._judge(*self._down(self.start, self.levels)).judged.edge_support

    def _judge(self, pose: Pose, short: bool) -> ColorCandidate:
        """Score a pose on the finest level."""
        numbers = self.log.replay(lambda: list(self._judged(pose, self.levels[-1])))
        return ColorCandidate(Score(*numbers), pose, short)

    def _judged(self, pose: Pose, level: PyramidLevel) -> Score:
        task, sharp = self.task, self._sharp(pose, level)
        soft = estimate_blur(task, level, *sharp)
        first, second = (Comparison(task, level, [blurred(layer, soft) for layer in layers]) for layers in sharp)
        pairs = []
        for shot, a, b in zip(level.shots, first.renders, second.renders, strict=True):
            weight = shot.weight
            if self.task.clutter:
                # The gradient of pixels outside reaches their neighbours, so these are left out, too.
                outside = (a[..., -1] < 0.999).to(a)
                inside = 1.0 - F.max_pool2d(outside[None, None], 3, stride=1, padding=1)[0, 0][..., None]
                weight = inside if weight is None else weight * inside
                a, b = a[..., :-1], b[..., :-1]
            pairs.append((a, b, shot.target, weight))
        loss = first.loss(MIN_WIDTH * task.extent)[0]
        return Score(loss, edge_support(pairs), edge_amount(pairs))


def norms_of(dofs: list[int], gradient: Tensor) -> dict[str, float]:
    """Return the norm of the gradient by each part of a step whose entries are `dofs`."""
    squares = dict(zip(dofs, gradient.square().tolist(), strict=True))
    sums = {name: [squares[entry] for entry in entries if entry in squares] for name, entries in STEP_PARTS.items()}
    return {name: math.sqrt(sum(part)) for name, part in sums.items() if part}
