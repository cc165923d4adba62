"""fit_scene(): any tensors of a scene, found by following the gradient of a loss between renders and pictures."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from ...aovs import render_aovs
from ...camera.camera import Camera
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ...scene.tree import map_tensors, named_tensors, with_named
from ..checkpoints import Checkpoint
from ..history import Record
from ..losses import loss_of
from ..measured import Measurement, comparable, measured_loss
from ..options import Options, Parameter
from ..upside_down import warn_of_masks
from ..verdict import explained
from ..views import Images, View, grouped, views_of
from .loop import Descent, descend
from .result import Fit

Values = dict[str, Tensor]
Built = tuple[Scene, list[Camera]]
Build = Callable[[Values], Built]
FINAL_SPP = 64  # samples a pixel of the renders that are judged


class Progress(Record):
    """What the callback of a fit by descent gets: the record of a step, and what the fit has reached by it. Scene and cameras are
    those of the moment when they are asked for, which is during the call."""

    views: list[View]  # what is compared; on coarse levels of fit_shape at fewer pixels
    _values: Values
    _build: Build

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


def reporter(build: Build, views: list[View]) -> Callable[[Record, Values], Progress]:
    """What makes a Progress of a step."""

    def progress(record: Record, values: Values) -> Progress:
        made = Progress(*record)
        made.views, made._values, made._build = views, values, build
        return made

    return progress


def fit_scene(
    scene: Scene | Mesh | Callable[[Values], Any],
    cameras: Camera | Sequence[Camera],
    images: Images | None,
    parameters: Mapping[str, float | Parameter],
    *,
    masks: Images | None = None,
    weights: Images | None = None,
    regularizer: Callable[[Scene], Tensor] | None = None,
    **options: Any,
) -> Fit:
    """Finds tensors of a scene and its cameras for which renders look like the pictures.

    scene        where the fit starts; or a function of the parameters' values, a dict of tensors, that makes a Scene, a Mesh, or
                 a pair of one and a list of cameras
    cameras      one, a batch, or a sequence of cameras, of any sizes
    images       linear radiance, (H, W, C) for one camera, else (B, H, W, C) or a sequence; None: masks alone
    parameters   by name, a learning rate or a Parameter. Names are those of the fields: "verts" or "texture" of a Mesh,
                 "meshes.0.verts", "lights.1.direction", "background" of a Scene, "cameras.0.K" of a camera; for a function they
                 are its own, each with a Parameter that has a value
    masks        (H, W) each, 1 on the object, 0 elsewhere: then pictures are multiplied by them and compared over black,
                 and alpha is compared with the mask; where a soft mask is between, alpha alone
    weights      (H, W) each, from 0: how much a pixel counts
    regularizer  of the scene, added to the loss
    options      see edgegrad.fit.Options: loss, steps, spp, seed, callback, checkpoint, …

    Raises TypeError or ValueError that names the argument.
    """
    opts = options_of(options)
    views = views_of(cameras, images, masks, weights)
    build, known = builder(scene, [view.camera for view in views], drop_background=masks is not None)
    wanted = checked_parameters(parameters, known)
    return fit_views(build, views, wanted, opts, {"scene": scene, "parameters": wanted}, regularizer)


def options_of(options: Mapping[str, Any]) -> Options:
    """Raises TypeError that names what is unknown."""
    names = list(Options.__dataclass_fields__)
    for name in options:
        if name not in names:
            raise TypeError(f"expected options among {', '.join(names)}, got {name!r}{_like(name, names)}")
    return Options(**options)


def _like(name: str, names: Sequence[str]) -> str:
    close = difflib.get_close_matches(name, names, n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def builder(scene: object, cameras: list[Camera], drop_background: bool) -> tuple[Build, Values | None]:
    """A function from values to scene and cameras, and the tensors that may be sought; None when a function says."""

    def ready(scene: Scene | Mesh) -> Scene:
        whole = Scene([scene]) if isinstance(scene, Mesh) else scene
        return whole.replace(background=None) if drop_background and whole.background is not None else whole

    if isinstance(scene, Scene | Mesh):
        start = map_tensors(scene, lambda tensor: tensor.detach().cpu().clone())
        prefix = "cameras."

        def replaced(values: Values) -> Built:
            inside = {name: value for name, value in values.items() if not name.startswith(prefix)}
            outside = {name[len(prefix) :]: value for name, value in values.items() if name.startswith(prefix)}
            return ready(with_named(start, inside)), with_named(cameras, outside)

        known = dict(named_tensors(start))
        known |= {prefix + name: tensor for name, tensor in named_tensors(cameras)}
        return replaced, {name: tensor for name, tensor in known.items() if tensor.is_floating_point()}
    if not callable(scene):
        raise TypeError(f"scene: expected a Scene, a Mesh, or a function that makes one, got {type(scene).__name__}")

    def made(values: Values) -> Built:
        found = scene(values)
        whole, seen = found if isinstance(found, tuple) else (found, cameras)
        if not isinstance(whole, Scene | Mesh):
            raise TypeError(f"scene: expected a function that makes a Scene or a Mesh, got {type(whole).__name__}")
        seen = [seen] if isinstance(seen, Camera) else list(seen)
        if len(seen) != len(cameras):
            raise ValueError(f"scene: expected a function that makes {len(cameras)} cameras, got {len(seen)}")
        return ready(whole), seen

    return made, None


def checked_parameters(parameters: object, known: Values | None) -> dict[str, Parameter]:
    """Each with a value to start from. Raises TypeError or ValueError."""
    if not isinstance(parameters, Mapping) or not parameters:
        raise TypeError("parameters: expected a mapping of names to learning rates or Parameters, got none")
    found = {}
    for name, given in parameters.items():
        parameter = given if isinstance(given, Parameter) else Parameter(given)  # type: ignore[arg-type]
        if known is not None:
            if name not in known:
                raise ValueError(
                    f"parameters: expected names among {', '.join(known)}, got {name!r}{_like(name, list(known))}"
                )
            if parameter.value is None:
                parameter = Parameter(parameter.lr, known[name], parameter.low, parameter.high, parameter.uniform)
            elif parameter.value.shape != known[name].shape:
                raise ValueError(
                    f"{name}: expected shape {tuple(known[name].shape)}, got {tuple(parameter.value.shape)}"
                )
        found[name] = parameter.checked(name)
    return found


@torch.inference_mode(False)
@torch.enable_grad()
def fit_views(
    build: Build,
    views: list[View],
    parameters: Mapping[str, Parameter],
    options: Options,
    given: Mapping[str, Any],
    regularizer: Callable[[Scene], Tensor] | None = None,
) -> Fit:
    """fit_scene() with everything checked; `given` are the arguments of which views and options do not tell."""
    checkpoint = Checkpoint.of(options, views, given)
    saved = checkpoint.read()
    start, cameras = built(build, {name: p.value for name, p in parameters.items() if p.value is not None})
    warn_of_masks(views, start, cameras)
    objective = objective_of(build, views, options, regularizer)
    descent = descend(objective, parameters, options, checkpoint.write, saved, report=reporter(build, views))
    return judged(build, views, options, descent, start)


def objective_of(
    build: Build, views: list[View], options: Options, regularizer: Callable[[Scene], Tensor] | None
) -> Callable[[Values, int], Tensor]:
    """The loss of some of the views at a step, with samples of its own."""
    loss, mask_loss = loss_of("loss", options.loss), loss_of("mask_loss", options.mask_loss)

    def objective(values: Values, step: int) -> Tensor:
        scene, cameras = build(values)
        seed = (options.seed + 7919 * step) % 2**32
        picks = _picks(len(views), options, step)
        total = torch.zeros((), dtype=torch.float64)
        for group, renders in _renders(scene, cameras, views, picks, options, options.spp, seed):
            first = views[group[0]]
            for name in first.wanted:
                target = _stacked([views[i].wanted[name] for i in group])
                weights = [views[i].weights[name] for i in group]
                weight = None if weights[0] is None else _stacked(weights)
                by = loss if name == "image" else mask_loss
                total = total + len(group) * by(renders[name], target, weight).double()
            for name in first.measured:
                given = [views[i].measured[name] for i in group]
                total = total + len(group) * _of_measured(renders, name, given, first.mask is None).double()
        total = total / len(picks)
        return total if regularizer is None else total + regularizer(scene)

    return objective


def _picks(count: int, options: Options, step: int) -> list[int]:
    """The views of a step: all, or so many by turns in an order that is drawn anew for each round."""
    n = options.views_per_step
    if n is None or n >= count:
        return list(range(count))
    picks = []
    for k in range(step * n, (step + 1) * n):
        order = torch.randperm(count, generator=torch.Generator().manual_seed(options.seed + k // count))
        picks.append(int(order[k % count]))
    return sorted(set(picks))


def _renders(
    scene: Scene, cameras: list[Camera], views: list[View], picks: list[int], options: Options, spp: int, seed: int
) -> Iterator[tuple[list[int], dict[str, Tensor]]]:
    """Places of views of one kind, and their channels (B, H, W, c)."""
    for group in grouped([views[i] for i in picks]):
        group = [picks[k] for k in group]
        batch = Camera.stack([cameras[i] for i in group])
        yield group, render_aovs(scene, batch, views[group[0]].aovs, spp=spp, seed=seed, **options.render)


def _of_measured(renders: dict[str, Tensor], name: str, given: Sequence[Measurement], covers: bool) -> Tensor:
    return measured_loss(renders[name], renders["alpha"], given, covers)


def _stacked(tensors: Sequence[Tensor | None]) -> Tensor:
    return torch.stack([tensor for tensor in tensors if tensor is not None])


def built(build: Build, values: Values) -> Built:
    """Without gradients."""
    with torch.no_grad():
        scene, cameras = build({name: value.detach() for name, value in values.items()})
        return scene.detach(), [map_tensors(camera, Tensor.detach) for camera in cameras]


def judged(build: Build, views: list[View], options: Options, descent: Descent, start: Scene) -> Fit:
    """The result: the loss of the best values over all views with many samples, and how much of the pictures they explain."""
    scene, cameras = built(build, descent.values)
    loss_functions = {"image": loss_of("loss", options.loss), "alpha": loss_of("mask_loss", options.mask_loss)}
    loss, pairs = 0.0, []
    spp = max(options.spp, FINAL_SPP)
    with torch.no_grad():
        for i, view in enumerate(views):
            renders = [
                next(_renders(scene, cameras, views, [i], options, spp, (options.seed + k) % 2**32))[1] for k in (1, 2)
            ]
            means = {name: 0.5 * (found + renders[1][name])[0] for name, found in renders[0].items()}
            for name, target in view.wanted.items():
                loss += float(loss_functions[name](means[name], target, view.weights[name])) / len(views)
                pairs.append((renders[0][name][0], renders[1][name][0], target, view.weight))
            for name, given in view.measured.items():
                mean = {key: value[None] for key, value in means.items()}
                loss += float(_of_measured(mean, name, [given], view.mask is None)) / len(views)
                target, weight = comparable(means[name], means["alpha"], given)
                pairs.append((renders[0][name][0], renders[1][name][0], target, weight))
    return Fit(
        values=descent.values, scene=scene, cameras=cameras, views=views, loss=loss, explained=explained(pairs),
        flat=descent.flat, interrupted=descent.interrupted, history=descent.history, seconds=descent.seconds, start=start,
    )  # fmt: skip
