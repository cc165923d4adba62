"""Forward mode against reverse mode of the same samples."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def check_both_modes(
    image: Callable[..., Tensor],
    values: Sequence[Tensor],
    tangents: Sequence[Tensor],
    weights: Tensor,
    rel: float = 1e-9,
) -> tuple[Tensor, ...]:
    """Assert ⟨w, J u⟩ = ⟨Jᵀ w, u⟩ for the weights w and the tangents u of the values; return Jᵀ w."""
    leaves = [value.clone().requires_grad_() for value in values]
    gradients = torch.autograd.grad((image(*leaves) * weights).sum(), leaves)
    moved: Tensor = torch.func.jvp(image, tuple(values), tuple(tangents))[1]
    reverse = sum(float((g * u).sum()) for g, u in zip(gradients, tangents, strict=True))
    assert math.isclose(float((moved * weights).sum()), reverse, rel_tol=rel)
    return gradients
