"""Trackers on films in processes of their own."""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from benchmarks.poses.objects import Sources

from . import drafts
from .films import Film, Length
from .measures import Record, measured
from .trackers import maker


@dataclass(frozen=True)
class Place:
    """Of what films are made, and where they are kept."""

    sources: Sources
    length: Length
    cache: Path
    photos: Path | None = None

    def film(self, kind: str, seed: int) -> Film:
        return drafts.film(kind, seed, self.sources, self.length, self.cache, self.photos)


@dataclass(frozen=True)
class Job:
    """A tracker on a film; without a tracker the film is only made."""

    kind: str
    seed: int
    place: Place
    tracker: str = ""

    @property
    def key(self) -> tuple[str, int]:
        return self.kind, self.seed


def run(jobs: Sequence[Job], processes: int, threads: int) -> Iterator[list[Record]]:
    """Yield the records of each film as it ends."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, initializer=partial(_begin, threads)) as pool:
        waiting = [pool.submit(followed, job) for job in jobs]
        try:
            for future in as_completed(waiting):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _begin(threads: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that keeps the results.
    torch.set_num_threads(threads)


def followed(job: Job) -> list[Record]:
    """Return a record for each object. A tracker that raises an error has a record that says why."""
    film = job.place.film(job.kind, job.seed)
    if not job.tracker:
        return []
    try:
        records = measured(film, maker(job.tracker))
    except Exception as error:  # The other films go on.
        at = traceback.extract_tb(error.__traceback__)[-1]
        reason = f"{type(error).__name__}: {error} ({Path(at.filename).name}:{at.lineno})"
        return [{"kind": job.kind, "seed": job.seed, "object": 0, "mesh": film.names[0], "error": reason}]
    return [{**record, "tracker": job.tracker, "threads": torch.get_num_threads()} for record in records]
