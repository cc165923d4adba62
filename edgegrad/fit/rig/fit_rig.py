"""fit_rig(): pose and shape of what bends, from coarse to fine."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from torch import Tensor

from ...camera.camera import Camera
from ...check import check_int
from ...optim.parameter import Parameter
from ...rig.rig import Rig
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..losses import REGION
from ..measured import Measured
from ..modes import in_full_precision
from ..options import DESCENT_OPTIONS, FitOptions, Settings
from ..priors import Prior, checked_priors, towards
from ..views import Images, views_of
from .free_parameters import FreeParameters
from .keypoints import keypoint_term
from .levels import CoarseToFine
from .result import RigFit
from .settings import RIG

RIG_OPTIONS = (*DESCENT_OPTIONS, "coarsest")
Appearance = Callable[..., Scene | Mesh]


@in_full_precision
def fit_rig(
    rig: Rig,
    images: Images | None,
    cameras: Camera | Sequence[Camera],
    *,
    masks: Images | None = None,
    init: Mapping[str, Any] | None = None,
    weights: Images | None = None,
    keypoints: Mapping[str, Tensor] | Measured | None = None,
    seek: Sequence[str] | None = None,
    priors: Sequence[Prior] | None = None,
    search: bool | int = True,
    appearance: Appearance | tuple[Appearance, Mapping[str, Parameter]] | None = None,
    options: FitOptions | None = None,
) -> RigFit:
    """Find the pose and shape of a rig from pictures, masks or both.

    Parameters
    ----------
    rig : Rig
        What bends.
    images, cameras, masks, weights
        As of fit_scene().
    init : mapping, optional
        Initial values, by the names that posed() takes; what is not named is at rest.
    keypoints : mapping or Measured, optional
        By the name of a joint, where each camera sees it: (B, 2) pixels, NaN where it does not. Some may be wrong.
    seek : sequence of str, optional
        What is sought: the rig's controls, "translation", "orientation", "scale", and joints, each for its own rotation. By
        default the controls but the places and scales of joints, of joints that vertices hang on, and "translation"; of a rig
        of a function "orientation" too; of a robot its angles alone.
    priors : sequence of function, optional
        See edgegrad.fit.priors; by default a weak one to the rest pose. Limits of the controls are always kept.
    search : bool or int, default True
        Largest number of random draws of a limb on each level of 24 to 96 pixels; True: 40. False or 0: `init` alone is refined.
    appearance : function, optional
        Makes of what is posed what is rendered, with lights or a background. Or a pair of it and the parameters by name that
        are sought too, and given to it: appearance(posed, light=…).
    options : FitOptions, optional
        Of its defaults, `steps` is 40 on the last level and 15 before, `spp` 8, four times as many on the last level, and
        `method` "gauss-newton" for up to 200 numbers.

    Returns
    -------
    RigFit
        The `values` that posed() takes, and `uncertainty` of each joint.

    Raises
    ------
    TypeError, ValueError
        An argument is wrong; the message names it.
    """
    if not isinstance(rig, Rig):
        raise TypeError(f"rig: expected a Rig, got {type(rig).__name__}; load one with eg.rig.load(path)")
    tries = RIG.tries * search if isinstance(search, bool) else check_int("search", search, 0, 10**6)
    scene_of, parameters = appearance if isinstance(appearance, tuple) else (appearance or (lambda scene: scene), {})
    free = FreeParameters.from_arguments(rig, seek, init or {}, parameters)
    method = "gauss-newton" if sum(value.numel() for value in free.start.values()) <= RIG.most_numbers else "adam"
    settings = Settings.from_options(options, "fit_rig", RIG_OPTIONS, method=method, steps=RIG.steps, spp=RIG.spp)
    views = views_of(cameras, images, masks, weights, by_region=settings.loss == REGION)
    rest = {name: control.rest for name, control in rig.controls.items()}
    terms = [towards(rest)] if priors is None else checked_priors(priors, free.values(free.start))
    points = None if keypoints is None else keypoint_term(rig, [view.camera for view in views], keypoints)
    return CoarseToFine(free, views, settings, terms, priors is None, points, tries, scene_of).run()
