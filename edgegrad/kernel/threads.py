"""Number of threads of a pass of the kernel, and passes that run in parallel."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

_own = threading.local()
Item = TypeVar("Item")
Result = TypeVar("Result")


def threads() -> int:
    """Return the number of threads of a pass: as many as torch takes, or one where passes run in parallel."""
    return 1 if getattr(_own, "parallel", False) else torch.get_num_threads()


def parallel_map(work: Callable[[Item], Result], items: Iterable[Item], count: int) -> list[Result]:
    """Return work(item) of all `count` items, on as many threads as torch takes, each pass on one of them.

    Work on an item begins once it is there, while the calling thread makes the next. Autograd records nothing of the work.
    """
    threads = min(torch.get_num_threads(), count)

    def run(item: Item) -> Result:
        _own.parallel = threads > 1
        with torch.no_grad():
            return work(item)

    if threads < 2:
        return [run(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        started = [pool.submit(run, item) for item in items]
        return [job.result() for job in started]
