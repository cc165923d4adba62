"""Gauss-Newton from coarse to fine by colours or masks, with restarts where the picture does not show the result.

The given start is refined first; if the pictures show the render's edges at its end, that is the answer. Otherwise starts
rotated aside from it are refined on the coarsest level, which is cheap, and then the best of many poses around. Renders are
blurred like the pictures, so blur and compression cause no restart.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..edge_support import MIN_EDGE_SUPPORT, block_error, edge_amount, edge_support
from ..options import Settings
from .blur_estimate import estimate_blur
from .gauss_newton import INITIAL_DAMPING, PROBES_MEMORY, GaussNewton
from .pose import Pose, angle
from .replay_log import DescentState, ReplayLog
from .residuals import PoseResiduals
from .result import Step
from .robust_loss import LOSS_NOISE, MIN_WIDTH, Comparison
from .target_images import blurred
from .task import ROTATION, SCALE, STEP_PARTS, TRANSLATION, PoseTask, PyramidLevel

TILT, TILT_STEPS = 0.2, 20  # radians between the starts on the coarsest level, and steps from each
JUDGE_SPP = 64  # samples a pixel when candidates are compared
RESTART_ROUNDS = 2
# Where the means of blocks differ by more of the pictures' range, the object is occluded or a pose nearby is ambiguous, unless
# the pictures show such a share of the render's edges.
MIN_BLOCK_ERROR, CLEAR_SUPPORT = 0.03, 0.9
EQUAL_SUPPORT = 0.95  # A share of edges this much lower counts as equal, for noise.
MIN_SECOND_LEVEL_SUPPORT = 0.4  # Share of edges on the second level below which a candidate is dropped.
# A restart samples so many poses, takes a few steps from some, and refines the best.
SAMPLED_POSES, KEPT_SAMPLES, REFINED_SAMPLES = 150, 4, 3
COMMON_WIDTH = 0.2  # c of losses that are compared, relative to the pictures' range
SAMPLED_RADIUS, SAMPLED_SHIFT = 0.7, 0.15  # largest distance of sampled poses, radians and object sizes
BLUR_CHANGE = 0.25  # The last level is repeated where the blur was estimated wrong by more pixels.


class Score(NamedTuple):
    """How well a pose matches, by renders with many samples that are blurred like the pictures."""

    loss: float
    edge_support: float  # share of the render's edges that the pictures show
    block_error: float  # difference of the means of blocks, see block_error()
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
        self, task: PoseTask, levels: list[PyramidLevel], start: Pose, settings: Settings, log: ReplayLog | None = None,
        further: bool = True,
    ) -> None:  # fmt: skip
        """`further`: try other starts where the refinement of the given one does not end well."""
        self.task, self.levels, self.start = task, levels, start
        self.settings, self.steps, self.seed, self.further = settings, settings.steps, settings.seed, further
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
        coarse, *finer = self.levels
        near, *_ = self._follow(coarse, self.start, self.steps, math.inf)
        found = self._judge(*self._down(near, finer))
        if not self.history:
            raise ValueError(
                f"{self.task.names.init}: expected a pose at which the picture changes when the object moves, got one at which "
                "it does not; is the object out of view, or of the background's colour?"
            )
        # All candidates have the same samples, so a fit never ends at a worse pose than its start.
        stays = found.short and len(distinct([found.pose, self.start], 2)) == 1  # The start was the answer already.
        start = self._judge(self.start, stays)
        best = found if found.judged.beats(start.judged) else start
        self._take(best)
        if self.further and best.judged.edge_support < MIN_EDGE_SUPPORT:
            best = self._from_afar(best, near)
        deep = self.further and self.steps > TILT_STEPS
        if (
            deep
            and MIN_EDGE_SUPPORT <= best.judged.edge_support < CLEAR_SUPPORT
            and best.judged.block_error > MIN_BLOCK_ERROR
        ):
            begins = len(self.history)
            ends = self._ranked(finer[0], self._tilted(best.pose))
            self._better(best, self._judge(*self._down(ends[0], finer[1:])), begins)
        known = self.log.replay(self._information)
        self.information = torch.tensor(known, dtype=torch.float64).reshape((len(self.task.dofs),) * 2)
        self.history.append(Step(self.levels[-1].size, self.loss, self.best, True, {}))

    def _from_afar(self, best: ColorCandidate, near: Pose) -> ColorCandidate:
        """Refine other starts until the pictures show an end's edges. `near` is where the given start led on the
        coarsest level."""
        coarse, second, *_ = self.levels
        begins = len(self.history)
        ends = self._ranked(coarse, self._tilted(self.start)[1:], near)
        if ends[0] is not near:
            best = self._on(best, self._ranked(second, ends[:1]), begins)
        for _ in range(RESTART_ROUNDS if self.steps > TILT_STEPS else 0):
            if best.judged.edge_support >= MIN_EDGE_SUPPORT:
                break
            begins = len(self.history)
            ends = distinct(self._ranked(coarse, [*self._others(best.pose), *ends[1:]]), REFINED_SAMPLES)
            ends = self._ranked(second, ends)
            best = self._on(best, ends, begins)
        return best

    def _on(self, best: ColorCandidate, ends: list[Pose], begins: int) -> ColorCandidate:
        """Refine the best end of the second level further if it is promising. Finer levels take most time and mend no
        wrong place."""
        _, second, *finest = self.levels
        (share,) = self.log.replay(lambda: [self._judged(ends[0], second).edge_support])
        if share >= MIN_SECOND_LEVEL_SUPPORT:
            return self._better(best, self._judge(*self._down(ends[0], finest)), begins)
        self._forget(slice(begins, None))
        return best

    def first_end(self) -> float:
        """Return the share of the render's edges that the pictures show where the start alone leads."""
        coarse, second, *finest = self.levels
        pose = self.start
        for level in (coarse, second):
            pose, *_ = self._follow(level, pose, self.steps, math.inf)
        share = self._judged(pose, second).edge_support
        return share if share < MIN_SECOND_LEVEL_SUPPORT else self._judge(*self._down(pose, finest)).judged.edge_support

    def _tilted(self, pose: Pose) -> list[Pose]:
        """Return the pose, and others rotated aside from it."""
        tilts = TILT * torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], dtype=torch.float64)
        return [pose, *(self.task.moved(pose, [ROTATION, ROTATION + 1], tilt) for tilt in tilts)]

    def _better(self, best: ColorCandidate, found: ColorCandidate, begins: int) -> ColorCandidate:
        """Return the better one. The history marks the steps to it as best; those to `found` begin at `begins`."""
        won = found.judged.beats(best.judged)
        self._forget(slice(0, begins) if won else slice(begins, None))
        if won:
            self._take(found)
        return found if won else best

    def _forget(self, lost: slice) -> None:
        self.history[lost] = [step._replace(best=False) for step in self.history[lost]]

    def _take(self, end: ColorCandidate) -> None:
        self.loss, self.edge_support = end.judged.loss, end.judged.edge_support
        self.best, self._answered = end.pose, True
        self.converged = end.short and end.judged.edge_support >= MIN_EDGE_SUPPORT

    def _ranked(self, level: PyramidLevel, starts: list[Pose], *ends: Pose) -> list[Pose]:
        """Return where a few steps lead from each start, together with earlier `ends`, the best first."""
        found, lowest = list(ends), math.inf
        for origin in starts:
            end, loss, _ = self._follow(level, origin, min(self.steps, TILT_STEPS), lowest)
            found.append(end)
            lowest = min(lowest, loss)
        # Each minimised a loss of its own width; here all have the same.
        return self._sorted(level, found, level.spp)

    def _down(self, pose: Pose, levels: list[PyramidLevel]) -> tuple[Pose, bool]:
        """Refine through the levels; return the pose, and whether the last step was short."""
        *coarser, last = levels
        for level in coarser:
            pose, *_ = self._follow(level, pose, self.steps, math.inf)
        (soft,) = self.log.replay(lambda: [self._softness(pose)])
        pose, _, short = self._follow(last._replace(image_blur=soft), pose, self.steps, math.inf)
        (softer,) = self.log.replay(lambda: [self._softness(pose)])
        if abs(softer - soft) > BLUR_CHANGE:  # It was estimated at another place.
            pose, _, short = self._follow(last._replace(image_blur=softer), pose, self.steps, math.inf)
        return pose, short

    def _follow(self, level: PyramidLevel, origin: Pose, most: int, lowest: float) -> tuple[Pose, float, bool]:
        """Take steps on one level; return the pose, its loss, and whether the last step was short."""
        task = self.task
        search = GaussNewton(PROBES_MEMORY if task.reverse_alone else 0.0)
        last = level.shots is self.levels[-1].shots
        if (state := self.log.next_descent()) is None:
            state = DescentState(origin, origin, lowest)
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
                done=short or settled or search.seen >= most, steps=(*state.steps, step),
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
        return Score(loss, edge_support(pairs), block_error(pairs), edge_amount(pairs))

    def _others(self, best: Pose) -> list[Pose]:
        """Return the best few of many poses around the start and the best one, by their loss on the coarsest level."""
        level, drawn = self.levels[0], []
        entries = [entry for entry in range(ROTATION, SCALE) if entry in self.task.dofs]
        for k in range(SAMPLED_POSES):
            p = torch.zeros(SCALE, dtype=torch.float64)
            p[ROTATION:TRANSLATION] = SAMPLED_RADIUS * self._ball()
            p[TRANSLATION:SCALE] = SAMPLED_SHIFT * self._ball()
            drawn.append(self.task.moved(self.start if k % 2 else best, entries, p[entries]))
        return distinct(self._sorted(level, drawn, max(4, level.spp // 16)), KEPT_SAMPLES)

    def _sorted(self, level: PyramidLevel, poses: list[Pose], spp: int) -> list[Pose]:
        """Return the poses in the order of their loss, the least first."""
        c = COMMON_WIDTH * self.task.extent
        losses = self.log.replay(
            lambda: [PoseResiduals(self.task, level, pose, spp, self.seed).compared.loss(c)[0] for pose in poses]
        )
        return [poses[k] for k in sorted(range(len(poses)), key=losses.__getitem__)]

    def _ball(self) -> Tensor:
        """Draw (3,) evenly from a ball of radius 1."""
        direction = torch.randn(3, generator=self.generator, dtype=torch.float64)
        radius = torch.rand((), generator=self.generator, dtype=torch.float64) ** (1 / 3)
        return radius * direction / direction.norm()


def norms_of(dofs: list[int], gradient: Tensor) -> dict[str, float]:
    """Return the norm of the gradient by each part of a step whose entries are `dofs`."""
    squares = dict(zip(dofs, gradient.square().tolist(), strict=True))
    sums = {name: [squares[entry] for entry in entries if entry in squares] for name, entries in STEP_PARTS.items()}
    return {name: math.sqrt(sum(part)) for name, part in sums.items() if part}


def distinct(poses: list[Pose], most: int, apart: float = 0.5 * TILT) -> list[Pose]:
    """Return the first poses whose rotations are more than `apart` radians from one another."""
    kept: list[Pose] = []
    for pose in poses:
        if len(kept) < most and all(angle(pose.R, other.R) > apart for other in kept):
            kept.append(pose)
    return kept
