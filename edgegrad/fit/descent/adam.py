"""Adam (Kingma and Ba 2015), with one step size for coordinates that belong together."""

from __future__ import annotations

from typing import Any

import torch


class Adam(torch.optim.Optimizer):
    """Adam; with `uniform` in a group, its step is divided by the largest second moment instead of each by its own: then a
    smooth gradient gives a smooth step (Nicolet, Jacobson and Jakob 2021)."""

    def __init__(self, groups: Any, betas: tuple[float, float] = (0.9, 0.999)) -> None:
        super().__init__(list(groups), {"lr": 1e-2, "uniform": False, "betas": betas})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        for group in self.param_groups:
            b1, b2 = group["betas"]
            for p in group["params"]:
                if p.grad is None:
                    continue
                state = self.state[p]
                if not state:
                    state.update(step=0, mean=torch.zeros_like(p), square=torch.zeros_like(p))
                state["step"] += 1
                state["mean"].lerp_(p.grad, 1.0 - b1)
                state["square"].lerp_(p.grad.square(), 1.0 - b2)
                size = (state["square"] / (1.0 - b2 ** state["step"])).sqrt()
                size = size.max() if group["uniform"] else size
                # Relative to the largest, for losses have any units.
                floor = 1e-8 * float(size.max()) + 1e-30
                p.sub_(group["lr"] / (1.0 - b1 ** state["step"]) * state["mean"] / (size + floor))
