"""How soft pictures are: the Gaussian blur that makes renders most like them.

Renders are sharp, and photographs are not: lens, focus, motion, demosaicing and the file's compression all take away what is
finest. A sharp render beside a soft picture differs at all edges, wherever the object lies, and the fit ends a part of a pixel
beside it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .robust import Comparison
from .task import Level, PoseTask, blurred

BLURS = (0.0, 0.5, 0.7, 1.0, 1.4)  # pixels, that are tried
ALIKE = 0.1  # c, as a part of the pictures' range: what differs by more than that is of something else


def softness(task: PoseTask, level: Level, renders: list[Tensor], again: list[Tensor]) -> float:
    """Pixels, at most the last of BLURS, from the layers of renders (h, w, n) of two seeds at one pose, not blurred.

    The products of both's differences to the picture have no noise of samples in their mean, which a blur would lower.
    """
    losses = []
    for sigma in BLURS:
        both = [Comparison(task, level, [blurred(layer, sigma) for layer in layers]) for layers in (renders, again)]
        total = 0.0
        for shot, a, b in zip(level.shots, *(one.differences for one in both), strict=True):
            square = (0.5 * (a + b)).square().sum(-1, keepdim=True) / (ALIKE * task.extent) ** 2
            # Σ ρ(r), with the product in the place of r² where r is small.
            product = (a * b).sum(-1, keepdim=True) / (1.0 + square)
            total += float((product if shot.weight is None else shot.weight * product).sum())
        losses.append(total)
    best = min(range(len(BLURS)), key=losses.__getitem__)
    if best in (0, len(BLURS) - 1):
        return BLURS[best]
    # The loss is about a parabola of σ².
    x = torch.tensor([BLURS[best + k] ** 2 for k in (-1, 0, 1)], dtype=torch.float64)
    a, b, _ = torch.linalg.solve(torch.linalg.vander(x), torch.tensor(losses[best - 1 : best + 2]).double()).flip(0)
    return float((-b / (2.0 * a)).clamp(x[0], x[2]).sqrt())
