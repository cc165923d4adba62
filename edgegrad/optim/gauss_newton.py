"""Levenberg-Marquardt descents in named tensors, from losses and gradients of samples."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from .levenberg_marquardt import LevenbergMarquardt, LevenbergMarquardtSettings, Model, Problem, Rows
from .parameter import Parameter
from .tensors import Objective, TensorDescent, Tensors, detached, flat, gradients_of, named

Curvature = Callable[[Tensors, int], Tensor]


class GaussNewtonDescent(TensorDescent, Problem[dict[str, Tensor]]):
    """Descent by Gauss-Newton, with steps in units of the learning rates. Slope and curvature have samples of their own in
    each step; losses are compared by two sets of samples."""

    def __init__(
        self, objective: Objective, curvature: Curvature, parameters: Mapping[str, Parameter],
        settings: LevenbergMarquardtSettings,
    ) -> None:  # fmt: skip
        """`curvature` (n, n) of the objective by all numbers, one tensor after the other, at values and a step."""
        super().__init__(objective, parameters)
        self.curvature = curvature
        rates = [torch.full((v.numel(),), parameters[n].lr, dtype=torch.float64) for n, v in self.values.items()]
        self.rates = torch.cat(rates).clamp(min=1e-150)  # A rate of 0 holds a number fixed.
        self.descents = LevenbergMarquardt(self, [detached(self.values)], settings)
        (self.settling,) = self.descents.descents

    @property
    def best(self) -> dict[str, Tensor]:
        """The last accepted values, or the mean of several about the minimum."""
        return self.descents.points[0]

    @property
    def provisional(self) -> bool:
        return self.objective.provisional

    def advance(self) -> None:
        (accepted,) = self.descents.advance()
        (descent,) = self.descents.descents
        slopes = named(descent.gradient / self.rates, self.values) if accepted else {}
        norms = {name: float(slopes[name].norm()) if accepted else math.nan for name in self.values}
        self.set(self.candidate)
        self.record(self.cost, norms)
        self.set(descent.point)
        self.resting = descent.rest is not None

    def state(self) -> dict[str, Any]:
        return {**super().state(), "descents": self.descents.state()}

    def load(self, state: Mapping[str, Any]) -> None:
        super().load(state)
        self.descents.load(state["descents"])
        (self.settling,) = self.descents.descents

    def model(self, points: Sequence[dict[str, Tensor]]) -> Model:
        (values,) = points
        cost = self.compared(values)
        self.candidate, self.cost = values, float(cost.mean())  # the last one, and its mean cost

        def gradient(rows: Rows) -> Tensor:
            leaves = {name: value.requires_grad_() for name, value in detached(values).items()}
            found = gradients_of(self.objective(leaves, self.steps), leaves)
            whole = {n: torch.zeros_like(v) if (g := found[n]) is None else g for n, v in values.items()}
            return (flat(whole) * self.rates)[None]

        def curvature(rows: Rows) -> Tensor:
            return (self.curvature(values, self.steps) * self.rates * self.rates[:, None])[None]

        return Model(cost[None], gradient, curvature)

    def moved(self, points: Sequence[dict[str, Tensor]], steps: Tensor) -> list[dict[str, Tensor]]:
        moved = [named(flat(values) + step * self.rates, values) for values, step in zip(points, steps, strict=True)]
        return [self.within(values) for values in moved]

    def allowed(self, point: dict[str, Tensor], step: Tensor) -> Tensor:
        here = flat(point)
        return (flat(self.within(named(here + step * self.rates, point, torch.float64))) - here) / self.rates

    def renew(self, points: Sequence[dict[str, Tensor]]) -> bool:
        return self.renew_objective(points[0])
