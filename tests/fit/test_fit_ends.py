"""Fits end when steps lead no further, and say rightly whether they are right."""

from __future__ import annotations

import pytest
import small_fits
from small_fits import RIGHT, WRONG

from edgegrad.fit.result import reason_of
from edgegrad.optim.tensors import Ending

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
    assert fit.reason == "converged" and given.error(fit) < 1.0, said
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
    assert fit.reason.startswith(WRONG[problem] + ": "), fit.reason
    assert given.error(fit) > 2.0  # as it is meant to be


@pytest.mark.slow
@pytest.mark.parametrize("problem", WRONG)
@pytest.mark.parametrize("method", MOST)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_no_wrong_answer_is_converged(problem, method, seed):
    fit = problem().fit(method=method, seed=seed)
    said = ("edges not explained", "loss still falling", "steps ran out")
    assert fit.reason.split(":")[0] in said, fit.reason


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
