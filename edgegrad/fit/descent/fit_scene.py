"""fit_scene(): any tensors of a scene, found by following the gradient of a loss between renders and pictures."""

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
from ..upside_down import warn_of_masks
from ..views import Images, View, outlined_views, views_of
from .adam_steps import AdamSteps
from .building import Build, Built, Values, builder, built, checked_parameters, like
from .gauss_newton import GaussNewtonSteps
from .loop import Way, descend
from .objective import Objective, judged
from .result import Fit


class Progress(Record):
    """What the callback of a fit by descent gets: the record of a step, and what the fit has reached by it. Scene and cameras are
    those of the moment when they are asked for, which is during the call."""

    views: list[View]  # what is compared; on coarse levels of fit_shape at fewer pixels
    _values: Values
    _build: Build
    _bones: Callable[[Values], Tensor | None] | None

    @property
    def bones(self) -> Tensor | None:
        """(K, 2, 3) ends of the bones of what bends, of the moment as the scene; None of other fits."""
        return None if self._bones is None else self._bones(self._values)

    @property
    def scene(self) -> Scene:
        return self._built[0]

    @property
    def cameras(self) -> list[Camera]:
        return self._built[1]

    @cached_property
    def _built(self) -> Built:
        # Copies, for the next step changes the values in place.
        return built(self._build, {name: value.detach().clone() for name, value in self._values.items()})


def reporter(
    build: Build, views: list[View], coordinates: Coordinates | None = None,
    bones: Callable[[Values], Tensor | None] | None = None,
) -> Callable[[Record, Values], Progress]:  # fmt: skip
    """What makes a Progress of a step."""

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
    """Finds tensors of a scene and its cameras, and where objects stand, for which renders look like the pictures.

    scene        where the fit starts; or a function of the parameters' values, a dict of tensors, that makes a Scene, a Mesh, or
                 a pair of one and a list of cameras
    cameras      one, a batch, or a sequence of cameras, of any sizes
    images       linear radiance, (H, W, C) for one camera, else (B, H, W, C) or a sequence; None: masks alone
    parameters   by name, a learning rate or a Parameter. Names are those of the fields: "verts" or "texture" of a Mesh,
                 "meshes.0.verts", "lights.1.direction", "background" of a Scene, "cameras.0.K" of a camera; for a function they
                 are its own, each with a Parameter that has a value. Or a PoseParameter: "pose" moves a Mesh, "meshes.0.pose"
                 one of a Scene, "cameras.0.pose" a camera, about the middle of the scene; a function gets a Pose under its
                 name, with R, t and scale for mesh.transformed(), differentiable, and names the object by PoseParameter(of=…)
    masks        (H, W) each, 1 on the object, 0 elsewhere: then pictures are multiplied by them and compared over black,
                 and alpha is compared with the mask; where a soft mask is between, alpha alone
    weights      (H, W) each, from 0: how much a pixel counts
    regularizer  of the scene, added to the loss
    options      see edgegrad.fit.Options: loss, method, steps, spp, seed, callback, checkpoint, …

    Raises TypeError or ValueError that names the argument.
    """
    opts = options_of(options)
    views = views_of(cameras, images, masks, weights)
    if opts.loss == REGION:
        views = outlined_views(views)
    build, known = builder(scene, [view.camera for view in views], drop_background=masks is not None)
    wanted = checked_parameters(parameters, known)
    return fit_views(build, views, wanted, opts, {"scene": scene, "parameters": wanted}, regularizer)


def options_of(options: Mapping[str, Any]) -> Options:
    """Raises TypeError that names what is unknown."""
    names = list(Options.__dataclass_fields__)
    for name in options:
        if name not in names:
            raise TypeError(f"expected options among {', '.join(names)}, got {name!r}{like(name, names)}")
    return Options(**options)


def way_of(parameters: Mapping[str, Parameter], options: Options) -> Way[Objective]:
    """By the method of the options. Raises ValueError where it does not serve."""
    return {"adam": AdamSteps, "gauss-newton": GaussNewtonSteps}[options.method](parameters, options)


@torch.inference_mode(False)
@torch.enable_grad()
def fit_views(
    build: Build,
    views: list[View],
    parameters: Mapping[str, Parameter | Placement],
    options: Options,
    given: Mapping[str, Any],
    regularizer: Callable[[Scene], Tensor] | None = None,
) -> Fit:
    """fit_scene() with everything checked; `given` are the arguments of which views and options do not tell."""
    checkpoint = Checkpoint.of(options, views, given)
    saved = checkpoint.read()
    coordinates = Coordinates(parameters)

    def whole(tensors: Mapping[str, Tensor]) -> Built:
        return build(coordinates.values(tensors))

    start, cameras = built(whole, {n: p.value for n, p in coordinates.parameters.items() if p.value is not None})
    warn_of_masks(views, start, cameras)
    objective = Objective(whole, views, options, regularizer)
    objective.check({n: p.value for n, p in coordinates.parameters.items() if p.value is not None})
    way = way_of(coordinates.parameters, options)
    descent = descend(way, objective, checkpoint.write, saved, report=reporter(whole, views, coordinates))
    return judged(objective, descent, start, coordinates)
