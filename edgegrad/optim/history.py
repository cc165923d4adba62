"""The steps of a descent as they are kept, and why it took no more of them."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from torch import Tensor


class Record(NamedTuple):
    """One step of a descent in named tensors."""

    step: int
    loss: float  # of this step's samples
    gradient: dict[str, float]  # norm of the gradient by each parameter
    values: dict[str, Tensor]  # of parameters of up to 64 numbers, before the step
    rate: float = 1.0  # factor of the learning rates


class Ending(Enum):
    """Why a fit took no more steps."""

    FLAT = "the steps led no further"
    STEPS = "steps ran out"
    FALLING = "loss still falling"
    INTERRUPTED = "interrupted"
