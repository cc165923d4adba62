"""Levenberg-Marquardt descents in named tensors, from losses of samples."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from edgegrad.fit import Parameter, losses
from edgegrad.optim.gauss_newton import GaussNewtonDescent
from edgegrad.optim.levenberg_marquardt import LevenbergMarquardtSettings
from edgegrad.optim.tensors import Ending, Objective, descend

F64 = torch.float64
SETTINGS = LevenbergMarquardtSettings(trust_radius=10.0, settled_steps=5, tolerance=0.01, steps=1000)


class Valley(Objective):
    """A loss of two numbers without a picture. It falls to 0 at (1, −2) and is no parabola far from there."""

    def __init__(self) -> None:
        self.bottom = torch.tensor([1.0, -2.0], dtype=F64)

    def __call__(self, tensors: Any, step: int) -> Tensor:
        noise = 1e-4 * float(torch.randn((), generator=torch.Generator().manual_seed(step)))
        return losses.robust(tensors["x"][None, None], self.bottom[None, None], None, 1.0, 0.0) + noise


def valley(
    curvature: float, start: tuple[float, float] = (5.0, 5.0), lr: float = 1.0, objective: Valley | None = None, **bounds: Any
) -> GaussNewtonDescent:  # fmt: skip
    x = Parameter(lr, torch.tensor(start, dtype=F64), **bounds)
    return GaussNewtonDescent(
        objective or Valley(), lambda values, step: curvature * torch.eye(2, dtype=F64), {"x": x}, SETTINGS
    )


def off(descent: GaussNewtonDescent) -> float:
    return float((descent.best["x"] - torch.tensor([1.0, -2.0], dtype=F64)).norm())


def test_a_step_that_raises_the_loss_is_taken_back() -> None:
    """The curvature is far too small, so each step would land far beyond the minimum."""
    descent = valley(0.003, start=(3.0, 0.0))
    start = math.log1p(2.0)
    while not descent.resting:
        descent.advance()
        assert descent.settling.mean_cost < start + 0.01  # of each accepted point
    assert max(record.loss for record in descent.history) > start + 0.1  # of some that were not
    assert descent.descents.descents[0].accepted < descent.steps - 3
    assert off(descent) < 0.3


def test_a_right_curvature_needs_few_steps_and_then_ends() -> None:
    descent = valley(0.5, start=(1.6, -2.5))
    found = descend(descent, 60)
    assert found.ending is Ending.FLAT and descent.steps < 30 and off(descent) < 0.05
    assert len(found.history) == descent.steps and found.history[0].gradient["x"] > 0.0


def test_no_number_moves_by_more_than_ten_rates() -> None:
    descent = valley(1e-6, lr=0.01)
    descent.advance()
    descent.advance()
    assert float((descent.values["x"].detach() - 5.0).abs().max()) == pytest.approx(0.1)


def test_a_rate_of_zero_holds_a_tensor_fixed() -> None:
    one, two = (torch.tensor([x], dtype=F64) for x in (1.6, -2.5))

    class Apart(Valley):
        def __call__(self, tensors: Any, step: int) -> Tensor:
            return super().__call__({"x": torch.cat([tensors["one"], tensors["two"]])}, step)

    parameters = {"one": Parameter(0.0, one), "two": Parameter(1.0, two)}
    descent = GaussNewtonDescent(Apart(), lambda values, step: 0.5 * torch.eye(2, dtype=F64), parameters, SETTINGS)
    found = descend(descent, 60)
    assert torch.equal(found.values["one"], one)
    assert float(found.values["two"]) == pytest.approx(-2.0, abs=0.05)


def test_bounds_hold_and_the_others_go_on() -> None:
    descent = valley(0.5, start=(1.6, -1.0), low=torch.tensor([1.3, -9.0], dtype=F64))
    found = descend(descent, 60)
    assert all(float(record.values["x"][0]) >= 1.3 for record in found.history)
    assert float(found.values["x"][0]) == pytest.approx(1.3)
    assert float(found.values["x"][1]) == pytest.approx(-2.0, abs=0.05)


class Renewed(Valley):
    """A valley whose bottom is known from step 3 on."""

    renewal_steps = 3

    def __init__(self) -> None:
        super().__init__()
        self.bottom = self.bottom + 1.0
        self.renewals: list[int] = []
        self.provisional = True

    def renew(self, tensors: Any, step: int) -> None:
        self.renewals.append(step)
        self.provisional = step < 3
        if not self.provisional:
            self.bottom = torch.tensor([1.0, -2.0], dtype=F64)


def test_what_the_loss_holds_fixed_is_renewed_every_few_steps() -> None:
    objective = Renewed()
    descent = valley(0.5, start=(1.6, -2.5), objective=objective)
    found = descend(descent, 80)
    assert objective.renewals[:2] == [0, 3] and found.ending is Ending.FLAT and off(descent) < 0.05


@pytest.mark.parametrize("stop", [1, 5, 12])
def test_a_resumed_descent_equals_an_uninterrupted_one(stop: int, tmp_path) -> None:
    make = lambda: valley(0.5, start=(1.6, -2.5), objective=Renewed())  # noqa: E731
    whole = descend(make(), 80)
    descend(make(), stop, save=lambda state: torch.save(state, tmp_path / "state.pt"))
    rest = descend(make(), 80, saved=torch.load(tmp_path / "state.pt", weights_only=True))
    assert torch.equal(rest.values["x"], whole.values["x"]) and rest.ending is whole.ending
    assert [record.loss for record in rest.history] == [record.loss for record in whole.history]
