"""track_rig(): the poses of what bends in a sequence of pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from ...camera.camera import Camera
from ...check import check_positive
from ...rig.rig import Rig
from ..priors import near, towards
from .fit_rig import fit_rig
from .result import RigFit

ONWARD = (
    0.5  # of the last frame's motion, that the next begins with: all of it would add up errors that no picture shows
)


def track_rig(
    rig: Rig,
    cameras: Camera | Sequence[Camera],
    frames: Sequence[Mapping[str, Any]],
    *,
    start: Mapping[str, Any] | None = None,
    smooth: float = 1e-5,
    **arguments: Any,
) -> Iterator[RigFit]:
    """The pose in each picture of a sequence, one after the other: each begins on the way of the last two, and stays near it.

    frames     of each moment the arguments of fit_rig() that belong to it: {"masks": …}, or {"images": …, "keypoints": …}
    start      of the first; without one it is searched for
    smooth     the weight of edgegrad.fit.priors.near()
    arguments  the others of fit_rig(); of a `checkpoint` each frame has a file of its own, with its number in the name

    Raises what fit_rig() raises.
    """
    check_positive("smooth", smooth, least=0.0, most=1e9)
    before: list[dict[str, Tensor]] = []
    for k, frame in enumerate(frames):
        if not isinstance(frame, Mapping):
            raise TypeError(f'frames[{k}]: expected arguments by name, as {{"masks": …}}, got {type(frame).__name__}')
        told = {**arguments, **frame}
        if told.get("checkpoint") is not None:
            path = Path(told["checkpoint"])
            told["checkpoint"] = path.with_name(f"{path.stem}-{k + 1:04d}{path.suffix}")
        if not before:
            found = fit_rig(rig, cameras, start=start, **told)
        else:
            last = before[-1]
            ahead = last if len(before) < 2 else {n: v + ONWARD * (v - before[-2][n]) for n, v in last.items()}
            ahead = {n: rig.controls[n].within(v) if n in rig.controls else v for n, v in ahead.items()}
            still = towards({name: control.rest for name, control in rig.controls.items()})
            terms = [near(ahead, smooth), *(told.get("priors") or [still])]
            whole = {"coarsest": 48, "tries": 0, **told, "priors": terms}
            found = fit_rig(rig, cameras, start=ahead, **whole)
        before = [*before[-1:], found.values]
        yield found
