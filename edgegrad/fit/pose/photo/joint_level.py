"""Several objects in one photograph: what is compared at one resolution, and the normal equations of a step of all poses.

One render has a channel for each object, which is 1 where it is seen: its alpha behind and before the others. Derivatives are
by the motion of each, for where one covers another the contour moves with the front one. The region term decides for each
pixel which object it shows, or the background; light and depth are compared for each object where it is seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from ....aovs import render_aovs
from ....render import render
from ....scene.mesh import Mesh
from ....scene.scene import Scene
from ...options import Settings
from ...region import RADIUS, Windows, smoothed
from ..gauss_newton import NormalEquations
from ..inputs import without_colors
from ..jacobian import Motions, Rendered
from ..pose import Pose
from ..task import PoseTask
from .contour import contour_term
from .depth import depth_term
from .level import MASK_ERROR, Crop, PhotoLevel, PictureComparison, photo_levels, sharpest
from .occluders import OCCLUDER_MARGIN, occluder_weights, weighted
from .region_term import posteriors, regions_term


@dataclass(frozen=True)
class JointLevel:
    """Pictures at one resolution, as they are compared with each of several objects."""

    objects: list[PhotoLevel]

    @property
    def last(self) -> bool:
        return self.objects[0].last

    @property
    def size(self) -> tuple[int, int]:
        return self.objects[0].size

    def parts(self) -> list[slice]:
        """Return the entries of a step that each object has."""
        found, first = [], 0
        for level in self.objects:
            found.append(slice(first, first := first + len(level.pyramid_level.dofs)))
        return found

    def comparisons(self, poses: Sequence[Pose], seed: int) -> list[list[PictureComparison]]:
        """Return the comparisons of each object with each picture; tangents (D, h, w) are by the entries of all."""
        scenes = [
            level.task.scene.transformed(pose.R, pose.t, pose.scale)
            for level, pose in zip(self.objects, poses, strict=True)
        ]
        labelled = _labelled(scenes)
        counts = [sum(len(mesh.verts) for mesh in scene.meshes) for scene in scenes]
        found: list[list[PictureComparison]] = [[] for _ in scenes]
        first = self.objects[0]
        for n, shot in enumerate(first.pyramid_level.shots):
            pairs = [*zip(self.objects, poses, strict=True)]
            motions = [
                level.task.motion(level.pyramid_level, level.pyramid_level.shots[n], pose) for level, pose in pairs
            ]
            rendered = Rendered(labelled, shot.camera, ["image"], first.pyramid_level.spp, seed)
            alphas = rendered.images["image"].float().movedim(-1, 0)
            tangents = rendered.derivatives(Motions(motions, counts))["image"].float().movedim(-1, 1)
            for k, level in enumerate(self.objects):
                seen = scenes[k], shot.camera, motions[k], level.pictures[n], alphas[k], tangents[:, k]
                found[k].append(level.comparison(*seen, seed, others=True))
        return found

    def equations(self, poses: Sequence[Pose], seed: int) -> tuple[NormalEquations, float]:
        """Return the equations of all terms and pictures by the entries of all objects, and the mean loss of the region
        term."""
        views, parts = self.comparisons(poses, seed), self.parts()
        D = parts[-1].stop
        curvature, gradient = torch.zeros(D, D, dtype=torch.float64), torch.zeros(D, dtype=torch.float64)
        losses = []
        for n in range(len(views[0])):
            seen = [view[n] for view in views]
            if all(one.extent == 0.0 for one in seen):
                continue
            alphas, near = torch.stack([one.alpha for one in seen]), torch.stack([one.near for one in seen]).amax(0)
            tangents = torch.stack([one.tangents for one in seen], 1)
            region, loss = regions_term(self._posteriors(n, seen, near), alphas, tangents, near, self.objects[0].blur)
            losses.append(loss)
            terms: list[tuple[slice, NormalEquations | None]] = [(slice(0, D), region)]
            for part, level, one in zip(parts, self.objects, seen, strict=True):
                if one.lit is not None:
                    terms.append((part, one.lit.term()))
                if one.surface is not None and one.part.depth is not None:
                    size = level.task.size
                    terms.append((part, depth_term(one.surface, one.part.depth, one.part.weight, size)))
            if self.last:
                terms += [(slice(0, D), term) for term in self._contours(seen)]
            for part, term in terms:
                if term is not None:
                    curvature[part, part] += term.curvature
                    gradient[part] += term.gradient
        return NormalEquations(curvature, gradient), sum(losses) / len(losses) if losses else math.inf

    def focused(self, poses: Sequence[Pose], seed: int) -> JointLevel:
        """Return the level with one blur for the contours of all objects, as of PhotoLevel.focused()."""
        views = self.comparisons(poses, seed)
        blur = sharpest([one for view in views for one in view])
        return JointLevel([replace(level, blur_of_contours=blur) for level in self.objects])

    def edge_support(self, poses: Sequence[Pose], seed: int) -> list[float]:
        """Return PhotoLevel.edge_support() of each object where it is seen."""
        views = self.comparisons(poses, seed)
        return [
            level.edge_support(pose, seed, view) for level, pose, view in zip(self.objects, poses, views, strict=True)
        ]

    def visible(self, poses: Sequence[Pose], seed: int) -> list[float]:
        """Return, for each object, the share, 0 … 1, of its own pixels that the others do not hide."""
        views = self.comparisons(poses, seed)
        found = []
        for level, pose, view in zip(self.objects, poses, views, strict=True):
            alone = level.covered(pose, seed)
            found.append(min(1.0, sum(float(one.alpha.sum()) for one in view) / alone) if alone > 0.0 else 0.0)
        return found

    def unoccluded(self, poses: Sequence[Pose], seed: int) -> JointLevel:
        """Return the level without what covers the objects and is none of them."""
        weights = [torch.ones(picture.size, dtype=torch.float32) for picture in self.objects[0].pictures]
        for view in self.comparisons(poses, seed):
            if (own := occluder_weights(view)) is not None:
                weights = [torch.minimum(a, b) for a, b in zip(weights, own, strict=True)]
        return JointLevel([weighted(level, weights) for level in self.objects])

    def _posteriors(self, n: int, seen: list[PictureComparison], near: Tensor) -> Tensor:
        """Return the posteriors (N + 1, h, w) of picture n: by the masks, or else by colours."""
        masks = [one.picture.mask for one in seen if one.picture.mask is not None]
        if masks:
            shares = torch.stack(masks)
            likely = torch.cat([shares, 1.0 - shares.sum(0, keepdim=True)]).clamp(min=MASK_ERROR)
            return likely / likely.sum(0)
        extents = [one.extent for one in seen if one.extent > 0.0]
        middle = math.exp(sum(map(math.log, extents)) / len(extents))
        first = self.objects[0]
        windows = [
            Windows(first.pictures[n].size, first.labels[n], first.palettes[n].colors, RADIUS * (extent or middle))
            for extent in (*(one.extent for one in seen), middle)
        ]
        return posteriors(windows, torch.stack([one.alpha for one in seen]), near)

    def _contours(self, seen: list[PictureComparison]) -> list[NormalEquations | None]:
        """Return the contour term of each object. Where two of them meet, each has half the weight."""
        blur = self.objects[0].blur_of_contours
        sides = [one.sides(blur) for one in seen]
        count = torch.zeros(seen[0].picture.size, dtype=torch.float32)
        for one, side in zip(seen, sides, strict=True):
            count[one.box] += side.band
        return [
            contour_term(
                replace(one.part, weight=one.part.weight / count[one.box].clamp(min=1.0)), side,
                smoothed(one.tangents[:, one.box[0], one.box[1]], blur),
            )
            for one, side in zip(seen, sides, strict=True)
        ]  # fmt: skip


def without_fronts(tasks: Sequence[PoseTask], poses: Sequence[Pose], k: int, spp: int, seed: int) -> PoseTask:
    """Return the task of one object, with a weight of 0 where others that cover a part of it are seen, with a margin."""
    moved = [task.scene.transformed(pose.R, pose.t, pose.scale) for task, pose in zip(tasks, poses, strict=True)]
    shots = []
    for shot in tasks[k].shots:
        with torch.no_grad():
            seen = render(_labelled(moved), shot.camera, spp, seed)
            alone = render_aovs(without_colors(moved[k]), shot.camera, ["alpha"], spp, seed)["alpha"][..., 0]
        hidden = alone - seen[..., k] > 0.5
        fronts = [j for j in range(len(moved)) if j != k and float(seen[hidden][:, j].sum()) > 1.0]
        before = seen[..., fronts].sum(-1)[None, None]
        before = F.max_pool2d(before, 2 * OCCLUDER_MARGIN + 1, 1, OCCLUDER_MARGIN)[0, 0, ..., None].float()
        weight = 1.0 - before if shot.weight is None else shot.weight * (1.0 - before)
        shots.append(shot._replace(weight=weight.clamp(min=0.0)))
    return replace(tasks[k], shots=shots)


def _labelled(scenes: Sequence[Scene]) -> Scene:
    """Return all objects in one scene, each with a channel of its own, which is 1 on it."""
    labels = torch.eye(len(scenes), dtype=torch.float64)
    return Scene([
        Mesh(mesh.verts, mesh.faces, colors=label.expand(len(mesh.verts), -1))
        for scene, label in zip(scenes, labels, strict=True) for mesh in scene.meshes
    ])  # fmt: skip


def joint_levels(
    tasks: Sequence[PoseTask], poses: Sequence[Pose], depths: Sequence[Tensor | None], settings: Settings
) -> list[JointLevel]:
    """Return the levels from coarse to fine, of what surrounds the objects."""
    crops = [Crop.around(tasks[0], shot, poses[0]) for shot in tasks[0].shots]
    for task, pose in zip(tasks[1:], poses[1:], strict=True):
        own = [Crop.around(task, shot, pose) for shot in task.shots]
        crops = [crop.joined(other) for crop, other in zip(crops, own, strict=True)]
    columns = [photo_levels(task, pose, depths, settings, crops=crops) for task, pose in zip(tasks, poses, strict=True)]
    return [JointLevel(list(objects)) for objects in zip(*columns, strict=True)]
