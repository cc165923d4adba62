"""Levels of a fit of a rig: pictures from coarse to fine, and on coarse ones limbs that are drawn at random."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from ...aovs import render_aovs
from ...optim.history import Ending
from ...optim.tensors import DescentResult
from ...rig.function import FunctionDeformer
from ...rig.rig import Rig
from ...rig.rotations import roma
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..checkpoints import CheckpointFile
from ..descent.curvature import MAX_NUMBERS
from ..descent.descend import GAUSS_NEWTON, Save, continued, descend_levels, descend_views
from ..descent.fit_scene import reporter
from ..descent.objective import Objective
from ..descent.region_loss import FINAL_STEP
from ..descent.result import RESULT_SPP, make_fit
from ..descent.scene_builder import Built, whole_scene
from ..losses import REGION
from ..options import Settings
from ..parameter import Parameter
from ..placement import Coordinates
from ..priors import Prior
from ..views import Observation
from .alternatives import Alternatives
from .axial_rotations import search_axial_rotations
from .free_parameters import FreeParameters
from .joint_support import edge_support_by_joint, left_out
from .limbs import ByContour, ByLoss, Limb, LimbSearch, limbs
from .result import RigFit
from .uncertainty import JointUncertainty, uncertainty_of

DRAWN_SIDES = range(24, 97)  # Limbs are drawn on levels with so many pixels on the shorter side.
DRAW_STEPS = 6  # from each drawn limb
AXIAL_STEPS = 12  # of a limb after a rotation about a bone's axis, on the last level
REGION_COST = 4  # A try by regions takes so many times as long, so there are so many times fewer.
LAST_SPP_FACTOR = 4  # factor of samples on the last level, where axial rotations of limbs show little
# With a residual loss below this, in units of its noise, these two dampings, relative to the largest curvature, make steps go
# far where pictures show little: shared axial rotations arrive before the loss, which hardly shows them, seems at rest.
NEARLY_FITTED = 10.0
NEARLY_FITTED_SETTINGS = dataclasses.replace(GAUSS_NEWTON, unseen_damping=1e-6, start_damping=1e-4)
PRIOR_GROWTH = 3.0  # A prior's weight grows by this power of how much coarser the pictures are.
# The default prior's weight at the pictures' own size, where it would otherwise outweigh what shows axial rotations.
ANNEALED_WEIGHT = 0.1
MAX_COARSE_STEPS = 15  # on each level before the last
F64 = torch.float64


class CoarseToFine:
    """The levels of one fit."""

    def __init__(
        self, rig: Rig, free: FreeParameters, views: list[Observation], options: Settings, priors: Sequence[Prior],
        annealed: bool, points: Prior | None, tries: int, appearance: Callable[..., Scene | Mesh],
    ) -> None:  # fmt: skip
        self.rig, self.free, self.views, self.options = rig, free, views, options
        self.priors, self.annealed = priors, annealed
        self.points, self.tries, self.appearance = points, tries, appearance
        full = min(min(view.camera.size) for view in views)
        sizes = [options.coarsest]
        while sizes[-1] * 1.4 < full:
            sizes.append(2 * sizes[-1])
        # The last level has more samples, and begins where all but axial rotations is right.
        self.factors = [size / full for size in sizes[:-1]] + [1.0] * (2 if options.method == "gauss-newton" else 1)
        self.tried = [k for k, size in enumerate(sizes) if size in DRAWN_SIDES] or [0]
        if options.loss == REGION:
            self.tried = self.tried[-1:]  # Coarse contours show little.

    def run(self) -> RigFit:
        first = self.free.start
        given = {
            "start": self.free.fixed, "parameters": self.free.parameters, "tries": self.tries, "factors": self.factors,
        }  # fmt: skip
        checkpoint = CheckpointFile.from_views(self.options.checkpoint, self.views, {**given, **self.options.of_steps})
        found = descend_levels(checkpoint, first, len(self.factors), self.descend)
        values = found.values
        objective = Objective(self.build(self.views), self.views, self.options, build_batch=self.many(self.views))
        with torch.no_grad():
            start, _ = objective.build(first)
        fit = make_fit(objective, found, start, Coordinates({}))
        found_values = {name: value.detach() for name, value in self.free.all(values).items()}
        with torch.no_grad():
            alphas = [render_aovs(fit.scene, view.camera, ["alpha"], spp=16, seed=0)["alpha"] for view in self.views]
        return RigFit(self.rig, found_values, fit, *self._information(objective, values), left_out(self.views, alphas))

    def _information(
        self, objective: Objective, values: Mapping[str, Tensor]
    ) -> tuple[dict[str, float], JointUncertainty | None]:
        """Return, for each joint, what the pictures show of it, and how exactly."""
        joints = self.free.joints
        if not joints or sum(value.numel() for value in values.values()) > MAX_NUMBERS:
            return {}, None
        rates = {name: p.lr for name, p in self.free.parameters.items()}
        # Noise of few samples would count as noise of the pictures.
        options = dataclasses.replace(self.options, spp=max(self.options.spp, RESULT_SPP))
        objective = Objective(objective.build, self.views, options, build_batch=objective.build_batch)
        if objective.regions is not None:
            objective.renew(values, FINAL_STEP)
        try:
            return edge_support_by_joint(objective, values, joints), uncertainty_of(objective, values, rates, joints)
        except TypeError:  # There is no forward mode.
            return {}, None

    def build(self, views: Sequence[Observation]) -> Callable[[Mapping[str, Tensor]], Built]:
        values = self.free
        return lambda tensors: self._scene(self.rig.posed(**values.all(tensors)), values.appearance_of(tensors), views)

    def many(self, views: Sequence[Observation]) -> Callable[[Mapping[str, Tensor]], list[Built]]:
        """Return what build() does for a batch of values. Rotations become matrices first: three rotation vectors of three
        joints have the shape of three matrices."""

        def built(tensors: Mapping[str, Tensor]) -> list[Built]:
            values = dict(self.free.all(tensors))
            if "rotations" in values and not isinstance(self.rig.deformer, FunctionDeformer):
                values["rotations"] = roma().rotvec_to_rotmat(values["rotations"])
            every = self.rig.posed(**values)
            return [self._scene(posed, self.free.appearance_of(tensors, k), views) for k, posed in enumerate(every)]

        return built

    def _scene(self, posed: Scene | Mesh, values: Mapping[str, Tensor], views: Sequence[Observation]) -> Built:
        posed = self.appearance(posed, **values)
        if not isinstance(posed, Mesh | Scene):
            raise TypeError(f"appearance: expected it to return a Mesh or a Scene, got {type(posed).__name__}")
        masked = any(view.mask is not None for view in views)
        return whole_scene(posed, masked), [view.camera for view in views]

    def descend(
        self, values: dict[str, Tensor], level: int, save: Save, saved: Mapping[str, Any] | None
    ) -> DescentResult:  # fmt: skip
        """Run one level; the best values are in the result's."""
        factor = self.factors[level]
        views = [view.resized(factor) for view in self.views]
        grown = factor**-PRIOR_GROWTH if factor < 1.0 or not self.annealed else ANNEALED_WEIGHT

        def prior(tensors: Mapping[str, Tensor]) -> Tensor:
            known = self.free.values(tensors)
            total = torch.zeros((), dtype=F64)
            for term in self.priors:
                total = total + grown * term(known)
            return total if self.points is None else total + self.points(self.free.all(tensors))

        build = self.build(views)
        spp = max(self.options.spp, 16) if factor < 0.4 else self.options.spp
        coarse = level < len(self.factors) - 1 and self.options.method == "gauss-newton" and self.options.loss != REGION
        steps = min(self.options.steps, MAX_COARSE_STEPS) if coarse else self.options.steps
        fine = level == len(self.factors) - 1
        spp = LAST_SPP_FACTOR * spp if fine else spp
        options = dataclasses.replace(self.options, spp=spp, steps=steps)
        batch = self.many(views)
        objective = Objective(build, views, options, prior=prior, build_batch=batch, builder="appearance")
        if level == 0 and saved is None:
            objective.check(values)
        title = f"level {level + 1} of {len(self.factors)}"
        found = self._steps(objective, values, save, saved, title, fine)
        name = next((n for n in ("rotations", "angles") if n in values and n in self.free.joints), None)
        interrupted = found.ending is Ending.INTERRUPTED
        if level in self.tried and self.tries and name is not None and saved is None and not interrupted:
            try:
                found = found._replace(values=self._searched(objective, found.values, options, name))
            except KeyboardInterrupt:
                return found._replace(ending=Ending.INTERRUPTED)
        if fine and self.tries and name == "rotations" and objective.regions is None and not interrupted:
            try:
                search = self._search(objective, found.values, options, name, AXIAL_STEPS)
                near = objective.residual(found.values) < NEARLY_FITTED
                values = search.rotated(found.values) if near else found.values
                values = search_axial_rotations(objective, search.alternatives, self.free.parameters[name], values)
            except KeyboardInterrupt:
                return found._replace(ending=Ending.INTERRUPTED)
            if values is found.values:
                return found
            more = self._steps(objective, values, save, None, title, fine)
            found = more._replace(history=continued(found.history, more.history), seconds=found.seconds + more.seconds)
        return found

    def _searched(
        self, objective: Objective, values: Mapping[str, Tensor], options: Settings, name: str
    ) -> dict[str, Tensor]:
        bar = tqdm(total=self.tries, desc="limbs drawn", disable=not options.progress, leave=False)
        try:
            search = self._search(objective, values, options, name, DRAW_STEPS, bar.update)
            return search.run(dict(values), self.tries if objective.regions is None else -(-self.tries // REGION_COST))
        finally:
            bar.close()

    def _search(
        self, objective: Objective, values: Mapping[str, Tensor], options: Settings, name: str, count: int,
        report: Callable[[], Any] = lambda: None,
    ) -> LimbSearch:  # fmt: skip
        """Return the search whose descents take so many steps."""
        few = dataclasses.replace(options, steps=count, loss_tolerance=0.0, progress=False, callback=None)
        control, rows = self.rig.controls[name], self.free.rows.get(name, torch.arange(len(values[name])))
        joints = self.free.joints.get(name, ())
        if not self.rig.deformer.parents:  # The rig does not say what hangs on what.
            groups = [Limb([k]) for k in range(len(values[name]))]
        elif name == "rotations":
            groups = limbs(self.rig, rows.tolist())
        else:
            groups = [Limb(list(range(k, len(values[name])))) for k in range(len(values[name]))]

        def steps(objective: Objective, parameters: Mapping[str, Parameter]) -> dict[str, Tensor]:
            found = descend_views(objective.with_options(few), parameters)
            if found.ending is Ending.INTERRUPTED:
                raise KeyboardInterrupt
            return found.values

        judge = ByLoss(objective, name) if objective.regions is None else ByContour(objective, name, joints)
        return LimbSearch(
            objective, judge, name, groups, self.free.parameters, control.rest[rows],
            Alternatives(self.rig, self.free, name), steps, options.seed, report,
        )  # fmt: skip

    def _steps(
        self, objective: Objective, values: Mapping[str, Tensor], save: Save,
        saved: Mapping[str, Any] | None, title: str, fine: bool,
    ) -> DescentResult:  # fmt: skip
        parameters = {
            name: dataclasses.replace(p, value=p.within(values[name])) for name, p in self.free.parameters.items()
        }
        near = objective.regions is None and fine and objective.residual(values) < NEARLY_FITTED
        settings = NEARLY_FITTED_SETTINGS if near else GAUSS_NEWTON
        report = reporter(objective.build, objective.views, bones=self.bones)
        return descend_views(objective, parameters, save, saved, title, report, settings)

    @torch.no_grad()
    def bones(self, tensors: Mapping[str, Tensor]) -> Tensor | None:
        return self.rig.bones(self.free.all(tensors))
