"""fit_rig(): the pose and shape of what bends, from coarse to fine."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from ...camera.camera import Camera
from ...check import check_int, check_positive
from ...files.paths import PathLike, replacing
from ...files.save import save_scene
from ...rig.function import OfFunction
from ...rig.rig import Rig
from ...rig.rotations import roma
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..checkpoints import Checkpoint
from ..ending import Ending
from ..history import Record
from ..losses import REGION
from ..options import Options, Parameter
from ..placement import Coordinates
from ..priors import Prior, towards
from ..views import Images, View, outlined_views, views_of
from .building import Built
from .fit_scene import options_of, reporter, way_of
from .gauss_newton import GaussNewtonSteps
from .keypoints import keypoint_term
from .loop import Descent, descend
from .objective import Objective, judged
from .result import Fit
from .rig_search import Limb, Search, limbs
from .rig_values import Sought

FEW = 200  # numbers, up to which steps are those of Gauss and Newton
TRIED = range(24, 97)  # pixels on the shorter side of pictures on levels where limbs are drawn anew
TRY_STEPS = 6  # of each of these
FINER = 4  # times as many samples on the last level, where twists of limbs are told by little
NEAR = 10.0  # what is left of the loss, in units of its noise, from which steps go far where pictures show little:
HARDLY_SEEN = 1e-6  # of the largest curvature, beside what damps a step
GROWTH = 3.0  # a prior's weight grows by this power of how much coarser the pictures are
STEPS, COARSE = 40, 15  # of the last level, and at most of each before
ONWARD = (
    0.5  # of the last frame's motion, that the next begins with: all of it would add up errors that no picture shows
)
F64 = torch.float64


@dataclass(frozen=True, eq=False)
class RigFit:
    """What fit_rig() found.

    values  all that posed() takes, by name: rig.posed(**values); rotations as rotation vectors
    fit     the numbers that were sought, loss, views and history
    """

    rig: Rig
    values: dict[str, Any]
    fit: Fit = field(repr=False)

    def posed(self) -> Scene | Mesh:
        return self.rig.posed(**self.values)

    @property
    def bones(self) -> Tensor | None:
        """See Rig.bones()."""
        return self.rig.bones(self.values)

    @property
    def converged(self) -> bool:
        """See Fit.converged."""
        return self.fit.converged

    @property
    def reason(self) -> str:
        """See Fit.reason."""
        return self.fit.reason

    @property
    def loss(self) -> float:
        return self.fit.loss

    @property
    def history(self) -> list[Record]:
        return self.fit.history

    def save(self, folder: PathLike, figures: bool = True) -> list[str]:
        """What Fit.save() writes, pose.json: all values by name, as lists, and posed.glb: the meshes in this pose. Raises
        OSError, or at last ImportError."""
        out = Path(folder)
        out.mkdir(parents=True, exist_ok=True)
        content = {name: value.tolist() for name, value in self.values.items()}
        with replacing(out / "pose.json") as temporary:
            temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        save_scene(out / "posed.glb", self.fit.scene.replace(background=None))
        return ["pose.json", "posed.glb", *self.fit.save(out, figures)]

    def _repr_png_(self) -> bytes:
        return self.fit._repr_png_()


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
    look: Callable[[Scene | Mesh], Scene | Mesh] | None = None,
    **options: Any,
) -> RigFit:
    """Finds the pose and shape of a rig from pictures, masks or both.

    seek       what is sought, of the rig's controls and "translation", "orientation" and "scale". None: its controls but the
               places and scales of joints, and where it stands: "translation", of a rig of a function "orientation" too; of a
               robot its angles alone
    joints     whose rotations are sought; None: those that vertices hang on. The others stay as they start
    start      values to begin with, by the names that posed() takes; what is not named is at rest
    priors     see edgegrad.fit.priors; None: towards rest, weakly. Limits of the rig's controls are always kept
    keypoints  by the name of a joint, where each camera sees it: (B, 2) pixels, NaN where it does not. Robust: some may be wrong
    keypoint_weight  of the mean over all of them, of squared distances in units of 2 % of the picture
    coarsest   pixels on the shorter side of the pictures of the first level; each further one has twice as many
    tries      how often at most a limb is drawn anew, on each level of some 32 to 64 pixels, to leave places where a descent
               ends; it ends where pictures are explained. 0 for a start nearby
    look       makes of what is posed what is rendered: with lights, a background
    options    see edgegrad.fit.Options; `steps` are those of the last level, at most 15 on those before, and the last has four
               times `spp`. Up to 200 numbers are sought by "gauss-newton", more by "adam", unless `method` says. With
               loss="region" photographs need no masks, and limbs are not drawn anew: the start must overlap what is shown

    The other arguments are those of fit_scene(). Raises TypeError or ValueError that names the argument.
    """
    if not isinstance(rig, Rig):
        raise TypeError(f"rig: expected a Rig, got {type(rig).__name__}; load one with load_rig(path)")
    check_int("coarsest", coarsest, 4, 65536)
    check_int("tries", tries, 0, 10**6)
    check_positive("keypoint_weight", keypoint_weight, least=0.0, most=1e9)
    sought = Sought.of(rig, seek, joints, start or {})
    count = sum(p.value.numel() for p in sought.parameters.values() if p.value is not None)
    opts = options_of({"method": "gauss-newton" if count <= FEW else "adam", "steps": STEPS, "spp": 8, **options})
    views = views_of(cameras, images, masks, weights)
    if opts.loss == REGION:
        views = outlined_views(views)
    terms = (
        [towards({name: control.rest for name, control in rig.controls.items()})] if priors is None else list(priors)
    )
    points = (
        None if keypoints is None else keypoint_term(rig, [view.camera for view in views], keypoints, keypoint_weight)
    )
    return _Search(rig, sought, views, opts, terms, points, coarsest, tries, look or (lambda scene: scene)).run()


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
    arguments  the others of fit_rig()

    Raises what fit_rig() raises.
    """
    from ..priors import near

    before: list[dict[str, Tensor]] = []
    for frame in frames:
        told = {**arguments, **frame}
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


class _Search:
    """The levels of one fit."""

    def __init__(
        self, rig: Rig, sought: Sought, views: list[View], options: Options, priors: Sequence[Prior], points: Prior | None,
        coarsest: int, tries: int, look: Callable[[Any], Scene | Mesh],
    ) -> None:  # fmt: skip
        self.rig, self.sought, self.views, self.options, self.priors = rig, sought, views, options, priors
        self.points, self.tries, self.look = points, tries, look
        full = min(min(view.camera.size) for view in views)
        sizes = [coarsest]
        while sizes[-1] * 1.4 < full:
            sizes.append(2 * sizes[-1])
        self.factors = [size / full for size in sizes[:-1]] + [1.0]
        self.tried = [k for k, size in enumerate(sizes) if size in TRIED] or [0]

    @torch.inference_mode(False)
    @torch.enable_grad()
    def run(self) -> RigFit:
        parameters = self.sought.parameters
        values = {name: p.value for name, p in parameters.items() if p.value is not None}
        first = dict(values)
        given = {"start": self.sought.fixed, "parameters": parameters, "tries": self.tries, "factors": self.factors}
        checkpoint = Checkpoint.of(self.options, self.views, given)
        saved, level, history, seconds = checkpoint.read(), 0, [], 0.0
        if saved is not None:
            level, values, seconds = saved["level"], saved["values"], saved["seconds"]
            history = [Record(*record) for record in saved["history"]]
        while True:
            stage = {"level": level, "values": values, "history": [tuple(r) for r in history], "seconds": seconds}

            def save(loop: dict[str, Any], stage: dict[str, Any] = stage) -> None:
                checkpoint.write({**stage, "loop": loop})

            found = self.descend(values, level, save, None if saved is None else saved["loop"], saved is None)
            saved, values = None, found.values
            history += [record._replace(step=len(history) + k) for k, record in enumerate(found.history)]
            seconds += found.seconds
            if found.ending is Ending.INTERRUPTED or level == len(self.factors) - 1:
                break
            level += 1
        objective = Objective(self.build(self.views), self.views, self.options)
        with torch.no_grad():
            start, _ = objective.build(first)
        fit = judged(objective, Descent(values, history, seconds, found.ending), start, Coordinates({}))
        return RigFit(self.rig, {name: value.detach() for name, value in self.sought.all(values).items()}, fit)

    def build(self, views: Sequence[View]) -> Callable[[Mapping[str, Tensor]], Built]:
        return lambda tensors: self._scene(self.rig.posed(**self.sought.all(tensors)), views)

    def many(self, views: Sequence[View]) -> Callable[[Mapping[str, Tensor]], list[Built]]:
        """The same of a batch of values. Rotations become matrices first, for a batch of three rotation vectors of three joints
        has the shape of three matrices."""

        def built(tensors: Mapping[str, Tensor]) -> list[Built]:
            values = dict(self.sought.all(tensors))
            if "rotations" in values and not isinstance(self.rig.deformer, OfFunction):
                values["rotations"] = roma().rotvec_to_rotmat(values["rotations"])
            return [self._scene(posed, views) for posed in self.rig.posed(**values)]

        return built

    def _scene(self, posed: Scene | Mesh, views: Sequence[View]) -> Built:
        posed = self.look(posed)
        scene = Scene([posed]) if isinstance(posed, Mesh) else posed
        masked = any(view.mask is not None for view in views)
        scene = scene.replace(background=None) if masked and scene.background is not None else scene
        return scene, [view.camera for view in views]

    def descend(
        self, values: Mapping[str, Tensor], level: int, save: Callable[[dict[str, Any]], None], saved: dict[str, Any] | None,
        fresh: bool,
    ) -> Descent:  # fmt: skip
        """One level; the best values are in the result's."""
        factor = self.factors[level]
        views = [view.resized(factor) for view in self.views]
        grown = factor**-GROWTH

        def prior(tensors: Mapping[str, Tensor]) -> Tensor:
            known = self.sought.values(tensors)
            total = torch.zeros((), dtype=F64)
            for term in self.priors:
                total = total + grown * term(known)
            return total if self.points is None else total + self.points(self.sought.all(tensors))

        build = self.build(views)
        spp = max(self.options.spp, 16) if factor < 0.4 else self.options.spp
        coarse = level < len(self.factors) - 1 and self.options.method == "gauss-newton" and self.options.loss != REGION
        steps = min(self.options.steps, COARSE) if coarse else self.options.steps
        fine = level == len(self.factors) - 1
        spp = FINER * spp if fine else spp
        options = dataclasses.replace(self.options, spp=spp, steps=steps)
        objective = Objective(build, views, options, prior=prior, many=self.many(views))
        if fresh and level == 0:
            objective.check(values)
        found = self._steps(objective, values, options, save, saved, f"level {level + 1} of {len(self.factors)}", fine)
        name = next((n for n in ("rotations", "angles") if n in values and self.rig.deformer.parents), None)
        if (
            level in self.tried
            and self.tries
            and name is not None
            and saved is None
            and found.ending is not Ending.INTERRUPTED
        ):
            found = found._replace(values=self._searched(objective, found.values, options, name))
        return found

    def _searched(
        self, objective: Objective, values: Mapping[str, Tensor], options: Options, name: str
    ) -> dict[str, Tensor]:
        few = dataclasses.replace(options, steps=TRY_STEPS, tolerance=0.0, progress=False, callback=None)
        control, rows = self.rig.controls[name], self.sought.rows.get(name, torch.arange(len(values[name])))
        if name == "rotations":
            groups = limbs(self.rig, rows.tolist())
        else:
            groups = [Limb(list(range(k, len(values[name])))) for k in range(len(values[name]))]

        def steps(objective: Objective, parameters: Mapping[str, Parameter]) -> dict[str, Tensor]:
            return descend(way_of(parameters, few), objective, lambda state: None).values

        bar = tqdm(total=self.tries, desc="limbs drawn anew", disable=not options.progress, leave=False)
        try:
            search = Search(
                objective, name, groups, self.sought.parameters, control.rest[rows], steps, options.seed, bar.update
            )
            return search.run(dict(values), self.tries)
        finally:
            bar.close()

    def _steps(
        self, objective: Objective, values: Mapping[str, Tensor], options: Options, save: Callable[[dict[str, Any]], None],
        saved: dict[str, Any] | None, title: str, fine: bool,
    ) -> Descent:  # fmt: skip
        parameters = {
            name: dataclasses.replace(p, value=p.within(values[name])) for name, p in self.sought.parameters.items()
        }
        way = way_of(parameters, options)
        near = objective.regions is None and fine and objective.left(values) < NEAR
        if isinstance(way, GaussNewtonSteps) and near:
            way.unseen = HARDLY_SEEN
        return descend(
            way, objective, save, saved, title,
            reporter(objective.build, objective.views, bones=self.bones),
        )  # fmt: skip

    @torch.no_grad()
    def bones(self, tensors: Mapping[str, Tensor]) -> Tensor | None:
        return self.rig.bones(self.sought.all(tensors))
