"""A test of whether a noisy cost still falls, from costs by the same samples at all points.

The costs of two points by one set of samples differ far less by noise than those by two. S sets give S such differences. How
far these are apart says how much of the mean difference may be noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

EMPTY = torch.empty(0)
NOISE_MEMORY = 0.7  # weight of earlier differences in the running mean of the noise


@dataclass(kw_only=True)
class Settling:
    """The costs (S,) of a descent's points, one after the other, and how many there were since the cost last fell."""

    first: float = math.nan  # mean cost of the first point
    cost: Tensor = EMPTY  # costs of the last point
    lowest: Tensor = EMPTY  # costs from which a fall is counted: a slow descent falls in several points together
    noise: float = 0.0  # variance of the mean difference from point to point, averaged over these
    points: int = 0
    settled: int = 0  # points since the last fall

    def slack(self, fall: Tensor, deviations: float) -> float:
        """Return by how much noise may change a cost, with the differences (S,) of costs by their sets of samples."""
        return deviations * math.sqrt(max(self.noise, _variance_of_mean(fall)))

    def add(self, cost: Tensor, deviations: float, tolerance: float) -> None:
        """Add the costs (S,) of a point. They have fallen if their mean is lower by more than so many standard deviations of
        the noise, and than the tolerated share of the cost, or of its decrease so far where that is less. Costs that are not
        finite have not fallen."""
        if not bool(cost.isfinite().all()):
            self.settled += self.points > 0
            return
        if not self.points:
            self.first, self.lowest = float(cost.mean()), cost
        else:
            square, memory = _variance_of_mean(self.cost - cost), NOISE_MEMORY if self.points > 1 else 0.0
            self.noise = memory * self.noise + (1.0 - memory) * square
            fall, now = self.lowest - cost, float(cost.mean())
            share = tolerance * min(abs(now), abs(self.first - now))
            if float(fall.mean()) > max(self.slack(fall, deviations), share):
                self.settled, self.lowest = 0, cost
            else:
                self.settled += 1
        self.cost, self.points = cost, self.points + 1

    def rebase(self, before: Tensor, after: Tensor) -> None:
        """Go on with other costs, which are `after` at a point where they were `before`."""
        shift = after - before
        self.cost, self.lowest, self.first = self.cost + shift, self.lowest + shift, self.first + float(shift.mean())


def _variance_of_mean(differences: Tensor) -> float:
    return float(differences.var() / len(differences)) if len(differences) > 1 else 0.0
