"""How many threads a pass of the kernel takes, and passes beside each other."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

_own = threading.local()
Item = TypeVar("Item")
Result = TypeVar("Result")


def threads() -> int:
    """As many as torch takes; one where passes run beside each other."""
    return 1 if getattr(_own, "beside", False) else torch.get_num_threads()


def beside(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """work(item) of all, on as many threads as torch takes, each pass on one of them. Nothing is recorded by autograd."""
    count = min(torch.get_num_threads(), len(items))

    def run(item: Item) -> Result:
        _own.beside = True
        with torch.no_grad():
            return work(item)

    if count < 2:
        with torch.no_grad():
            return [work(item) for item in items]
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(run, items))
