"""Fits end when steps lead no further, and say rightly whether they are right."""

from __future__ import annotations

import math

import pytest
import small_fits
import torch
from small_fits import RIGHT, WRONG

from edgegrad.fit.descent.adam import Adam
from edgegrad.fit.descent.convergence import MAX_PARTS, MIN_BLOCKS, ConvergenceMonitor, _in_parts
from edgegrad.fit.ending import Ending, reason_of
from edgegrad.fit.options import Settings

MOST = {"adam": 260, "gauss-newton": 40}  # steps
QUICK = {
    "adam": [small_fits.shift, small_fits.sunlight],
    "gauss-newton": [small_fits.pose_and_light, small_fits.light_and_colors],
}
REST = {method: [problem for problem in RIGHT if problem not in quick] for method, quick in QUICK.items()}


def cases(problems):
    return [
        pytest.param(method, problem, id=f"{method} {problem.__name__}")
        for method in problems
        for problem in problems[method]
    ]


def check_right(problem, method, seed):
    given = problem()
    fit = given.fit(method=method, seed=seed)
    said = f"{fit.reason}, {given.error(fit):.2f} times as far off as allowed, after {fit.steps} steps"
    assert fit.converged and fit.reason == "converged" and given.error(fit) < 1.0, said
    assert fit.steps <= MOST[method], said


@pytest.mark.slow
@pytest.mark.parametrize(("method", "problem"), cases(QUICK))
def test_a_right_answer_is_converged_and_ends_early(method, problem):
    check_right(problem, method, 0)


@pytest.mark.slow
@pytest.mark.parametrize(("method", "problem"), cases(REST))
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_right_answers_are_converged(method, problem, seed):
    check_right(problem, method, seed)


@pytest.mark.parametrize("problem", [p for p in WRONG if p not in (small_fits.another_object, small_fits.turned_over)])
def test_a_wrong_answer_says_why(problem):
    given = problem()
    fit = given.fit(steps=min(100, given.options.get("steps", 400)))
    assert not fit.converged and fit.reason.startswith(WRONG[problem] + ": "), fit.reason
    assert given.error(fit) > 2.0  # as it is meant to be


@pytest.mark.slow
@pytest.mark.parametrize("problem", WRONG)
@pytest.mark.parametrize("method", MOST)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_no_wrong_answer_is_converged(problem, method, seed):
    fit = problem().fit(method=method, seed=seed)
    said = ("edges not explained", "loss still falling", "steps ran out")
    assert not fit.converged and fit.reason.split(":")[0] in said, fit.reason


# -- the convergence monitor ------------------------------------------------------------------------------------------


def monitored(gradient, steps, start=3.0, rate=0.1, noise=0.0):
    """Return a monitor after steps of gradient descent in three numbers, whose gradients have noise."""
    x = torch.full((3,), start, dtype=torch.float64)
    monitor, generator = ConvergenceMonitor({"x": x}), torch.Generator().manual_seed(0)
    for _ in range(steps):
        g = gradient(x) + noise * torch.randn(3, generator=generator).double()
        monitor.end_step(float(0.5 * x.square().sum()), {"x": g})
        monitor.begin_step()
        x -= rate * g
    return monitor


def test_predicted_decrease_equals_that_of_steps_on_a_plane():
    """Without noise each step lowers the loss by g·Δx, over all three numbers."""
    monitor = monitored(lambda x: torch.tensor([1.0, -2.0, 0.5]).double(), 20)
    assert monitor.predicted_decrease(40) == pytest.approx(40 * 0.1 * (1.0 + 4.0 + 0.25))


def test_oscillating_steps_predict_no_decrease():
    """With so long a rate each step lands on the other side of the minimum, as far off."""
    assert monitored(lambda x: x, 20, rate=2.0).predicted_decrease(40) == 0.0
    down = monitored(lambda x: x, 20)
    assert down.predicted_decrease(40) > down.least_decrease(Settings())


def test_shaking_steps_do_not_hide_a_slope():
    """One number has a slope of 1. Adam shakes the other about its minimum, by the noise of its gradient."""
    x = torch.tensor([0.0, 0.0], dtype=torch.float64)
    monitor, adam, generator = (
        ConvergenceMonitor({"x": x}),
        Adam({"x": x}, {"x": 0.01}),
        torch.Generator().manual_seed(0),
    )
    ends = []
    for _ in range(600):
        g = torch.tensor([1.0, 0.0]).double() + torch.tensor([0.0, 1.0]).double() * (
            30_000.0 * x + 30.0 * torch.randn(2, generator=generator).double()
        )
        monitor.end_step(float(x[0] + 15_000.0 * x[1] ** 2), {"x": g})
        if monitor._before is not None:
            ends.append(-float((g * (x - monitor._before["x"])).sum()))
        monitor.begin_step()
        adam.step({"x": g})
    assert sum(ends[300:]) < 0.0  # what the ends of the steps show
    assert monitor.predicted_decrease(1) == pytest.approx(0.01, rel=0.15)


def test_large_tensors_are_summed_in_parts():
    numbers = torch.arange(2.0 * MAX_PARTS + 3)
    parts = _in_parts(numbers)
    assert len(parts) <= MAX_PARTS and torch.equal(parts[:2], torch.tensor([3.0, 12.0]))
    assert float(parts.double().sum()) == float(numbers.double().sum())
    assert torch.equal(_in_parts(numbers[:10]), numbers[:10])


def test_one_falling_number_is_not_hidden_by_oscillating_ones():
    gradient = lambda x: torch.stack([20.0 * x[0], 20.0 * x[1], torch.ones((), dtype=torch.float64)])  # noqa: E731
    assert monitored(gradient, 20).predicted_decrease(10) == pytest.approx(10 * 0.1)


def test_noise_alone_predicts_less_than_its_own_size():
    """This holds about the minimum. A slope hidden in each step's noise shows in the mean."""
    still = monitored(lambda x: torch.zeros_like(x), 40, rate=0.01, noise=1.0)
    assert still.predicted_decrease(40) < 0.3 * 40 * 0.01 * 3.0
    slope = monitored(lambda x: torch.ones_like(x), 4000, rate=0.01, noise=3.0)
    assert slope.predicted_decrease(1) == pytest.approx(0.01 * 3.0, rel=0.4)


def test_too_few_steps_predict_nothing():
    monitor = monitored(lambda x: x, MIN_BLOCKS + 1)
    assert monitor.predicted_decrease(1) == math.inf and not monitor.is_ready
    assert monitored(lambda x: x, MIN_BLOCKS + 2).is_ready


def test_tolerance_is_relative_to_the_decrease_so_far():
    """Most of this loss is a part that no step can lower."""
    monitor = ConvergenceMonitor({"x": torch.zeros(1)})
    for k in range(40):
        monitor.end_step(10.0 + 0.5**k, {})
    assert monitor.least_decrease(Settings(loss_tolerance=0.01)) == pytest.approx(0.01 * 1.0, rel=0.05)


@pytest.mark.parametrize(
    ("ending", "explained", "reason"),
    [
        (Ending.FLAT, 0.9, "converged"),
        (Ending.FLAT, 0.3, "edges not explained: the pictures show 30%"),
        (Ending.STEPS, 0.3, "edges not explained"),
        (Ending.STEPS, 0.9, "steps ran out: "),
        (Ending.FALLING, 0.9, "loss still falling: "),
        (Ending.INTERRUPTED, 0.9, "interrupted"),
    ],
)
def test_reason_names_the_cause_and_the_remedy(ending, explained, reason):
    assert reason_of(ending, explained).startswith(reason)
