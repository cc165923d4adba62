"""The blur of pictures: the Gaussian by which renders match them best.

Lens, focus, motion, demosaicing and compression remove fine detail. A sharp render differs from a blurred picture at all edges,
wherever the object lies, and the fit would end a fraction of a pixel off.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .robust_loss import Comparison
from .target_images import blurred
from .task import PoseTask, PyramidLevel

CANDIDATE_BLURS = (0.0, 0.5, 0.7, 1.0, 1.4)  # pixels
OUTLIER_WIDTH = (
    0.1  # Width c of the loss, relative to the pictures' range: larger differences belong to something else.
)


def estimate_blur(task: PoseTask, level: PyramidLevel, renders: list[Tensor], again: list[Tensor]) -> float:
    """Return the blur in pixels, at most the last of CANDIDATE_BLURS, from unblurred layers (h, w, n) of renders with two
    seeds. The loss multiplies the differences of both renders to the picture: the mean of these products has no sample noise,
    which a blur would lower."""
    losses = []
    for sigma in CANDIDATE_BLURS:
        both = [Comparison(task, level, [blurred(layer, sigma) for layer in layers]) for layers in (renders, again)]
        total = 0.0
        for shot, a, b in zip(level.shots, *(one.differences for one in both), strict=True):
            square = (0.5 * (a + b)).square().sum(-1, keepdim=True) / (OUTLIER_WIDTH * task.extent) ** 2
            # This is Σ ρ(r) with the product in place of r² where r is small.
            product = (a * b).sum(-1, keepdim=True) / (1.0 + square)
            total += float((product if shot.weight is None else shot.weight * product).sum())
        losses.append(total)
    best = min(range(len(CANDIDATE_BLURS)), key=losses.__getitem__)
    if best in (0, len(CANDIDATE_BLURS) - 1):
        return CANDIDATE_BLURS[best]
    # The loss is nearly a parabola in σ².
    x = torch.tensor([CANDIDATE_BLURS[best + k] ** 2 for k in (-1, 0, 1)], dtype=torch.float64)
    a, b, _ = torch.linalg.solve(torch.linalg.vander(x), torch.tensor(losses[best - 1 : best + 2]).double()).flip(0)
    return float((-b / (2.0 * a)).clamp(x[0], x[2]).sqrt())
