"""Modes of torch in which no fit runs: inference, without gradients, and lower precision."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")


def in_full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Run a function with gradients and without autocast, in whatever modes it is called."""

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        # Each call has a context of its own: one that torch's decorator shares does not survive calls within calls.
        with torch.inference_mode(False), torch.enable_grad(), torch.autocast("cpu", enabled=False):
            return function(*args, **kwargs)

    return run
