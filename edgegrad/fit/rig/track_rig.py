"""track_rig(): the poses of what bends in a sequence of pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from ...camera.camera import Camera
from ...check import check_int, check_positive
from ...rig.rig import Rig
from ..priors import near, towards
from .fit_rig import fit_rig
from .result import RigFit

# Share of the last frame's motion to start with: all of it would add up errors that no picture shows.
MOTION_SHARE = 0.5


def track_rig(
    rig: Rig,
    cameras: Camera | Sequence[Camera],
    frames: Sequence[Mapping[str, Any]],
    *,
    start: Mapping[str, Any] | None = None,
    smooth: float = 1e-5,
    again: int = 10,
    **arguments: Any,
) -> Iterator[RigFit]:
    """Yield the pose in each picture of a sequence: each starts from an extrapolation of the last two, and stays near it.

    frames     the arguments of fit_rig() for each moment: {"masks": …}, or {"images": …, "keypoints": …}
    start      of the first pose; without one it is searched for
    smooth     the weight of edgegrad.fit.priors.near()
    again      largest number of draws of limbs in a frame that shows too few edges of one, as fit_rig() takes `tries` in the
               first; a limb that is still missed is not drawn in the next frames
    arguments  the others of fit_rig(); of a `checkpoint` each frame has a file of its own, with its number in the name

    Raises what fit_rig() raises.
    """
    check_positive("smooth", smooth, least=0.0, most=1e9)
    check_int("again", again, 0, 10**6)
    before: list[dict[str, Tensor]] = []
    missed: set[str] = set()
    for k, frame in enumerate(frames):
        if not isinstance(frame, Mapping):
            raise TypeError(f'frames[{k}]: expected arguments by name, as {{"masks": …}}, got {type(frame).__name__}')
        given = {**arguments, **frame}
        if given.get("checkpoint") is not None:
            path = Path(given["checkpoint"])
            given["checkpoint"] = path.with_name(f"{path.stem}-{k + 1:04d}{path.suffix}")
        if not before:
            found = fit_rig(rig, cameras, start=start, **given)
        else:
            last = before[-1]
            ahead = last if len(before) < 2 else {n: v + MOTION_SHARE * (v - before[-2][n]) for n, v in last.items()}
            ahead = {n: rig.controls[n].within(v) if n in rig.controls else v for n, v in ahead.items()}
            still = towards({name: control.rest for name, control in rig.controls.items()})
            terms = [near(ahead, smooth), *(given.get("priors") or [still])]
            whole = {"coarsest": 48, **given, "priors": terms, "tries": 0}
            found = fit_rig(rig, cameras, start=ahead, **whole)
            if again and set(found.missed) - missed and not found.fit.interrupted:
                # A limb in a wrong place would stay there in later frames.
                anew = {**whole, "tries": again, "checkpoint": None, "resume": False}
                other = fit_rig(rig, cameras, start=found.values, **anew)
                found = other if other.fit.interrupted or other.loss < found.loss else found
        missed = set(found.missed)
        before = [*before[-1:], found.values]
        yield found
