"""Edge support of each joint: whether the pictures have edges where the fit has those of the joint.

A hand in a wrong place hardly changes the edge support of a whole body. Each joint is judged by the pixels that change as it
rotates, so that the last one of a limb is judged by itself. A limb that hides wrongly has no edges of its own; uncovered
regions of the masks show it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch.nn.functional as F
from torch import Tensor

from ..descent.curvature import derivatives
from ..descent.objective import Objective
from ..edge_support import edge_amount, edge_support
from ..views import Observation
from .settings import RIG

SUPPORT_STEPS = 2**22, 2**23  # No fit takes so many steps, so these samples are of no minimised loss.


def edge_support_by_joint(
    objective: Objective, tensors: Mapping[str, Tensor], joints: Mapping[str, Sequence[str]]
) -> dict[str, float]:
    """Return the share, 0 … 1, of its edges that the pictures show, for each joint that they can show. `joints` has the names
    of joints by the values that are their rotations. A loss by regions must be renewed first."""
    first, second = (objective.images(tensors, RIG.support_spp, step) for step in SUPPORT_STEPS)
    moved: dict[str, dict[tuple[str, int], Tensor]] = {}
    for name, group, _, slopes in derivatives(objective, tensors, SUPPORT_STEPS[0]):
        for i, J in zip(group, slopes, strict=True):
            for joint, place in places_of(tensors, joints).items():
                moved.setdefault(joint, {})[name, i] = J[place].abs().sum((0, 3))
    found = {}
    for joint, sizes in moved.items():
        areas, pairs = _areas(sizes), []
        for (name, i), area in areas.items():
            view, one, other = objective.views[i], first[i][name], second[i][name]
            # Pictures of regions have other colours; the contour alone gives its length.
            picture = view.wanted.get(name, one)
            pairs.append((one, other, picture, area if view.weight is None else area * view.weight))
        if edge_amount(pairs) < RIG.least_edges:
            continue
        if objective.regions is None:
            found[joint] = edge_support(pairs)
        else:
            alphas = [0.5 * (one["alpha"] + other["alpha"]) for one, other in zip(first, second, strict=True)]
            found[joint] = objective.regions.edge_support(
                alphas, [areas["alpha", i][..., 0] for i in range(len(first))]
            )
    return found


def places_of(tensors: Mapping[str, Tensor], joints: Mapping[str, Sequence[str]]) -> dict[str, slice]:
    """Return the place of each joint among all numbers of the tensors one after the other."""
    found, at = {}, 0
    for name, value in tensors.items():
        rows = joints.get(name, ())
        width = value.numel() // max(len(rows), 1)
        found |= {row: slice(at + k * width, at + (k + 1) * width) for k, row in enumerate(rows)}
        at += value.numel()
    return found


def _areas(moved: Mapping[tuple[str, int], Tensor]) -> dict[tuple[str, int], Tensor]:
    """Return for each picture (H, W, 1) 1 where it is moved, or near that, and 0 elsewhere."""
    most = max(float(size.max()) for size in moved.values())
    wide = 2 * RIG.joint_margin + 1
    return {
        key: F.max_pool2d((size > RIG.moved_share * most).float()[None], wide, 1, RIG.joint_margin)[0][..., None]
        for key, size in moved.items()
    }


def left_out(views: Sequence[Observation], renders: Sequence[Tensor]) -> float:
    """Return the largest share over all masks that lies in regions which the fit does not cover, or covers wrongly. Regions
    are three pixels wide or more. `renders` are the fit's alphas (H, W, 1)."""
    most = 0.0
    for view, alpha in zip(views, renders, strict=True):
        if view.mask is None:
            continue
        known = 1.0 if view.weight is None else (view.weight > 0.0).float()
        off = (view.mask - alpha) * known
        for side in (off, -off):
            wrong = (side > 0.5).float().movedim(-1, 0)[None]
            wide = -F.max_pool2d(-F.pad(wrong, (1, 1, 1, 1)), 3, 1)  # This is an erosion.
            inside = F.max_pool2d(wide, 3, 1, 1)
            most = max(most, float(inside.sum()) / max(float(view.mask.sum()), 1.0))
    return most
