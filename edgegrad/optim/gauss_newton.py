"""Levenberg-Marquardt descents in named tensors, from losses and gradients of samples."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from .levenberg_marquardt import LevenbergMarquardt, LevenbergMarquardtSettings, Model, Problem, Rows
from .tensors import Objective, Parameter, TensorDescent, Tensors, detached, gradients_of

Curvature = Callable[[Tensors, int], Tensor]


class GaussNewtonDescent(TensorDescent):
    """Descent by Gauss-Newton. Slope and curvature have samples of their own in each step; losses are compared by two sets of
    samples."""

    def __init__(
        self, objective: Objective, curvature: Curvature, parameters: Mapping[str, Parameter],
        settings: LevenbergMarquardtSettings,
    ) -> None:  # fmt: skip
        """`curvature` (n, n) of the objective by all numbers, one tensor after the other, at values and a step."""
        super().__init__(objective, parameters)
        self.problem = _TensorProblem(self, curvature)
        self.descents = LevenbergMarquardt(self.problem, [detached(self.values)], settings)

    @property
    def best(self) -> dict[str, Tensor]:
        """The last accepted values, or the mean of several about the minimum."""
        return self.descents.points[0]

    @property
    def falling(self) -> bool:
        """Whether the loss fell in the last step by more than its noise."""
        descent = self.descents.descents[0]
        return descent.accepted > 1 and descent.settled == 0

    def advance(self) -> None:
        (accepted,) = self.descents.advance()
        descent = self.descents.descents[0]
        norms = dict.fromkeys(self.values, math.nan)
        if accepted:
            slopes = self.problem.named(descent.gradient / self.problem.rates)
            norms = {name: float(slope.norm()) for name, slope in slopes.items()}
        self.set(self.problem.candidate)
        self.record(self.problem.cost, norms)
        self.set(descent.point)
        self.resting = descent.rest is not None

    def state(self) -> dict[str, Any]:
        return {**super().state(), "descents": self.descents.state()}

    def load(self, state: Mapping[str, Any]) -> None:
        super().load(state)
        self.descents.load(state["descents"])


class _TensorProblem(Problem[dict[str, Tensor]]):
    """One descent in named tensors. Steps are in units of the learning rates."""

    def __init__(self, descent: GaussNewtonDescent, curvature: Curvature) -> None:
        self.descent, self.objective, self.curvature = descent, descent.objective, curvature
        self.like = detached(descent.values)
        rates = [torch.full((v.numel(),), descent.parameters[n].lr, dtype=torch.float64) for n, v in self.like.items()]
        self.rates = torch.cat(rates).clamp(min=1e-150)  # A rate of 0 holds a number fixed.
        self.candidate, self.cost = self.like, math.nan  # the last one, and its mean cost

    @property
    def provisional(self) -> bool:
        return self.objective.provisional

    def model(self, points: Sequence[dict[str, Tensor]]) -> Model:
        (values,) = points
        step = self.descent.steps
        cost = self.descent.compared(values)
        self.candidate, self.cost = values, float(cost.mean())

        def gradient(rows: Rows) -> Tensor:
            leaves = {name: value.requires_grad_() for name, value in detached(values).items()}
            found = gradients_of(self.objective(leaves, step), leaves)
            whole = {n: torch.zeros_like(v) if (g := found[n]) is None else g for n, v in values.items()}
            return (flat(whole) * self.rates)[None]

        def curvature(rows: Rows) -> Tensor:
            return (self.curvature(values, step) * self.rates * self.rates[:, None])[None]

        return Model(cost[None], gradient, curvature)

    def moved(self, points: Sequence[dict[str, Tensor]], steps: Tensor) -> list[dict[str, Tensor]]:
        return [
            self._within(self.named(flat(values) + step * self.rates))
            for values, step in zip(points, steps, strict=True)
        ]

    def allowed(self, point: dict[str, Tensor], step: Tensor) -> Tensor:
        here = flat(point)
        return (flat(self._within(self.named(here + step * self.rates, torch.float64))) - here) / self.rates

    def renew(self, points: Sequence[dict[str, Tensor]]) -> bool:
        return self.descent.renew(points[0])

    def named(self, numbers: Tensor, dtype: torch.dtype | None = None) -> dict[str, Tensor]:
        """Return the numbers (n,) as tensors by name, by default of the parameters' types."""
        parts = numbers.split([value.numel() for value in self.like.values()])
        return {
            name: part.reshape(value.shape).to(dtype or value.dtype)
            for (name, value), part in zip(self.like.items(), parts, strict=True)
        }

    def _within(self, values: dict[str, Tensor]) -> dict[str, Tensor]:
        return {name: self.descent.parameters[name].within(value) for name, value in values.items()}


def flat(tensors: Tensors) -> Tensor:
    """Return all numbers (n,) float64."""
    return torch.cat([tensor.detach().double().flatten() for tensor in tensors.values()])
