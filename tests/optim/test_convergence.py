"""Whether a noisy cost still falls."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from edgegrad.optim.convergence import Settling


def settled(
    cost: Callable[[int], float], points: int, noise: float = 0.0, tolerance: float = 0.0, sets: int = 2
) -> list[int]:
    """Return how many points there were since the last fall, after each of the points. Each set of samples tilts the cost."""
    generator, settling, found = torch.Generator().manual_seed(0), Settling(), []
    for k in range(points):
        shake = noise * torch.randn(sets, generator=generator, dtype=torch.float64)
        settling.add(cost(k) + shake, 2.0, tolerance)
        found.append(settling.settled)
    return found


def test_a_cost_that_falls_has_not_settled() -> None:
    assert settled(lambda k: 0.9**k, 20) == [0] * 20
    assert settled(lambda k: 1.0, 5) == [0, 1, 2, 3, 4]


def test_noise_alone_settles() -> None:
    found = settled(lambda k: 1.0, 400, noise=0.1)
    assert max(found) > 50 and found.count(0) < 25


@pytest.mark.parametrize("sets", [2, 6])
def test_a_slow_fall_within_the_noise_of_single_points_does_not_settle(sets: int) -> None:
    found = settled(lambda k: 10.0 - 0.02 * k, 400, noise=0.05, sets=sets)
    assert max(found[20:]) < 20 and found.count(0) > 30


def test_what_is_tolerated_is_relative_to_the_decrease_so_far() -> None:
    """Most of this cost is a part that no step can lower."""
    cost = lambda k: 10.0 + 0.5**k  # noqa: E731
    found = settled(cost, 12, tolerance=0.01)
    # 2⁻⁷ is less than 1 % of the decrease, and 2⁻⁷ + 2⁻⁸ more. What is left from there is less, too.
    assert found == [0, 0, 0, 0, 0, 0, 0, 1, 0, 1, 2, 3]


def test_other_costs_at_the_same_point_are_no_fall() -> None:
    settling = Settling()
    for cost in (1.0, 0.5):
        settling.add(torch.full((2,), cost, dtype=torch.float64), 2.0, 0.0)
    settling.rebase(torch.full((2,), 0.5), torch.full((2,), 0.1))
    settling.add(torch.full((2,), 0.1, dtype=torch.float64), 2.0, 0.0)
    assert settling.settled == 1 and settling.first == pytest.approx(0.6)
