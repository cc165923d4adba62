"""What covers a part of the object: pixels that show neither the object nor what lies behind it.

Where the object lies about right, these are the pixels inside where the picture is not what the mesh is in the light of all
others, as the log likelihood ratio of all pixels around has it: colours that are nearly the object's tell little one by one, and
edges that are a little off are thin. Shadows that are cast on the object are left out with them. Where it lies wrong they cannot
be told from differences of the pose. A cover then counts as something at one side of the object, and parts of the picture are
left out on one side after the other: if what is left is of the object alone, the way down leads to it (Fischler and Bolles,
Random Sample Consensus, 1981, with sets that are chosen for covers instead of drawn).
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from ...region import smoothed
from .level import PhotoLevel, Seen
from .light import Lit

SIDES = 8  # from which something may cover the object
EVERYWHERE = -1  # of no side is anything left out
LEFT_OUT = 0.4  # of the object's pixels, at one side
# A pixel that is so many deviations off is not of the object, if it is one of many in a window of so many pixels.
OFF, ACROSS, MANY = 4.0, 1.5, 0.5
# In the light of one picture alone: the standard deviation of a cover's Lit.difference() and, in its deviations, of the object's,
# with heavy tails; how much a pixel tells at most, in nats; and the pixels around it that are asked with it.
FOREIGN, TAILS, MOST_TOLD, AROUND = 0.5, 1.5, 3.0, 4.0
BESIDE = 2  # pixels
SEEN_FROM = 0.05  # of a window inside the object, for which the same holds
TURNS = 3
LEAST = 0.02  # what covered pixels count
WHOLE = 0.65  # of the object's pixels: where fewer are left, less is explained


def at_one_side(alpha: Tensor, side: int, share: float = LEFT_OUT) -> Tensor:
    """(h, w), 0 on one of SIDES sides of a silhouette (h, w), for such a share of it, 1 elsewhere; all 1 for EVERYWHERE."""
    h, w = alpha.shape
    angle = 2.0 * math.pi * side / SIDES
    along = torch.arange(w) * math.cos(angle) + torch.arange(h)[:, None] * math.sin(angle)
    inside = along[alpha > 0.5]
    if side == EVERYWHERE or not len(inside):
        return torch.ones(h, w)
    return (along > inside.quantile(share)).float()


def covered(lit: Lit, light: Tensor, most: float) -> Tensor:
    """(h, w) bool, where the surface is not what it would be in a light (C, n): more than `most` off, as Lit.difference() has it,
    over more than a pixel or two."""
    inside = lit.surface.inside
    off = torch.zeros_like(inside, dtype=torch.float32)
    off[inside] = (lit.difference(light) > most).float()
    share = smoothed(torch.stack([off, inside.float()]), ACROSS)
    return (share[0] > MANY * share[1]) & (share[1] > SEEN_FROM)


def uncovered(lit: Lit) -> Tensor:
    """(h, w), LEAST where something covers the surface, and 1 elsewhere, by the light that was found."""
    inside, own = lit.surface.inside, min(TAILS * lit.deviation, FOREIGN)
    # log N(e; FOREIGN) − log N(e; own), each with the deviations of a channel; no pixel tells for all around it.
    squares = 0.5 * lit.difference(lit.coefficients).square()
    told = squares * (own**-2 - FOREIGN**-2) - len(lit.coefficients) * math.log(FOREIGN / own)
    ratio = torch.zeros_like(inside, dtype=torch.float32)
    ratio[inside] = told.clamp(-MOST_TOLD, MOST_TOLD)
    found = inside & (smoothed(ratio[None], AROUND)[0] > 0.0)
    # Along the silhouette beside it, contours of the object and of the cover are one in a blur.
    beside = F.max_pool2d(found.float()[None, None], 2 * BESIDE + 1, 1, BESIDE)[0, 0]
    return 1.0 - (1.0 - LEAST) * torch.where(inside, found.float(), beside)


def weighted(level: PhotoLevel, weights: list[Tensor]) -> PhotoLevel:
    """The level with the weights (h, w) of its pictures multiplied by others, of any size."""
    pictures = []
    for picture, weight in zip(level.pictures, weights, strict=True):
        at = F.interpolate(weight[None, None], picture.size, mode="bilinear")[0, 0]
        pictures.append(replace(picture, weight=picture.weight * at))
    return replace(level, pictures=pictures)


def covers(views: list[Seen]) -> list[Tensor] | None:
    """(h, w) of each view, what uncovered() gives, with the light of what is left, which is found by turns; None where the mesh
    has no colours, or too little is seen of them."""
    found = []
    for seen in views:
        lit, weight = seen.lit, torch.ones(seen.picture.size)
        for _ in range(TURNS):
            if lit is None:
                return None
            weight[seen.box] = uncovered(lit)
            part = replace(seen.part, weight=seen.part.weight * weight[seen.box])
            lit = Lit.of(part, lit.surface, lit.coefficients.shape[1])
        found.append(weight)
    return found


def left(views: list[Seen], weights: list[Tensor]) -> float:
    """How much of the object is left, 0 … 1."""
    total = sum(float((seen.alpha * seen.picture.weight).sum()) for seen in views)
    kept = sum(
        float((seen.alpha * seen.picture.weight * F.interpolate(w[None, None], seen.picture.size, mode="bilinear")[0, 0]).sum())
        for seen, w in zip(views, weights, strict=True)
    )  # fmt: skip
    return kept / max(total, 1e-30)
