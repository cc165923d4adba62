"""Whether the steps of a noisy descent still lead down."""

from __future__ import annotations

import math

import pytest
import torch

from edgegrad.optim.adam import Adam
from edgegrad.optim.convergence import BLOCKS, MAX_PARTS, ConvergenceMonitor, _in_parts


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
    assert down.predicted_decrease(40) > down.least_decrease(0.01, 40)


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
    monitor = monitored(lambda x: x, BLOCKS + 1)
    assert monitor.predicted_decrease(1) == math.inf and not monitor.is_ready
    assert monitored(lambda x: x, BLOCKS + 2).is_ready


def test_tolerance_is_relative_to_the_decrease_so_far():
    """Most of this loss is a part that no step can lower."""
    monitor = ConvergenceMonitor({"x": torch.zeros(1)})
    for k in range(40):
        monitor.end_step(10.0 + 0.5**k, {})
    assert monitor.least_decrease(0.01, 40) == pytest.approx(0.01 * 1.0, rel=0.05)
