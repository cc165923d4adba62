"""Steps of Adam, and descents whose learning rates are cut."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from edgegrad.fit import Parameter
from edgegrad.optim.adam import Adam, AdamDescent, AdamSettings
from edgegrad.optim.tensors import DescentResult, Ending, Objective, Tensors, descend


def test_steps_equal_those_of_torch_adam() -> None:
    start = torch.randn(5, 3, generator=torch.Generator().manual_seed(0)).double()
    mine, theirs = (start.clone().requires_grad_() for _ in range(2))
    ours, torchs = Adam({"x": mine}, {"x": 0.1}), torch.optim.Adam([theirs], lr=0.1)
    for _ in range(5):
        ours.step({"x": torch.autograd.grad(mine.pow(4).sum(), mine)[0]})
        torchs.zero_grad()
        theirs.pow(4).sum().backward()
        torchs.step()
    torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)  # ε is relative here


def test_uniform_steps_keep_the_gradients_direction() -> None:
    x = torch.zeros(4, 3, dtype=torch.float64)
    gradient = torch.randn(4, 3, generator=torch.Generator().manual_seed(0)).double()
    Adam({"x": x}, {"x": 0.1}, uniform={"x"}).step({"x": gradient})
    torch.testing.assert_close(x, -0.1 * gradient / gradient.abs().max())


@dataclass
class Bowl(Objective):
    """½ |x − c|² with noise of its gradient, as samples make it."""

    noise: float = 0.3
    broken: int = -1  # the step whose loss is NaN

    def __call__(self, tensors: Tensors, step: int) -> Tensor:
        shake = torch.randn(3, generator=torch.Generator().manual_seed(step), dtype=torch.float64)
        x = tensors["x"] - torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
        found = 0.5 * x.square().sum() + self.noise * (shake @ x)
        return found * math.nan if step == self.broken else found


def bowl(steps: int, objective: Bowl | None = None, tolerance: float = 0.01, **loop: Any) -> DescentResult:
    x = Parameter(0.05, torch.zeros(3, dtype=torch.float64))
    return descend(AdamDescent(objective or Bowl(), {"x": x}, AdamSettings(tolerance)), steps, **loop)


def off(found: DescentResult) -> float:
    return float((found.values["x"] - torch.tensor([1.0, -2.0, 0.5])).norm())


def test_a_noisy_descent_ends_flat_and_its_mean_is_near_the_minimum() -> None:
    found = bowl(2000)
    assert found.ending is Ending.FLAT and len(found.history) < 300 and off(found) < 0.2
    assert min(record.rate for record in found.history) == pytest.approx(0.3**3)


def test_too_few_steps_leave_the_loss_falling() -> None:
    assert bowl(20).ending is Ending.FALLING
    assert bowl(5).ending is Ending.STEPS  # which are too few to say so


def test_a_loss_that_is_nan_cuts_the_rates_and_goes_back() -> None:
    found = bowl(40, Bowl(broken=30), tolerance=0.0)
    assert math.isnan(found.history[30].loss) and found.history[31].rate == 0.3
    assert all(torch.isfinite(record.values["x"]).all() for record in found.history)


def test_a_resumed_descent_equals_an_uninterrupted_one(tmp_path) -> None:
    whole = bowl(60)
    first = bowl(25, save=lambda state: torch.save(state, tmp_path / "state.pt"), every=10)
    assert len(first.history) == 25
    rest = bowl(60, saved=torch.load(tmp_path / "state.pt", weights_only=True))
    assert torch.equal(rest.values["x"], whole.values["x"]) and rest.seconds > first.seconds
    assert [record.loss for record in rest.history] == [record.loss for record in whole.history]


def test_ctrl_c_keeps_the_best_values_and_the_last_state() -> None:
    states = []

    def stop(*_: Any) -> None:
        if len(seen := descent.history) == 30 and seen:
            raise KeyboardInterrupt

    x = Parameter(0.05, torch.zeros(3, dtype=torch.float64))
    descent = AdamDescent(Bowl(), {"x": x}, AdamSettings())
    found = descend(descent, 200, stop, save=states.append)
    assert found.ending is Ending.INTERRUPTED and len(found.history) == 30
    assert states[-1]["steps"] == 30 and 0.0 < off(found) < 2.3
