"""Damped Gauss-Newton descents of costs whose minima are known."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from edgegrad.optim.levenberg_marquardt import (
    LevenbergMarquardt,
    LevenbergMarquardtSettings,
    Model,
    Problem,
    Rest,
    minimise,
)

F64 = torch.float64


class LeastSquares(Problem[Tensor]):
    """½ |r(x)|² of vectors x (n,)."""

    def __init__(self, residuals: Callable[[Tensor], Tensor], scale: float = 1.0) -> None:
        """`scale` multiplies the gradient, which makes it wrong."""
        self.residuals, self.scale, self.calls = residuals, scale, 0

    def model(self, points: Sequence[Tensor]) -> Model:
        self.calls += 1
        r = torch.stack([self.residuals(x) for x in points])
        J = torch.stack([torch.autograd.functional.jacobian(self.residuals, x) for x in points])
        cost = torch.stack([0.5 * (one @ one)[None] for one in r])
        gradient = torch.stack([self.scale * (A.T @ b) for A, b in zip(J, r, strict=True)])
        return Model(cost, gradient, torch.stack([A.T @ A for A in J]))

    def moved(self, points: Sequence[Tensor], steps: Tensor) -> list[Tensor]:
        return [x + step for x, step in zip(points, steps, strict=True)]


def rosenbrock(x: Tensor) -> Tensor:
    return torch.stack([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])


def linear(x: Tensor) -> Tensor:
    A = torch.tensor([[3.0, 1.0], [1.0, 2.0], [0.5, -1.0]], dtype=F64)
    return A @ (x - torch.tensor([0.3, -0.7], dtype=F64))


def vector(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=F64)


UNDAMPED = LevenbergMarquardtSettings(start_damping=0.0, least_damping=0.0, unseen_damping=1e-16)


@pytest.mark.quick
@pytest.mark.parametrize(("scale", "exact"), [(1.0, True), (0.95, False), (1.05, False)])
def test_one_undamped_step_solves_linear_least_squares(scale: float, exact: bool) -> None:
    found = LevenbergMarquardt(LeastSquares(linear, scale), [vector(5.0, 4.0)], replace(UNDAMPED, steps=2))
    found.advance()
    assert found.descents[0].point.equal(vector(5.0, 4.0))
    assert found.advance() == [True]
    assert torch.allclose(found.points[0], vector(0.3, -0.7), atol=1e-12) == exact
    assert (abs(found.descents[0].mean_cost) < 1e-20) == exact
    assert found.descents[0].rest is Rest.STEPS


@pytest.mark.parametrize(("scale", "exact"), [(1.0, True), (0.95, False), (1.05, False)])
def test_the_predicted_decrease_of_a_quadratic_cost_is_the_true_one(scale: float, exact: bool) -> None:
    descents = LevenbergMarquardt(LeastSquares(linear, scale), [vector(5.0, 4.0)])
    descents.advance()
    one = descents.descents[0]
    before, predicted = one.mean_cost, one.predicted
    descents.advance()
    assert (abs(before - one.mean_cost - predicted) < 1e-12 * before) == exact


@pytest.mark.quick
def test_rosenbrock_is_solved_through_its_valley() -> None:
    found = minimise(
        LeastSquares(rosenbrock), [vector(-1.2, 1.0)], LevenbergMarquardtSettings(least_gain=1e-12)
    ).descents[0]
    assert found.rest is Rest.SHORT and found.steps < 40
    assert torch.allclose(found.point, vector(1.0, 1.0), atol=1e-5)


@pytest.mark.parametrize("scale", [0.95, 1.05])
def test_a_gradient_that_is_off_converges_slower(scale: float) -> None:
    settings = replace(UNDAMPED, least_gain=1e-20)
    right, wrong = (
        minimise(LeastSquares(rosenbrock, s), [vector(0.9, 0.75)], settings).descents[0].steps for s in (1.0, scale)
    )
    assert right < wrong


def rotation(v: Tensor) -> Tensor:
    return torch.linalg.matrix_exp(
        torch.stack([
            torch.stack([torch.zeros_like(v[0]), -v[2], v[1]]),
            torch.stack([v[2], torch.zeros_like(v[0]), -v[0]]),
            torch.stack([-v[1], v[0], torch.zeros_like(v[0])]),
        ])
    )  # fmt: skip


class Rotations(LeastSquares):
    """Rotations R for which R a is b, by rotations about the present one."""

    def __init__(self, scale: float = 1.0) -> None:
        generator = torch.Generator().manual_seed(0)
        self.a = torch.randn(3, 6, generator=generator, dtype=F64)
        self.b = rotation(vector(1.1, -0.8, 0.6)) @ self.a
        super().__init__(lambda v: v, scale)

    def model(self, points: Sequence[Tensor]) -> Model:
        models = []
        for R in points:
            self.residuals = lambda v, R=R: (rotation(v) @ R @ self.a - self.b).flatten()
            models.append(super().model([torch.zeros(3, dtype=F64)]))
        return Model(*(torch.cat(parts) for parts in zip(*(model[:3] for model in models), strict=True)))

    def moved(self, points: Sequence[Tensor], steps: Tensor) -> list[Tensor]:
        return [rotation(step) @ R for R, step in zip(points, steps, strict=True)]


@pytest.mark.parametrize(("scale", "most"), [(1.0, 8), (0.95, 0)])
def test_rotations_move_by_a_retraction(scale: float, most: int) -> None:
    settings = LevenbergMarquardtSettings(shortest_step=1e-7, trust_radius=1.0, least_damping=0.0)
    found = minimise(Rotations(scale), [torch.eye(3, dtype=F64)], settings).descents[0]
    assert found.rest is Rest.SHORT
    assert (found.point - rotation(vector(1.1, -0.8, 0.6))).abs().max() < 1e-6
    assert (found.point @ found.point.T - torch.eye(3, dtype=F64)).abs().max() < 1e-12
    assert found.steps <= most or scale != 1.0


def test_no_step_is_longer_than_the_trust_radius() -> None:
    descents = LevenbergMarquardt(LeastSquares(linear), [vector(5.0, 4.0)], replace(UNDAMPED, trust_radius=0.25))
    lengths, before = [], vector(5.0, 4.0)
    while descents.active and descents.descents[0].steps < 60:
        descents.advance()
        lengths.append(float((descents.points[0] - before).abs().max()))
        before = descents.points[0]
    assert max(lengths) == pytest.approx(0.25)
    assert torch.allclose(before, vector(0.3, -0.7), atol=1e-9)


class WithoutNegatives(LeastSquares):
    """A cost that is NaN, or whose gradient is, where x is below zero."""

    def __init__(self, of_gradient: bool) -> None:
        super().__init__(lambda x: x.abs().sqrt() - 0.1)
        self.of_gradient = of_gradient

    def model(self, points: Sequence[Tensor]) -> Model:
        found = super().model(points)
        bad = torch.tensor([bool((x < 0.0).any()) for x in points])
        part = found.gradient if self.of_gradient else found.cost
        assert isinstance(part, Tensor)
        part[bad] = math.nan
        return found


@pytest.mark.parametrize("of_gradient", [False, True])
def test_steps_into_a_region_without_a_cost_are_taken_back(of_gradient: bool) -> None:
    taken = []
    # An undamped step from 1 would lead to 1 − 2 (1 − 0.1) = −0.8.
    problem = WithoutNegatives(of_gradient)
    settings = LevenbergMarquardtSettings(least_gain=1e-16)
    found = LevenbergMarquardt(problem, [vector(1.0)], settings)
    while found.active:
        taken += found.advance()
        assert float(found.points[0]) >= 0.0
    assert False in taken
    assert float(found.points[0]) == pytest.approx(0.01, abs=1e-6)


def test_a_start_without_a_cost_rests() -> None:
    found = minimise(WithoutNegatives(False), [vector(-1.0), vector(1.0)])
    assert found.descents[0].rest is Rest.UNDEFINED
    assert float(found.points[0]) == -1.0
    assert found.descents[0].mean_cost == math.inf
    assert float(found.points[1]) == pytest.approx(0.01, abs=1e-4)


def test_numbers_that_the_cost_does_not_depend_on_stay() -> None:
    r = lambda x: torch.stack([x[0] - 2.0, 2.0 * (x[0] - 2.0)])  # noqa: E731
    found = minimise(LeastSquares(r), [vector(0.0, 7.0)], LevenbergMarquardtSettings(shortest_step=1e-9))
    assert found.descents[0].rest is Rest.SHORT
    assert torch.allclose(found.points[0], vector(2.0, 7.0), atol=1e-8)


def test_a_cost_that_depends_on_nothing_rests_at_once() -> None:
    found = minimise(LeastSquares(lambda x: 0.0 * x + 1.0), [vector(3.0)])
    assert found.descents[0].rest is Rest.FLAT and found.descents[0].steps == 1


def test_a_cost_that_rises_along_its_gradient_rests_damped() -> None:
    problem = LeastSquares(linear, scale=-1.0)
    found = minimise(problem, [vector(5.0, 4.0)])
    assert found.descents[0].rest is Rest.DAMPED
    assert found.points[0].equal(vector(5.0, 4.0))


@pytest.mark.parametrize(("slack", "accepted"), [(0.0, False), (1e6, True)])
def test_a_cost_may_rise_by_the_slack_of_its_model(slack: float, accepted: bool) -> None:
    class Slack(LeastSquares):
        def model(self, points: Sequence[Tensor]) -> Model:
            return super().model(points)._replace(slack=torch.full((len(points),), slack, dtype=F64))

    descents = LevenbergMarquardt(Slack(linear, scale=-1.0), [vector(5.0, 4.0)])
    descents.advance()
    assert descents.advance() == [accepted]


class Bounded(LeastSquares):
    """The second number stays above zero."""

    def allowed(self, point: Tensor, step: Tensor) -> Tensor:
        return (point + step).clamp(min=vector(-math.inf, 0.0)) - point


def test_numbers_at_a_bound_stay_and_the_others_are_solved_for_without_them() -> None:
    # The free minimum is at (0.3, −0.7). With x₁ = 0, that of |A₀ x₀ − A (0.3, −0.7)|² is another.
    A = torch.tensor([[3.0, 1.0], [1.0, 2.0], [0.5, -1.0]], dtype=F64)
    best = (A[:, 0] @ A @ vector(0.3, -0.7)) / (A[:, 0] @ A[:, 0])
    found = minimise(Bounded(linear), [vector(5.0, 4.0)], LevenbergMarquardtSettings(shortest_step=1e-9))
    assert found.descents[0].rest is Rest.SHORT
    assert torch.allclose(found.points[0], torch.stack([best, torch.zeros((), dtype=F64)]), atol=1e-8)


class Noisy(LeastSquares):
    """Costs by two sets of samples, with gradients of noise that is drawn anew at each point."""

    def __init__(self, scale: float = 1.0, seed: int = 0) -> None:
        super().__init__(linear, scale)
        self.generator = torch.Generator().manual_seed(seed)

    def model(self, points: Sequence[Tensor]) -> Model:
        cost, gradient, curvature, _ = super().model(points)
        assert isinstance(gradient, Tensor)
        tilt = torch.tensor([[0.05, -0.03], [-0.04, 0.05]], dtype=F64)  # of the samples of each set
        noise = torch.stack([tilt @ torch.sin(40.0 * x) for x in points])
        shake = 0.3 * torch.randn(gradient.shape, generator=self.generator, dtype=F64)
        return Model(cost + noise, gradient + shake, curvature)


def test_noisy_descents_settle_and_their_mean_is_nearer_than_single_steps() -> None:
    settings = LevenbergMarquardtSettings(settled_steps=24, start_damping=1e-3)
    means, lasts = [], []
    for seed in range(8):
        found = minimise(Noisy(seed=seed), [vector(5.0, 4.0)], settings)
        assert found.descents[0].rest is Rest.SETTLED and found.descents[0].steps < 60
        means.append(float((found.points[0] - vector(0.3, -0.7)).square().sum()))
        lasts.append(float((found.descents[0].point - vector(0.3, -0.7)).square().sum()))
    # The mean of the later twelve of the steps has a twelfth of the variance of one.
    assert sum(means) < 0.25 * sum(lasts)


def test_a_slow_descent_within_the_noise_of_each_step_does_not_settle() -> None:
    settings = replace(UNDAMPED, settled_steps=6, trust_radius=0.05, steps=400)
    found = minimise(Noisy(), [vector(5.0, 4.0)], settings)
    assert found.descents[0].rest is Rest.SETTLED
    assert (found.points[0] - vector(0.3, -0.7)).abs().max() < 0.1


class Renewed(LeastSquares):
    """A cost whose minimum is known only after two renewals."""

    def __init__(self) -> None:
        self.targets = [1.0, 3.0, 2.0]
        super().__init__(lambda x: torch.cat([x - self.targets[0], vector(len(self.targets))]))

    @property
    def provisional(self) -> bool:
        return len(self.targets) > 1

    def renew(self, points: Sequence[Tensor]) -> bool:
        if not self.provisional:
            return False
        self.targets.pop(0)
        return True


def test_costs_that_are_renewed_are_compared_with_costs_of_the_same_kind_and_none_rests_before() -> None:
    found = minimise(Renewed(), [vector(1.0)], LevenbergMarquardtSettings(shortest_step=1e-6))
    assert found.descents[0].rest is Rest.SHORT
    assert float(found.points[0]) == pytest.approx(2.0, abs=1e-6)


STARTS = [(-1.2, 1.0), (0.5, 0.5), (3.0, -2.0), (1.0, 1.0), (-0.1, 4.0)]


@pytest.mark.quick
def test_descents_in_lockstep_equal_single_ones() -> None:
    problem, settings = LeastSquares(rosenbrock), LevenbergMarquardtSettings(least_gain=1e-12)
    starts = [vector(*start) for start in STARTS]
    together = minimise(problem, starts, settings)
    assert problem.calls == max(descent.steps for descent in together.descents)
    assert len({descent.steps for descent in together.descents}) > 1
    for start, found, descent in zip(starts, together.points, together.descents, strict=True):
        alone = minimise(LeastSquares(rosenbrock), [start], settings)
        assert alone.points[0].equal(found)
        assert alone.descents[0].steps == descent.steps and alone.descents[0].rest is descent.rest


@pytest.mark.parametrize("stop", [1, 3, 9])
def test_a_resumed_descent_equals_an_uninterrupted_one(stop: int, tmp_path) -> None:
    settings = LevenbergMarquardtSettings(least_gain=1e-12)
    starts = [vector(*start) for start in STARTS]
    whole = minimise(LeastSquares(rosenbrock), starts, settings)
    first = LevenbergMarquardt(LeastSquares(rosenbrock), starts, settings)
    for _ in range(stop):
        first.advance()
    torch.save(first.state(), tmp_path / "state.pt")
    second = LevenbergMarquardt(LeastSquares(rosenbrock), starts, settings)
    second.load(torch.load(tmp_path / "state.pt", weights_only=True))
    while second.active:
        second.advance()
    for a, b in zip(whole.descents, second.descents, strict=True):
        assert a.point.equal(b.point) and (a.steps, a.rest, a.damping) == (b.steps, b.rest, b.damping)


def test_an_interrupted_descent_keeps_its_best_point() -> None:
    def stop(descents: LevenbergMarquardt[Tensor]) -> None:
        if descents.descents[0].steps == 5:
            raise KeyboardInterrupt

    found = minimise(LeastSquares(rosenbrock), [vector(-1.2, 1.0)], after_step=stop)
    assert found.interrupted and found.descents[0].rest is None and found.descents[0].steps == 5
    start = rosenbrock(vector(-1.2, 1.0))
    assert found.descents[0].mean_cost < 0.5 * float(start @ start)
    r = rosenbrock(found.points[0])
    assert 0.5 * float(r @ r) == found.descents[0].mean_cost


def test_derivatives_are_asked_for_at_accepted_points_alone() -> None:
    asked = []

    class Lazy(LeastSquares):
        def model(self, points: Sequence[Tensor]) -> Model:
            found = super().model(points)
            gradient, curvature = found.gradient, found.curvature
            assert isinstance(gradient, Tensor) and isinstance(curvature, Tensor)

            def gradients(rows: Sequence[int]) -> Tensor:
                asked.append(len(rows))
                return gradient[list(rows)]

            return Model(found.cost, gradients, lambda rows: curvature[list(rows)])

    settings = LevenbergMarquardtSettings(least_gain=1e-12)
    starts = [vector(*start) for start in STARTS]
    lazy, eager = minimise(Lazy(rosenbrock), starts, settings), minimise(LeastSquares(rosenbrock), starts, settings)
    assert all(a.equal(b) for a, b in zip(lazy.points, eager.points, strict=True))
    assert sum(asked) == sum(descent.accepted for descent in lazy.descents)
    assert sum(asked) < sum(descent.steps for descent in lazy.descents)
