"""track_rig(): the poses of what bends in a sequence of pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from torch import Tensor

from ...camera.camera import Camera
from ...check import check_int, check_positive
from ...optim.parameter import Parameter
from ...rig.rig import Rig
from ..options import FitOptions, Settings, options_of
from ..priors import Prior, near, towards
from .fit_rig import RIG_OPTIONS, Appearance, fit_rig
from .result import RigFit
from .settings import RIG

OF_FRAME = ("images", "masks", "weights", "keypoints")


def track_rig(
    rig: Rig,
    frames: Sequence[Mapping[str, Any]],
    cameras: Camera | Sequence[Camera],
    init: Mapping[str, Any] | None = None,
    *,
    seek: Sequence[str] | None = None,
    priors: Sequence[Prior] | None = None,
    search: bool | int = True,
    smooth: float = 1e-5,
    again: int = 10,
    appearance: Appearance | tuple[Appearance, Mapping[str, Parameter]] | None = None,
    options: FitOptions | None = None,
) -> Iterator[RigFit]:
    """Yield the pose in each picture of a sequence: each starts from an extrapolation of the last two, and stays near it.

    Parameters
    ----------
    rig, cameras, seek, priors, search, appearance
        As of fit_rig(); `search` is that of the first frame.
    frames : sequence of mapping
        For each moment "images", "masks", "weights" and "keypoints", as fit_rig() takes them: {"masks": …}.
    init : mapping, optional
        Of the first pose, as of fit_rig(); without one it is searched for.
    smooth : float, default 1e-5
        The weight of edgegrad.fit.priors.near().
    again : int, default 10
        Largest number of draws of limbs in a frame that shows too few edges of one. A limb that is still missed is not drawn in
        the next frames.
    options : FitOptions, optional
        As of fit_rig(). Of a checkpoint each frame has a file of its own, with its number in the name.

    Raises
    ------
    TypeError, ValueError
        An argument is wrong; the message names it.
    """
    check_positive("smooth", smooth, least=0.0, most=1e9)
    check_int("again", again, 0, 10**6)
    given = options_of(options)
    of_first = given.of_part(0)
    # One seed serves all frames, so that the draws of one that is resumed are those of the first time.
    given = replace(given, seed=Settings.from_options(of_first, "track_rig", RIG_OPTIONS).seed)
    before: list[dict[str, Tensor]] = []
    missed: set[str] = set()
    for k, frame in enumerate(frames):
        if not isinstance(frame, Mapping):
            raise TypeError(f'frames[{k}]: expected arguments by name, as {{"masks": …}}, got {type(frame).__name__}')
        if unknown := [name for name in frame if name not in OF_FRAME]:
            raise ValueError(f"frames[{k}]: expected names among {', '.join(OF_FRAME)}, got {unknown[0]!r}")
        pictures = {"images": None, **frame}
        own = given.of_part(k)
        shared: dict[str, Any] = {"cameras": cameras, **pictures, "seek": seek, "appearance": appearance}
        if not before:
            found = fit_rig(rig, **shared, init=init, priors=priors, search=search, options=own)
        else:
            last = before[-1]
            ahead = (
                last if len(before) < 2 else {n: v + RIG.motion_share * (v - before[-2][n]) for n, v in last.items()}
            )
            ahead = {n: rig.controls[n].within(v) if n in rig.controls else v for n, v in ahead.items()}
            still = towards({name: control.rest for name, control in rig.controls.items()})
            terms = [near(ahead, smooth), *([still] if priors is None else priors)]
            own = own if own.coarsest is not None else replace(own, coarsest=RIG.track_coarsest)
            found = fit_rig(rig, **shared, init=ahead, priors=terms, search=0, options=own)
            if again and set(found.missed) - missed and not found.interrupted:
                # A limb in a wrong place would stay there in later frames.
                anew = replace(own, checkpoint=None)
                other = fit_rig(rig, **shared, init=found.values, priors=terms, search=again, options=anew)
                found = other if other.interrupted or other.loss < found.loss else found
        missed = set(found.missed)
        before = [*before[-1:], found.values]
        yield found
