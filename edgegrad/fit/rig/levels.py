"""The levels of a fit of a rig: pictures from coarse to fine, and on coarse ones limbs that are drawn anew."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from ...aovs import render_aovs
from ...rig.function import FunctionDeformer
from ...rig.rig import Rig
from ...rig.rotations import roma
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..checkpoints import Checkpoint
from ..descent.curvature import MAX_NUMBERS
from ..descent.fit_scene import make_optimizer, reporter
from ..descent.gauss_newton import GaussNewtonOptimizer
from ..descent.loop import Descent, descend
from ..descent.objective import Objective
from ..descent.region_loss import FINAL_STEP
from ..descent.result import RESULT_SPP, make_fit
from ..descent.scene_builder import Built
from ..ending import Ending
from ..history import Record
from ..losses import REGION
from ..options import Options, Parameter
from ..placement import Coordinates
from ..priors import Prior
from ..views import Observation
from .alternatives import Alternatives
from .limbs import ByContour, ByLoss, Limb, Search, limbs
from .result import RigFit
from .shown import explained_by_joint, left_out
from .sought import Sought
from .twists import untwisted
from .uncertainty import JointUncertainty, uncertainty_of

TRIED = range(24, 97)  # pixels on the shorter side of pictures on levels where limbs are drawn anew
TRY_STEPS = 6  # of each of these
TWIST_STEPS = 12  # of a limb of which a joint is twisted, on the last level
BY_REGIONS = 4  # a try by regions takes so many times as long, and there are so many times fewer
FINER = 4  # times as many samples on the last level, where twists of limbs are told by little
NEAR = 10.0  # what is left of the loss, in units of its noise, from which steps go far where pictures show little:
HARDLY_SEEN = 1e-6  # of the largest curvature, beside what damps a step,
NEAR_DAMPING = 1e-4  # and that: shared twists go all the way before the loss, which hardly tells, seems at rest
GROWTH = 3.0  # a prior's weight grows by this power of how much coarser the pictures are
EASED = 0.1  # of a prior that nobody asked for, at the pictures' own size, where it would outweigh what tells twists
COARSE = 15  # steps at most of each level before the last
F64 = torch.float64


class Levels:
    """The levels of one fit."""

    def __init__(
        self, rig: Rig, sought: Sought, views: list[Observation], options: Options, priors: Sequence[Prior], eased: bool,
        points: Prior | None, coarsest: int, tries: int, look: Callable[..., Scene | Mesh],
    ) -> None:  # fmt: skip
        self.rig, self.sought, self.views, self.options = rig, sought, views, options
        self.priors, self.eased = priors, eased
        self.points, self.tries, self.look = points, tries, look
        full = min(min(view.camera.size) for view in views)
        sizes = [coarsest]
        while sizes[-1] * 1.4 < full:
            sizes.append(2 * sizes[-1])
        # The last level is of more samples, and begins where the whole is explained but for twists.
        self.factors = [size / full for size in sizes[:-1]] + [1.0] * (2 if options.method == "gauss-newton" else 1)
        self.tried = [k for k, size in enumerate(sizes) if size in TRIED] or [0]
        if options.loss == REGION:
            self.tried = self.tried[-1:]  # coarse contours tell little

    @torch.inference_mode(False)
    @torch.enable_grad()
    def run(self) -> RigFit:
        parameters = self.sought.parameters
        values = self.sought.start
        first = dict(values)
        given = {"start": self.sought.fixed, "parameters": parameters, "tries": self.tries, "factors": self.factors}
        checkpoint = Checkpoint.from_fit(self.options, self.views, given)
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
        objective = Objective(self.build(self.views), self.views, self.options, build_batch=self.many(self.views))
        with torch.no_grad():
            start, _ = objective.build(first)
        fit = make_fit(objective, Descent(values, history, seconds, found.ending), start, Coordinates({}))
        found_values = {name: value.detach() for name, value in self.sought.all(values).items()}
        with torch.no_grad():
            alphas = [render_aovs(fit.scene, view.camera, ["alpha"], spp=16)["alpha"] for view in self.views]
        return RigFit(self.rig, found_values, fit, *self._told(objective, values), left_out(self.views, alphas))

    def _told(
        self, objective: Objective, values: Mapping[str, Tensor]
    ) -> tuple[dict[str, float], JointUncertainty | None]:
        """Of each joint, what the pictures show of it, and how exactly."""
        joints = self.sought.joints
        if not joints or sum(value.numel() for value in values.values()) > MAX_NUMBERS:
            return {}, None
        rates = {name: p.lr for name, p in self.sought.parameters.items()}
        # The noise of few samples would count as that of the pictures.
        options = dataclasses.replace(self.options, spp=max(self.options.spp, RESULT_SPP))
        objective = Objective(objective.build, self.views, options, build_batch=objective.build_batch)
        if objective.regions is not None:
            objective.renew(values, FINAL_STEP)
        try:
            return explained_by_joint(objective, values, joints), uncertainty_of(objective, values, rates, joints)
        except TypeError:  # no forward mode
            return {}, None

    def build(self, views: Sequence[Observation]) -> Callable[[Mapping[str, Tensor]], Built]:
        return lambda tensors: self._scene(self.rig.posed(**self.sought.all(tensors)), self.sought.look(tensors), views)

    def many(self, views: Sequence[Observation]) -> Callable[[Mapping[str, Tensor]], list[Built]]:
        """The same of a batch of values. Rotations become matrices first, for a batch of three rotation vectors of three joints
        has the shape of three matrices."""

        def built(tensors: Mapping[str, Tensor]) -> list[Built]:
            values = dict(self.sought.all(tensors))
            if "rotations" in values and not isinstance(self.rig.deformer, FunctionDeformer):
                values["rotations"] = roma().rotvec_to_rotmat(values["rotations"])
            every = self.rig.posed(**values)
            return [self._scene(posed, self.sought.look(tensors, k), views) for k, posed in enumerate(every)]

        return built

    def _scene(self, posed: Scene | Mesh, values: Mapping[str, Tensor], views: Sequence[Observation]) -> Built:
        posed = self.look(posed, **values)
        if not isinstance(posed, Mesh | Scene):
            raise TypeError(f"look: expected it to return a Mesh or a Scene, got {type(posed).__name__}")
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
        grown = factor**-GROWTH if factor < 1.0 or not self.eased else EASED

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
        objective = Objective(build, views, options, prior=prior, build_batch=self.many(views))
        if fresh and level == 0:
            objective.check(values)
        title = f"level {level + 1} of {len(self.factors)}"
        found = self._steps(objective, values, options, save, saved, title, fine)
        name = next((n for n in ("rotations", "angles") if n in values and n in self.sought.joints), None)
        if (
            level in self.tried
            and self.tries
            and name is not None
            and saved is None
            and found.ending is not Ending.INTERRUPTED
        ):
            try:
                found = found._replace(values=self._searched(objective, found.values, options, name))
            except KeyboardInterrupt:
                return found._replace(ending=Ending.INTERRUPTED)
        if (
            fine
            and self.tries
            and name == "rotations"
            and objective.regions is None
            and found.ending is not Ending.INTERRUPTED
        ):
            try:
                search = self._search(objective, found.values, options, name, TWIST_STEPS)
                near = objective.residual(found.values) < NEAR
                values = search.twisted(found.values) if near else found.values
                values = untwisted(objective, search.alternatives, self.sought.parameters[name], values)
            except KeyboardInterrupt:
                return found._replace(ending=Ending.INTERRUPTED)
            if values is found.values:
                return found
            more = self._steps(objective, values, options, save, None, title, fine)
            later = [record._replace(step=len(found.history) + k) for k, record in enumerate(more.history)]
            found = more._replace(history=found.history + later, seconds=found.seconds + more.seconds)
        return found

    def _searched(
        self, objective: Objective, values: Mapping[str, Tensor], options: Options, name: str
    ) -> dict[str, Tensor]:
        bar = tqdm(total=self.tries, desc="limbs drawn anew", disable=not options.progress, leave=False)
        try:
            search = self._search(objective, values, options, name, TRY_STEPS, bar.update)
            return search.run(dict(values), self.tries if objective.regions is None else -(-self.tries // BY_REGIONS))
        finally:
            bar.close()

    def _search(
        self, objective: Objective, values: Mapping[str, Tensor], options: Options, name: str, count: int,
        tell: Callable[[], Any] = lambda: None,
    ) -> Search:  # fmt: skip
        """Each way of so many steps."""
        few = dataclasses.replace(options, steps=count, tolerance=0.0, progress=False, callback=None)
        control, rows = self.rig.controls[name], self.sought.rows.get(name, torch.arange(len(values[name])))
        joints = self.sought.joints.get(name, ())
        if not self.rig.deformer.parents:  # nothing says what hangs on what
            groups = [Limb([k]) for k in range(len(values[name]))]
        elif name == "rotations":
            groups = limbs(self.rig, rows.tolist())
        else:
            groups = [Limb(list(range(k, len(values[name])))) for k in range(len(values[name]))]

        def steps(objective: Objective, parameters: Mapping[str, Parameter]) -> dict[str, Tensor]:
            found = descend(make_optimizer(parameters, few), objective, lambda state: None)
            if found.ending is Ending.INTERRUPTED:
                raise KeyboardInterrupt
            return found.values

        judge = ByLoss(objective, name) if objective.regions is None else ByContour(objective, name, joints)
        return Search(
            objective, judge, name, groups, self.sought.parameters, control.rest[rows],
            Alternatives(self.rig, self.sought, name), steps, options.seed, tell,
        )  # fmt: skip

    def _steps(
        self, objective: Objective, values: Mapping[str, Tensor], options: Options, save: Callable[[dict[str, Any]], None],
        saved: dict[str, Any] | None, title: str, fine: bool,
    ) -> Descent:  # fmt: skip
        parameters = {
            name: dataclasses.replace(p, value=p.within(values[name])) for name, p in self.sought.parameters.items()
        }
        way = make_optimizer(parameters, options)
        near = objective.regions is None and fine and objective.residual(values) < NEAR
        if isinstance(way, GaussNewtonOptimizer) and near:
            way.unseen_damping, way.damping = HARDLY_SEEN, NEAR_DAMPING
        return descend(
            way, objective, save, saved, title,
            reporter(objective.build, objective.views, bones=self.bones),
        )  # fmt: skip

    @torch.no_grad()
    def bones(self, tensors: Mapping[str, Tensor]) -> Tensor | None:
        return self.rig.bones(self.sought.all(tensors))
