"""fit_scene(): find any tensors of a scene by following the gradient of a loss between renders and pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

from torch import Tensor

from ...camera.camera import Camera
from ...optim.parameter import Parameter
from ...optim.tensors import Record
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ...scene.tree import map_tensors
from ..checkpoints import CheckpointFile
from ..losses import REGION
from ..modes import in_full_precision
from ..options import DESCENT_OPTIONS, FitOptions, Settings
from ..placement import Coordinates, Placement, PoseParameter
from ..views import Images, Observation, views_of
from .descend import descend_views
from .objective import Objective
from .result import Fit, make_fit
from .scene_builder import Build, Built, Values, build_detached, builder, checked_parameters


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
        # The next step changes the values in place, and the callback may change all that it gets.
        built = build_detached(self._build, {name: value.detach().clone() for name, value in self._values.items()})
        return map_tensors(built, Tensor.clone)


def reporter(
    build: Build, views: list[Observation], coordinates: Coordinates | None = None,
    bones: Callable[[Values], Tensor | None] | None = None,
) -> Callable[[Record, Values], Progress]:  # fmt: skip
    """Return a function that makes a Progress of a step's record and the tensors after it."""

    def progress(record: Record, values: Values) -> Progress:
        record = record._replace(values={name: value.clone() for name, value in record.values.items()})
        made = Progress(*(record if coordinates is None else coordinates.recorded(record)))
        made.views, made._values, made._build, made._bones = views, values, build, bones
        return made

    return progress


@in_full_precision
def fit_scene(
    scene: Scene | Mesh | Callable[[Values], Any],
    images: Images | None,
    cameras: Camera | Sequence[Camera],
    parameters: Mapping[str, float | Parameter | PoseParameter],
    *,
    masks: Images | None = None,
    weights: Images | None = None,
    regularizer: Callable[[Scene], Tensor] | None = None,
    options: FitOptions | None = None,
) -> Fit:
    """Find tensors of a scene and its cameras, and poses of objects, whose renders match the pictures.

    Parameters
    ----------
    scene : Scene, Mesh or function
        The initial scene; or a function of the parameters' values by name that returns a Scene, a Mesh, or a pair of one and a
        list of cameras.
    images : Tensor or sequence of Tensor, or None
        Linear radiance (H, W, C), one for each camera; None: masks alone.
    cameras : Camera or sequence of Camera
        One for each picture, of any sizes.
    parameters : mapping
        By name, a learning rate, a Parameter or a PoseParameter. Names are those of fields: "verts" of a Mesh;
        "meshes.0.verts", "lights.1.direction" or "background" of a Scene; "cameras.0.K". Poses are "pose" of a Mesh,
        "meshes.0.pose", and "cameras.0.pose", which turns about the middle of the scene. A function has names of its own: each
        Parameter then needs a value, and each PoseParameter its object, PoseParameter(of=…); the function gets R, t and scale
        of it.
    masks : Tensor or sequence of Tensor, optional
        (H, W) each, 1 on the object and 0 elsewhere. Pictures are then compared over black, and alpha with the mask.
    weights : Tensor or sequence of Tensor, optional
        (H, W) each, ≥ 0: how much a pixel counts.
    regularizer : function, optional
        Of the scene, added to the loss.
    options : FitOptions, optional
        Of its defaults, `steps` is 500 and `spp` 16.

    Returns
    -------
    Fit
        The `values` by name, the `scene` and `cameras` with them.

    Raises
    ------
    TypeError, ValueError
        An argument is wrong; the message names it.
    """
    settings = Settings.from_options(options, "fit_scene", DESCENT_OPTIONS)
    views = views_of(cameras, images, masks, weights, by_region=settings.loss == REGION)
    build, known = builder(scene, [view.camera for view in views], drop_background=masks is not None)
    wanted = checked_parameters(parameters, known)
    return fit_views(build, views, wanted, settings, {"scene": scene, "parameters": wanted}, regularizer)


def fit_views(
    build: Build,
    views: list[Observation],
    parameters: Mapping[str, Parameter | Placement],
    options: Settings,
    given: Mapping[str, Any],
    regularizer: Callable[[Scene], Tensor] | None = None,
) -> Fit:
    """Run fit_scene() on checked arguments. `given` are the arguments that views and options do not hold."""
    checkpoint = CheckpointFile.from_views(options.checkpoint, views, {**given, **options.of_steps})
    saved = checkpoint.read()
    coordinates = Coordinates(parameters)

    def whole(tensors: Mapping[str, Tensor]) -> Built:
        return build(coordinates.values(tensors))

    first = {name: p.value for name, p in coordinates.parameters.items() if p.value is not None}
    start, _ = build_detached(whole, first)
    objective = Objective(whole, views, options, regularizer)
    objective.check(first)
    report = reporter(whole, views, coordinates)
    descent = descend_views(objective, coordinates.parameters, checkpoint.write, saved, report=report)
    return make_fit(objective, descent, start, coordinates)
