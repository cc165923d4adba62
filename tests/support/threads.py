"""A check that results have the same bits at any number of threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def check_threads(compute: Callable[[], Sequence[Tensor]], counts: Sequence[int] = (1, 3)) -> Sequence[Tensor]:
    """Assert that `compute` returns the same bits at each number of threads, and that not all are zero; return them."""
    before, found = torch.get_num_threads(), []
    try:
        for count in counts:
            torch.set_num_threads(count)
            found.append([tensor.detach() for tensor in compute()])
    finally:
        torch.set_num_threads(before)
    for others in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], others, strict=True))
    assert all(bool(tensor.any()) for tensor in found[0])
    return found[0]
