"""Levels of a fit of a rig: pictures from coarse to fine, and on coarse ones limbs that are drawn at random."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ...aovs import render_aovs
from ...optim.parameter import Parameter
from ...optim.tensors import DescentResult, Ending
from ...rig.function import FunctionDeformer
from ...rig.rotations import roma
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..checkpoints import CheckpointFile
from ..descent.curvature import MAX_NUMBERS
from ..descent.descend import GAUSS_NEWTON, Save, continued, descend_levels, descend_views
from ..descent.fit_scene import reporter
from ..descent.objective import Objective
from ..descent.result import RESULT_SPP, make_fit
from ..descent.scene_builder import Built, whole_scene
from ..losses import REGION
from ..options import Settings
from ..placement import Coordinates
from ..priors import Prior
from ..views import Observation
from .free_parameters import FreeParameters
from .joint_support import edge_support_by_joint, left_out
from .proposals import Proposals
from .result import RigFit
from .search import HypothesisSearch
from .settings import RIG
from .uncertainty import features_of, uncertainty_of


@dataclass
class CoarseToFine:
    """The levels of one fit."""

    free: FreeParameters
    views: list[Observation]
    options: Settings
    priors: Sequence[Prior]
    annealed: bool  # whether priors count less on the last level
    points: Prior | None  # the keypoints' term
    tries: int  # of random draws of a limb
    appearance: Callable[..., Scene | Mesh]

    def __post_init__(self) -> None:
        self.rig, full = self.free.rig, min(min(view.camera.size) for view in self.views)
        sizes = [self.options.coarsest]
        while sizes[-1] * 1.4 < full:
            sizes.append(2 * sizes[-1])
        # The last level has more samples, and begins where all but axial rotations is right.
        self.factors = [size / full for size in sizes[:-1]] + [1.0] * (
            2 if self.options.method == "gauss-newton" else 1
        )
        self.searched = [k for k, size in enumerate(sizes) if RIG.least_side <= size <= RIG.most_side] or [0]
        if self.options.loss == REGION:
            self.searched = self.searched[-1:]  # Coarse contours show little.

    def run(self) -> RigFit:
        free, first = self.free, self.free.start
        given = {"start": free.fixed, "parameters": free.parameters, "tries": self.tries, "factors": self.factors}
        checkpoint = CheckpointFile.from_views(self.options.checkpoint, self.views, {**given, **self.options.of_steps})
        found = descend_levels(checkpoint, first, len(self.factors), self.descend)
        # Noise of few samples would count as noise of the pictures.
        options = dataclasses.replace(self.options, spp=max(self.options.spp, RESULT_SPP))
        objective = self.objective(self.views, options)
        with torch.no_grad():
            fit = make_fit(objective, found, objective.build(first)[0], Coordinates({}))
            alphas = [render_aovs(fit.scene, view.camera, ["alpha"], spp=16, seed=0)["alpha"] for view in self.views]
        values = {name: value.detach() for name, value in free.all(found.values).items()}
        support, uncertainty, features = {}, None, {}
        if free.joints and sum(value.numel() for value in first.values()) <= MAX_NUMBERS:
            rates = {name: p.lr for name, p in free.parameters.items()}
            with contextlib.suppress(TypeError):  # There may be no forward mode.
                support = edge_support_by_joint(objective, found.values, free.joints)
                uncertainty = uncertainty_of(objective, found.values, rates, free.joints)
        if uncertainty is not None and objective.regions is None:  # By regions there is no noise to compare with.
            with torch.no_grad():
                features = features_of(support, uncertainty, objective.residual(found.values))
        return RigFit(self.rig, values, fit, support, uncertainty, left_out(self.views, alphas), features)

    def objective(self, views: list[Observation], options: Settings, prior: Prior | None = None) -> Objective:
        """Return the loss of these views."""
        masked, cameras = any(view.mask is not None for view in views), [view.camera for view in views]

        def scene(posed: Scene | Mesh, appearance: Mapping[str, Tensor]) -> Built:
            shown = self.appearance(posed, **appearance)
            if not isinstance(shown, Mesh | Scene):
                raise TypeError(f"appearance: expected it to return a Mesh or a Scene, got {type(shown).__name__}")
            return whole_scene(shown, masked), cameras

        def build(tensors: Mapping[str, Tensor]) -> Built:
            return scene(self.rig.posed(**self.free.all(tensors)), self.free.appearance_of(tensors))

        def build_batch(tensors: Mapping[str, Tensor]) -> list[Built]:
            values = dict(self.free.all(tensors))
            # Three rotation vectors of three joints would have the shape of three matrices.
            if "rotations" in values and not isinstance(self.rig.deformer, FunctionDeformer):
                values["rotations"] = roma().rotvec_to_rotmat(values["rotations"])
            every = self.rig.posed(**values)
            return [scene(posed, self.free.appearance_of(tensors, k)) for k, posed in enumerate(every)]

        return Objective(build, views, options, prior=prior, build_batch=build_batch, builder="appearance")

    def descend(
        self, values: dict[str, Tensor], level: int, save: Save, saved: Mapping[str, Any] | None
    ) -> DescentResult:  # fmt: skip
        """Run one level; the best values are in the result's."""
        factor, last = self.factors[level], level == len(self.factors) - 1
        grown = factor**-RIG.prior_growth if factor < 1.0 or not self.annealed else RIG.last_prior

        def prior(tensors: Mapping[str, Tensor]) -> Tensor:
            known = self.free.values(tensors)
            total = sum((grown * term(known) for term in self.priors), torch.zeros((), dtype=torch.float64))
            return total if self.points is None else total + self.points(self.free.all(tensors))

        options, region = self.options, self.options.loss == REGION
        coarse = not last and options.method == "gauss-newton" and not region
        steps = min(options.steps, RIG.coarse_steps) if coarse else options.steps
        spp = max(options.spp, RIG.coarse_spp) if factor < RIG.coarse_share else options.spp
        options = dataclasses.replace(options, spp=RIG.last_spp * spp if last else spp, steps=steps)
        objective = self.objective([view.resized(factor) for view in self.views], options, prior)
        if level == 0 and saved is None:
            objective.check(values)
        title, gauss_newton = f"level {level + 1} of {len(self.factors)}", GAUSS_NEWTON
        if last and not region:
            damping = {"unseen_damping": RIG.last_unseen_damping, "start_damping": RIG.last_damping}
            gauss_newton = dataclasses.replace(GAUSS_NEWTON, **damping)

        @torch.no_grad()
        def bones(tensors: Mapping[str, Tensor]) -> Tensor | None:
            return self.rig.bones(self.free.all(tensors))

        report = reporter(objective.build, objective.views, bones=bones)

        def descend(values: Mapping[str, Tensor], saved: Mapping[str, Any] | None) -> DescentResult:
            starting = self.free.starting_at(values)
            return descend_views(objective, starting, save, saved, title, report, gauss_newton)

        found = descend(values, saved)
        name = next((n for n in ("rotations", "angles") if n in self.free.joints), None)
        if not self.tries or name is None or saved is not None or found.ending is Ending.INTERRUPTED:
            return found
        try:
            if level in self.searched:
                tries = math.ceil(RIG.region_share * self.tries) if region else self.tries
                search = self._search(objective, name, RIG.refinement_steps)
                found = found._replace(values=search.draw_limbs(found.values, tries, options.progress))
            if last and name == "rotations" and not region:
                better = self._search(objective, name, RIG.last_refinement_steps).rotate_about_bones(found.values)
                if better is not found.values:
                    more = descend(better, None)
                    whole = continued(found.history, more.history)
                    found = more._replace(history=whole, seconds=found.seconds + more.seconds)
        except KeyboardInterrupt:
            return found._replace(ending=Ending.INTERRUPTED)
        return found

    def _search(self, objective: Objective, name: str, count: int) -> HypothesisSearch:
        """Return the search whose descents take so many steps."""
        few = dataclasses.replace(objective.options, steps=count, loss_tolerance=0.0, progress=False, callback=None)

        def steps(objective: Objective, parameters: Mapping[str, Parameter]) -> dict[str, Tensor]:
            found = descend_views(objective.with_options(few), parameters)
            if found.ending is Ending.INTERRUPTED:
                raise KeyboardInterrupt
            return found.values

        generator = torch.Generator().manual_seed(few.seed)
        return HypothesisSearch(objective, Proposals(self.rig, self.free, name), steps, generator)
