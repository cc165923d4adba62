"""Which limbs the pictures show: whether there are edges in them where the fit has those of each joint.

A hand in a wrong place hardly changes how much of a whole body is explained. Each joint is judged by the pixels that change as it
turns, so that the last one of a limb is judged by itself. A limb that hides where it should not has no edges of its own: what of
the masks is left out tells of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from ..descent.curvature import derivatives
from ..descent.objective import Objective
from ..edge_support import edge_amount, edge_support
from ..views import Observation

MOVED = 0.05  # of the largest derivative by a joint: pixels that it moves
BESIDE = 2  # pixels around these
FEWEST = 8.0  # pixels of edges in all views: of less nothing is said
SPP = 32
STEPS = 2**22, 2**23  # that no fit comes to: their samples are those of no loss that was made small


def explained_by_joint(
    objective: Objective, tensors: Mapping[str, Tensor], joints: Mapping[str, Sequence[str]]
) -> dict[str, float]:
    """Of each joint that the pictures can show, the share of its edges that they do, 0 … 1. `joints` of the values that are turns
    of joints, their names. By regions these are renewed first."""
    every = list(range(len(objective.views)))
    with torch.no_grad():
        scene, cameras = objective.build(tensors)
        first, second = (
            _by_view(objective.renders(scene, cameras, every, SPP, objective.seed(step))) for step in STEPS
        )
    moved: dict[str, dict[tuple[str, int], Tensor]] = {}
    for name, group, _, slopes in derivatives(objective, tensors, STEPS[0]):
        for i, J in zip(group, slopes, strict=True):
            for joint, place in places_of(tensors, joints).items():
                moved.setdefault(joint, {})[name, i] = J[place].abs().sum((0, 3))
    found = {}
    for joint, sizes in moved.items():
        areas = _areas(sizes)
        pairs = []
        for (name, i), area in areas.items():
            view, one, other = objective.views[i], first[name, i], second[name, i]
            # Of regions, whose pictures have other colours, the contour alone, to tell how long it is.
            picture = view.wanted.get(name, one)
            pairs.append((one, other, picture, area if view.weight is None else area * view.weight))
        if edge_amount(pairs) < FEWEST:
            continue
        if objective.regions is None:
            found[joint] = edge_support(pairs)
        else:
            alphas = [0.5 * (first["alpha", i] + second["alpha", i]) for i in every]
            found[joint] = objective.regions.edge_support(alphas, [areas["alpha", i][..., 0] for i in every])
    return found


def places_of(tensors: Mapping[str, Tensor], joints: Mapping[str, Sequence[str]]) -> dict[str, slice]:
    """Of each joint, among all numbers of the tensors one after the other."""
    found, at = {}, 0
    for name, value in tensors.items():
        rows = joints.get(name, ())
        width = value.numel() // max(len(rows), 1)
        found |= {row: slice(at + k * width, at + (k + 1) * width) for k, row in enumerate(rows)}
        at += value.numel()
    return found


def _by_view(groups: Iterable[tuple[list[int], dict[str, Tensor]]]) -> dict[tuple[str, int], Tensor]:
    """Channels (H, W, c), by name and the view's place."""
    found = {}
    for group, channels in groups:
        for name, images in channels.items():
            found |= {(name, i): image for i, image in zip(group, images, strict=True)}
    return found


def _areas(moved: Mapping[tuple[str, int], Tensor]) -> dict[tuple[str, int], Tensor]:
    """Of each picture (H, W, 1), 1 where it is moved, or near that."""
    most = max(float(size.max()) for size in moved.values())
    wide = 2 * BESIDE + 1
    return {
        key: F.max_pool2d((size > MOVED * most).float()[None], wide, 1, BESIDE)[0][..., None]
        for key, size in moved.items()
    }


def left_out(views: Sequence[Observation], renders: Sequence[Tensor]) -> float:
    """The largest share, over all views with a mask, of what it shows that lies in a region where the fit covers nothing, or that
    the fit covers beside it; of regions three pixels wide or more. `renders` are the fit's alphas (H, W, 1)."""
    most = 0.0
    for view, alpha in zip(views, renders, strict=True):
        if view.mask is None:
            continue
        known = 1.0 if view.weight is None else (view.weight > 0.0).float()
        off = (view.mask - alpha) * known
        for side in (off, -off):
            wrong = (side > 0.5).float().movedim(-1, 0)[None]
            wide = -F.max_pool2d(-F.pad(wrong, (1, 1, 1, 1)), 3, 1)  # what an erosion leaves
            inside = F.max_pool2d(wide, 3, 1, 1)
            most = max(most, float(inside.sum()) / max(float(view.mask.sum()), 1.0))
    return most
