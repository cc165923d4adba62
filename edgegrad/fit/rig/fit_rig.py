"""fit_rig(): pose and shape of what bends, from coarse to fine."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from torch import Tensor

from ...camera.camera import Camera
from ...check import check_int, check_positive
from ...rig.rig import Rig
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..descent.fit_scene import options_of
from ..losses import REGION
from ..options import Parameter
from ..priors import Prior, checked_priors, towards
from ..views import Images, region_views, views_of
from .free_parameters import FreeParameters
from .keypoints import keypoint_term
from .levels import CoarseToFine
from .result import RigFit

MAX_GAUSS_NEWTON = 200  # largest number of values that "gauss-newton" seeks by default
RIG_STEPS = 40  # on the last level


def fit_rig(
    rig: Rig,
    cameras: Camera | Sequence[Camera],
    images: Images | None = None,
    *,
    masks: Images | None = None,
    weights: Images | None = None,
    seek: Sequence[str] | None = None,
    joints: Sequence[str] | None = None,
    start: Mapping[str, Any] | None = None,
    priors: Sequence[Prior] | None = None,
    keypoints: Mapping[str, Tensor] | None = None,
    keypoint_weight: float = 1e-3,
    coarsest: int = 16,
    tries: int = 40,
    look: Callable[..., Scene | Mesh] | None = None,
    parameters: Mapping[str, Parameter] | None = None,
    **options: Any,
) -> RigFit:
    """Find the pose and shape of a rig from pictures, masks or both.

    seek       what is sought, of the rig's controls and "translation", "orientation" and "scale". None: its controls but the
               places and scales of joints, and where it stands: "translation", of a rig of a function "orientation" too; of a
               robot its angles alone
    joints     whose rotations are sought; None: those that vertices hang on. The others stay as they start
    start      initial values, by the names that posed() takes; what is not named is at rest
    priors     see edgegrad.fit.priors; None: a weak prior to the rest pose, weakest at the pictures' own size. Limits of the
               rig's controls are always kept
    keypoints  by the name of a joint, where each camera sees it: (B, 2) pixels, NaN where it does not. Robust: some may be
               wrong
    keypoint_weight  of the mean over all of them, of squared distances in units of 2 % of the picture
    coarsest   pixels on the shorter side of the pictures of the first level; each further one has twice as many
    tries      largest number of random draws of a limb, on each level of 24 to 96 pixels, to leave places where a descent
               ends. They end where the pictures match, or nearly so while tries gain nothing. Pairs of limbs are exchanged
               before, and rotations about a bone's axis are tried on the last level. 0, without all this, for a start nearby
    look       makes of what is posed what is rendered: with lights, a background
    parameters  of `look`, which are sought too and given to it by name: look(posed, light=…)
    options    see edgegrad.fit.Options; `steps` are those of the last level, at most 15 on those before, and the last has
               four times `spp`. Up to 200 numbers are sought by "gauss-newton", more by "adam", unless `method` says. With
               loss="region" photographs need no masks; the start must overlap what is shown, and limbs are drawn a quarter as
               often, on one level

    The other arguments are those of fit_scene(). Raises TypeError or ValueError that names the argument.
    """
    if not isinstance(rig, Rig):
        raise TypeError(f"rig: expected a Rig, got {type(rig).__name__}; load one with eg.rig.load(path)")
    check_int("coarsest", coarsest, 4, 65536)
    check_int("tries", tries, 0, 10**6)
    check_positive("keypoint_weight", keypoint_weight, least=0.0, most=1e9)
    if parameters and look is None:
        raise ValueError(f"parameters: expected a look that takes {', '.join(parameters)}, got none; give look=")
    free = FreeParameters.from_arguments(rig, seek, joints, start or {}, parameters or {})
    count = sum(p.value.numel() for p in free.parameters.values() if p.value is not None)
    opts = options_of(
        {"method": "gauss-newton" if count <= MAX_GAUSS_NEWTON else "adam", "steps": RIG_STEPS, "spp": 8, **options}
    )
    views = views_of(cameras, images, masks, weights)
    if opts.loss == REGION:
        views = region_views(views)
    rest = {name: control.rest for name, control in rig.controls.items()}
    terms = [towards(rest)] if priors is None else checked_priors(priors, free.values(free.start))
    points = (
        None if keypoints is None else keypoint_term(rig, [view.camera for view in views], keypoints, keypoint_weight)
    )
    scene_of = look or (lambda scene: scene)
    return CoarseToFine(rig, free, views, opts, terms, priors is None, points, coarsest, tries, scene_of).run()
