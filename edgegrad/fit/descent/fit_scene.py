"""fit_scene(): find any tensors of a scene by following the gradient of a loss between renders and pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from ...camera.camera import Camera
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..checkpoints import Checkpoint
from ..history import Record
from ..losses import REGION
from ..options import Options, Parameter
from ..placement import Coordinates, Placement, PoseParameter
from ..row_order import check_mask_rows
from ..views import Images, Observation, region_views, views_of
from .adam_steps import AdamOptimizer
from .gauss_newton import GaussNewtonOptimizer
from .loop import Optimizer, descend
from .objective import Objective
from .result import Fit, make_fit
from .scene_builder import Build, Built, Values, build_detached, builder, checked_parameters, suggestion


class Progress(Record):
    """The callback's argument in a fit by descent: the record of a step, and the state that the fit has reached by it.

    Scene and cameras are built when they are asked for, from the values at that moment: use them during the call.
    """

    views: list[Observation]  # what is compared; on coarse levels of fit_shape with fewer pixels
    _values: Values
    _build: Build
    _bones: Callable[[Values], Tensor | None] | None

    @property
    def bones(self) -> Tensor | None:
        """Ends (K, 2, 3) of the bones, built like the scene; None in fits without a rig."""
        return None if self._bones is None else self._bones(self._values)

    @property
    def scene(self) -> Scene:
        return self._built[0]

    @property
    def cameras(self) -> list[Camera]:
        return self._built[1]

    @cached_property
    def _built(self) -> Built:
        # The next step changes the values in place.
        return build_detached(self._build, {name: value.detach().clone() for name, value in self._values.items()})


def reporter(
    build: Build, views: list[Observation], coordinates: Coordinates | None = None,
    bones: Callable[[Values], Tensor | None] | None = None,
) -> Callable[[Record, Values], Progress]:  # fmt: skip
    """Return a function that makes a Progress of a step's record and the tensors after it."""

    def progress(record: Record, values: Values) -> Progress:
        made = Progress(*(record if coordinates is None else coordinates.recorded(record)))
        made.views, made._values, made._build, made._bones = views, values, build, bones
        return made

    return progress


def fit_scene(
    scene: Scene | Mesh | Callable[[Values], Any],
    cameras: Camera | Sequence[Camera],
    images: Images | None,
    parameters: Mapping[str, float | Parameter | PoseParameter],
    *,
    masks: Images | None = None,
    weights: Images | None = None,
    regularizer: Callable[[Scene], Tensor] | None = None,
    **options: Any,
) -> Fit:
    """Find tensors of a scene and its cameras, and poses of objects, whose renders match the pictures.

    scene        initial Scene or Mesh; or a function of the parameters' values, a dict of tensors, that returns a Scene, a
                 Mesh, or a pair of one and a list of cameras
    cameras      one, a batch, or a sequence of cameras, of any sizes
    images       linear radiance, (H, W, C) for one camera, else (B, H, W, C) or a sequence; None: masks alone
    parameters   by name, a learning rate, a Parameter or a PoseParameter. Names are those of fields: "verts" or "texture" of a
                 Mesh; "meshes.0.verts", "lights.1.direction" or "background" of a Scene; "cameras.0.K" of a camera. Poses are
                 named "pose" of a Mesh, "meshes.0.pose" of a Scene's mesh, "cameras.0.pose" of a camera, which turns about the
                 middle of the scene. A function has names of its own: each Parameter needs a value, and each PoseParameter its
                 object, PoseParameter(of=…); it gets a Pose with R, t and scale for mesh.transformed()
    masks        (H, W) each, 1 on the object, 0 elsewhere. Pictures are multiplied by them and compared over black, and alpha
                 is compared with the mask; where a soft mask is between 0 and 1, alpha alone is compared. None: whole pictures
    weights      (H, W) each, ≥ 0: how much a pixel counts; None: all count the same
    regularizer  function of the scene that is added to the loss; None: nothing is
    options      see edgegrad.fit.Options: loss, method, steps, spp, seed, callback, checkpoint, …

    Raises TypeError or ValueError that names the argument.
    """
    opts = options_of(options)
    views = views_of(cameras, images, masks, weights)
    if opts.loss == REGION:
        views = region_views(views)
    build, known = builder(scene, [view.camera for view in views], drop_background=masks is not None)
    wanted = checked_parameters(parameters, known)
    return fit_views(build, views, wanted, opts, {"scene": scene, "parameters": wanted}, regularizer)


def options_of(options: Mapping[str, Any]) -> Options:
    """Return Options. Raises TypeError that names an unknown option."""
    names = list(Options.__dataclass_fields__)
    for name in options:
        if name not in names:
            raise TypeError(f"expected options among {', '.join(names)}, got {name!r}{suggestion(name, names)}")
    return Options(**options)


def make_optimizer(parameters: Mapping[str, Parameter], options: Options) -> Optimizer:
    """Return the optimizer that `options.method` names. Raises ValueError where it cannot serve."""
    return {"adam": AdamOptimizer, "gauss-newton": GaussNewtonOptimizer}[options.method](parameters, options)


@torch.inference_mode(False)
@torch.enable_grad()
def fit_views(
    build: Build,
    views: list[Observation],
    parameters: Mapping[str, Parameter | Placement],
    options: Options,
    given: Mapping[str, Any],
    regularizer: Callable[[Scene], Tensor] | None = None,
) -> Fit:
    """Run fit_scene() on checked arguments. `given` are the arguments that views and options do not hold."""
    checkpoint = Checkpoint.from_fit(options, views, given)
    saved = checkpoint.read()
    coordinates = Coordinates(parameters)

    def whole(tensors: Mapping[str, Tensor]) -> Built:
        return build(coordinates.values(tensors))

    start, cameras = build_detached(
        whole, {n: p.value for n, p in coordinates.parameters.items() if p.value is not None}
    )
    check_mask_rows(views, start, cameras)
    objective = Objective(whole, views, options, regularizer)
    objective.check({n: p.value for n, p in coordinates.parameters.items() if p.value is not None})
    optimizer = make_optimizer(coordinates.parameters, options)
    descent = descend(optimizer, objective, checkpoint.write, saved, report=reporter(whole, views, coordinates))
    return make_fit(objective, descent, start, coordinates)
