"""Damped Gauss-Newton descents, as Levenberg (1944) and Marquardt (1963) damped them, several in lockstep.

Each step δ of a descent solves (H + λ diag H) δ = −g, with gradient g and curvature H of its cost. It is taken where the cost
falls, and taken back otherwise. The damping λ follows the gain ratio, which is the decrease of the cost over the predicted one
−g·δ − ½ δ·H δ (Nielsen, Damping Parameter in Marquardt's Method, 1999). The descents do not depend on one another; their
candidates are evaluated together, because problems are often cheaper in batches.

Costs may be noisy. A problem then gives each cost by S sets of samples, which are the same at all points. How far the S
differences of two costs are apart says by how much a cost may rise by noise. Once the cost falls no longer by more than this,
each further step lands about the minimum, off by the noise of its own gradient. The mean of these points is the result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from torch import Tensor

from .convergence import EMPTY, Settling

Point = TypeVar("Point")
Rows = Sequence[int]

LARGEST_CUT = 1.0 / 3.0  # of λ in one step, and the factor 2 of the first raise: both as Nielsen has them


class Model(NamedTuple):
    """The quadratic models of N costs, each at a point of its own.

    Gradient and curvature are tensors, or functions that compute them for some rows. They are asked for at accepted points
    alone, and a descent that goes to and fro about its minimum keeps its curvature.
    """

    cost: Tensor  # (N, S), by S sets of samples
    gradient: Tensor | Callable[[Rows], Tensor]  # (N, n)
    curvature: Tensor | Callable[[Rows], Tensor]  # (N, n, n), positive semi-definite
    slack: Tensor | None = None  # (N,), by how much noise that all sets of samples share may raise a cost


class Problem(Generic[Point]):
    """Costs of points, and steps from them. Points are of any type."""

    provisional = False  # whether the cost is one that `renew` will replace: no descent rests at it

    def model(self, points: Sequence[Point]) -> Model:
        """Return the models at N points."""
        raise NotImplementedError

    def moved(self, points: Sequence[Point], steps: Tensor) -> list[Point]:
        """Return where steps (N, n) lead: the retraction."""
        raise NotImplementedError

    def allowed(self, point: Point, step: Tensor) -> Tensor:
        """Return the part of a step (n,) that bounds allow. The step is solved for again without the numbers that may not move
        at all."""
        return step

    def renew(self, points: Sequence[Point]) -> bool:
        """Called with points that were just accepted. Renew what costs hold fixed between steps; return whether the costs are
        others by that."""
        return False


@dataclass(frozen=True)
class LevenbergMarquardtSettings:
    """How descents go on and when they rest. Lengths are in the units of the problem's steps, costs in its own.

    Twelve small fits of scenes (tests/fit/small_fits.py) take 15.8 steps in the mean. Half or twice a number changes this, and
    their errors, by less than a tenth, where it does not say otherwise.
    """

    steps: int = 100  # Largest number of evaluations of one descent, the start's included.
    start_damping: float = 0.03  # The first λ, relative to the diagonal of H.
    # λ stays between these. Steps are full ones at the former; a descent that exceeds the latter rests.
    least_damping: float = 1e-4
    most_damping: float = 1e4
    # Added damping, relative to the largest entry of H. It keeps numbers at rest that the cost does not depend on, and must be
    # above 0 where H may be singular.
    unseen_damping: float = 1e-4
    # Largest entry of a step. A smaller radius takes more steps, a larger one leaves the region where the model holds.
    trust_radius: float = math.inf
    # A descent rests where an undamped step is predicted to lower the cost by less than this, or has no entry as large as
    # `shortest_step`. Twice as much saves less than a step, for the decrease falls by a large factor in each.
    least_gain: float = 0.0
    shortest_step: float = 0.0
    noise_deviations: float = 2.0  # Standard deviations of its noise by which a cost may rise.
    # A descent of a noisy cost rests after more steps than these in which it fell no further than by noise and tolerance. None:
    # it goes on. Three in place of six save 4.4 steps, and twelve take 10.8 more; errors change by a fifth, which is noise.
    settled_steps: int | None = None
    tolerance: float = 0.0  # Share of the cost, or of its decrease so far, that does not count as a fall.


class Rest(Enum):
    """Why a descent takes no more steps."""

    SHORT = "the next step is short"
    SETTLED = "the cost falls no longer"
    DAMPED = "no step along the gradient lowers the cost"
    FLAT = "the cost does not depend on the point"
    UNDEFINED = "the cost has no finite value at the start"
    STEPS = "steps ran out"


@dataclass(kw_only=True)
class Descent(Settling, Generic[Point]):
    """One descent: its last accepted point with the model there, and the next step."""

    point: Point
    damping: float
    raised: float = 2.0  # factor of λ where a step is taken back; it doubles with each further one
    steps: int = 0  # evaluations
    accepted: int = 0
    rest: Rest | None = None
    shared_slack: float = 0.0  # of the cost at the point, by the model
    gradient: Tensor = EMPTY  # (n,)
    curvature: Tensor = EMPTY  # (n, n)
    step: Tensor = EMPTY  # (n,), the next one
    predicted: float = 0.0  # decrease of the cost by it; at rest, by an undamped one
    path: tuple[Tensor, ...] = ()  # (n,) each, where steps since the last fall led, from the point of that

    @property
    def mean_cost(self) -> float:
        """The cost of the last accepted point; ∞ before there is one."""
        return float(self.cost.mean()) if self.accepted else math.inf

    @property
    def offset(self) -> Tensor | None:
        """The step (n,) from the last accepted point to the mean of the later half of those since the last fall. None: the
        two are one."""
        if len(self.path) < 2:
            return None
        return torch.stack(self.path[-((len(self.path) + 1) // 2) :]).mean(0) - self.path[-1]


class LevenbergMarquardt(Generic[Point]):
    """The descents of a problem from several starts.

    `advance()` evaluates one candidate of each descent that does not rest, the starts at first. `state()` and `load()` are for
    checkpoints: a descent that goes on from its state takes the same steps.
    """

    def __init__(
        self, problem: Problem[Point], starts: Sequence[Point], settings: LevenbergMarquardtSettings | None = None
    ) -> None:
        self.problem = problem
        self.settings = settings or LevenbergMarquardtSettings()
        self.descents = [Descent(point=start, damping=self.settings.start_damping) for start in starts]
        self.interrupted = False

    @property
    def active(self) -> list[Descent[Point]]:
        """The descents that do not rest."""
        return [descent for descent in self.descents if descent.rest is None]

    @property
    def resting(self) -> bool:
        """Whether all descents rest."""
        return not self.active

    @property
    def steps(self) -> int:
        """The number of calls of advance()."""
        return max((descent.steps for descent in self.descents), default=0)

    @property
    def points(self) -> list[Point]:
        """The results so far, one for each start: the last accepted point, or a mean of several where costs are noisy."""
        return [
            descent.point
            if (offset := descent.offset) is None
            else self.problem.moved([descent.point], offset[None])[0]
            for descent in self.descents
        ]

    def advance(self) -> list[bool]:
        """Evaluate the next candidates. Return for each active descent whether its candidate was accepted."""
        active = self.active
        # Starts are candidates without a step.
        stepping = [k for k, descent in enumerate(active) if descent.accepted]
        candidates = [descent.point for descent in active]
        if stepping:
            steps = torch.stack([active[k].step for k in stepping])
            for k, moved in zip(stepping, self.problem.moved([candidates[k] for k in stepping], steps), strict=True):
                candidates[k] = moved
        model = self.problem.model(candidates)
        cost = model.cost.detach().double()
        falling = [k for k, descent in enumerate(active) if self._falls(descent, cost[k])]
        rows = falling
        if falling and self.problem.renew([candidates[k] for k in falling]):
            model, rows = self.problem.model([candidates[k] for k in falling]), range(len(falling))
        derivatives = self._derivatives([active[k] for k in falling], model, rows)
        taken = []
        for k, row, (gradient, curvature) in zip(falling, rows, derivatives, strict=True):
            here = model.cost[row].detach().double()
            if bool(here.isfinite().all() and gradient.isfinite().all() and curvature.isfinite().all()):
                self._follow(active[k], candidates[k], cost[k], here)
                active[k].gradient, active[k].curvature = gradient, curvature
                active[k].shared_slack = 0.0 if model.slack is None else float(model.slack[row])
                taken.append(k)
        for k, descent in enumerate(active):
            descent.steps += 1
            if k not in taken:
                self._take_back(descent)
            if descent.rest is None and descent.accepted:
                self._propose(descent)
            if descent.rest is None and descent.steps >= self.settings.steps:
                descent.rest = Rest.STEPS
        return [k in taken for k in range(len(active))]

    def state(self) -> dict[str, Any]:
        """Return what further steps depend on. Points are in it as they are."""
        return {"descents": [{**vars(one), "rest": one.rest and one.rest.name} for one in self.descents]}

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from a state."""
        self.descents = [Descent(**{**one, "rest": one["rest"] and Rest[one["rest"]]}) for one in state["descents"]]

    def _falls(self, descent: Descent[Point], cost: Tensor) -> bool:
        """Return whether a candidate's cost (S,) is finite and no higher than noise makes it."""
        if not bool(cost.isfinite().all()):
            return False
        if not descent.accepted:
            return True
        fall = descent.cost - cost
        return float(fall.mean()) >= -self._slack(descent, fall)

    def _slack(self, descent: Descent[Point], fall: Tensor) -> float:
        """Return by how much noise may raise a cost, with the differences (S,) of costs by their sets of samples."""
        return max(descent.slack(fall, self.settings.noise_deviations), descent.shared_slack)

    def _derivatives(
        self, descents: Sequence[Descent[Point]], model: Model, rows: Rows
    ) -> list[tuple[Tensor, Tensor]]:  # fmt: skip
        """Return gradient and curvature at the candidates of some descents, which are these rows of the model. Descents about
        their minimum keep their curvature."""
        gradients = _rows_of(model.gradient, rows)
        curved = [row for descent, row in zip(descents, rows, strict=True) if descent.settled < 2]
        curvatures = dict(zip(curved, _rows_of(model.curvature, curved), strict=True))
        return [
            (gradient, curvatures.get(row, descent.curvature))
            for descent, row, gradient in zip(descents, rows, gradients, strict=True)
        ]

    def _follow(self, descent: Descent[Point], point: Point, cost: Tensor, renewed: Tensor) -> None:
        """Take a step to a point with this cost, and that after the problem's renewal: adapt the damping to the gain, and note
        whether the cost still falls."""
        settings = self.settings
        if descent.accepted:
            fall = descent.cost - cost
            slack, mean = self._slack(descent, fall), float(fall.mean())
            gain = mean / descent.predicted if mean > slack and descent.predicted > 0.0 else 1.0
            factor = max(LARGEST_CUT, 1.0 - (2.0 * gain - 1.0) ** 3)
            descent.damping = max(descent.damping * factor, settings.least_damping)
        descent.add(cost, settings.noise_deviations, settings.tolerance)
        if self.problem.provisional or len(cost) < 2:  # Without noise, the lengths of steps alone say when to rest.
            descent.settled, descent.lowest = 0, cost
        before = descent.path[-1] if descent.path else torch.zeros_like(descent.step)
        descent.path = (*descent.path, before + descent.step) if descent.settled else ()
        if settings.settled_steps is not None and descent.settled > settings.settled_steps:
            descent.rest = Rest.SETTLED
        descent.rebase(cost, renewed)
        descent.point, descent.raised = point, 2.0
        descent.accepted += 1

    def _take_back(self, descent: Descent[Point]) -> None:
        if not descent.accepted:
            descent.rest = Rest.UNDEFINED
            return
        descent.damping, descent.raised = descent.damping * descent.raised, 2.0 * descent.raised
        if descent.damping > self.settings.most_damping:
            descent.rest = Rest.DAMPED

    def _propose(self, descent: Descent[Point]) -> None:
        """Compute the next step, or let the descent rest."""
        if not float(descent.curvature.diagonal().sum()) > 0.0:
            descent.rest = Rest.FLAT
            return
        newton = self._solved(descent, 0.0)
        short, descent.predicted = float(newton.abs().max()) < self.settings.shortest_step, _decrease(descent, newton)
        if (short or descent.predicted < self.settings.least_gain) and not self.problem.provisional:
            descent.rest = Rest.SHORT
            return
        step = self._solved(descent, descent.damping)
        step = step * min(1.0, self.settings.trust_radius / max(float(step.abs().max()), 1e-300))
        descent.step, descent.predicted = step, _decrease(descent, step)

    def _solved(self, descent: Descent[Point], damping: float) -> Tensor:
        """Return the step with this λ (n,), with numbers at rest that stand at bounds."""
        H, diagonal = descent.curvature, descent.curvature.diagonal()
        A = H + torch.diag(damping * diagonal + self.settings.unseen_damping * diagonal.max())
        free = torch.ones_like(descent.gradient, dtype=torch.bool)
        while True:
            step = torch.zeros_like(descent.gradient)
            step[free] = -torch.linalg.solve(A[free][:, free], descent.gradient[free])
            allowed = self.problem.allowed(descent.point, step)
            held = (allowed == 0.0) & (step != 0.0)
            if not bool(held.any()):
                return allowed
            free = free & ~held


def minimise(
    problem: Problem[Point], starts: Sequence[Point], settings: LevenbergMarquardtSettings | None = None,
    after_step: Callable[[LevenbergMarquardt[Point]], Any] = lambda _: None,
) -> LevenbergMarquardt[Point]:  # fmt: skip
    """Run the descents until all rest. `after_step` is called after each step. Ctrl-C ends them with what they have found."""
    descents = LevenbergMarquardt(problem, starts, settings)
    try:
        while not descents.resting:
            descents.advance()
            after_step(descents)
    except KeyboardInterrupt:
        descents.interrupted = True
    return descents


def _rows_of(values: Tensor | Callable[[Rows], Tensor], rows: Rows) -> Tensor:
    if not rows:
        return torch.empty(0, dtype=torch.float64)
    found = values[list(rows)] if isinstance(values, Tensor) else values(rows)
    return found.detach().double()


def _decrease(descent: Descent[Any], step: Tensor) -> float:
    """Return by how much the model says that a step lowers the cost."""
    return -float(descent.gradient @ step + 0.5 * step @ descent.curvature @ step)
