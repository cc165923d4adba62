"""Fits end when nothing more is to be had, and say rightly whether they are right."""

from __future__ import annotations

import math

import pytest
import small_fits
import torch
from small_fits import RIGHT, WRONG

from edgegrad.fit.descent.adam import Adam
from edgegrad.fit.descent.falls import LEAST, PARTS, Falls, _in_parts
from edgegrad.fit.ending import Ending, reason_of
from edgegrad.fit.options import Options

MOST = {"adam": 260, "gauss-newton": 40}  # steps
QUICK = {
    "adam": [small_fits.shift, small_fits.sunlight],
    "gauss-newton": [small_fits.pose_and_light, small_fits.light_and_colours],
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
    fit = given.fit()
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


# -- what tells whether steps lead down -------------------------------------------------------------------------------


def falls_of(gradient, steps, start=3.0, rate=0.1, noise=0.0):
    """Of steps of gradient descent in three numbers; gradients have noise."""
    x = torch.full((3,), start, dtype=torch.float64)
    falls, generator = Falls({"x": x}), torch.Generator().manual_seed(0)
    for _ in range(steps):
        g = gradient(x) + noise * torch.randn(3, generator=generator).double()
        falls.observe(float(0.5 * x.square().sum()), {"x": g})
        falls.note()
        x -= rate * g
    return falls


def test_the_promise_is_what_steps_fall_by():
    """Of a plane, without noise: g·Δx each, in all three numbers."""
    falls = falls_of(lambda x: torch.tensor([1.0, -2.0, 0.5]).double(), 20)
    assert falls.promise(40) == pytest.approx(40 * 0.1 * (1.0 + 4.0 + 0.25))


def test_steps_to_and_fro_promise_nothing():
    """A rate so long that each step lands on the other side, and no farther off."""
    assert falls_of(lambda x: x, 20, rate=2.0).promise(40) == 0.0
    down = falls_of(lambda x: x, 20)
    assert down.promise(40) > down.least(Options())


def test_what_steps_cost_that_shake_does_not_hide_the_way_down():
    """A slope of 1 in one number, beside another that Adam's steps, by the noise of its gradient, shake about a minimum."""
    x = torch.tensor([0.0, 0.0], dtype=torch.float64)
    falls, adam, generator = Falls({"x": x}), Adam({"x": x}, {"x": 0.01}), torch.Generator().manual_seed(0)
    ends = []
    for _ in range(600):
        g = torch.tensor([1.0, 0.0]).double() + torch.tensor([0.0, 1.0]).double() * (
            30_000.0 * x + 30.0 * torch.randn(2, generator=generator).double()
        )
        falls.observe(float(x[0] + 15_000.0 * x[1] ** 2), {"x": g})
        if falls._before is not None:
            ends.append(-float((g * (x - falls._before["x"])).sum()))
        falls.note()
        adam.step({"x": g})
    assert sum(ends[300:]) < 0.0  # what the ends of the steps tell
    assert falls.promise(1) == pytest.approx(0.01, rel=0.15)


def test_large_tensors_count_in_parts():
    numbers = torch.arange(2.0 * PARTS + 3)
    parts = _in_parts(numbers)
    assert len(parts) <= PARTS and torch.equal(parts[:2], torch.tensor([3.0, 12.0]))
    assert float(parts.double().sum()) == float(numbers.double().sum())
    assert torch.equal(_in_parts(numbers[:10]), numbers[:10])


def test_one_number_that_falls_is_not_hidden_by_others_to_and_fro():
    gradient = lambda x: torch.stack([20.0 * x[0], 20.0 * x[1], torch.ones((), dtype=torch.float64)])  # noqa: E731
    assert falls_of(gradient, 20).promise(10) == pytest.approx(10 * 0.1)


def test_noise_alone_promises_less_than_can_be_told():
    """About the minimum; and on a slope that the noise of each step hides, in the mean it does not."""
    still = falls_of(lambda x: torch.zeros_like(x), 40, rate=0.01, noise=1.0)
    assert still.promise(40) < 0.3 * 40 * 0.01 * 3.0
    slope = falls_of(lambda x: torch.ones_like(x), 4000, rate=0.01, noise=3.0)
    assert slope.promise(1) == pytest.approx(0.01 * 3.0, rel=0.4)


def test_too_few_steps_tell_nothing():
    falls = falls_of(lambda x: x, LEAST + 1)
    assert falls.promise(1) == math.inf and not falls.tell
    assert falls_of(lambda x: x, LEAST + 2).tell


def test_the_share_is_of_what_the_loss_has_fallen_by():
    """Where most of it is what no step can mend."""
    falls = Falls({"x": torch.zeros(1)})
    for k in range(40):
        falls.observe(10.0 + 0.5**k, {})
    assert falls.least(Options(tolerance=0.01)) == pytest.approx(0.01 * 1.0, rel=0.05)


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
def test_reasons(ending, explained, reason):
    assert reason_of(ending, explained).startswith(reason)
