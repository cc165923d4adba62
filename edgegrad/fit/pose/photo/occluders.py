"""Occluders: pixels that show neither the object nor what lies behind it.

Where the object lies about right, these are the pixels inside where the picture does not match the mesh in the light of all
others. A log likelihood ratio over neighbouring pixels decides, since single pixels say little about colours near the
object's, and misaligned edges are thin. Cast shadows are left out, too. Where the object lies wrong, occlusion cannot be
separated from a wrong pose. An occluder then counts as something at one side of the object, and one side after the other is
left out: if the rest is of the object alone, the refinement leads to it (Fischler and Bolles, Random Sample Consensus, 1981,
with sets chosen for occluders instead of drawn).
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from ...region import smoothed
from .level import PhotoLevel, PictureComparison
from .light import FittedLight

OCCLUDER_SIDES = 8  # sides from which something may cover the object
EVERYWHERE = -1  # the side that leaves nothing out
LEFT_OUT = 0.4  # share of the object's pixels at one side
# A pixel so many deviations off is not of the object if most pixels in a window of this many pixels are off, too.
OCCLUDED_DEVIATIONS, OCCLUSION_BLUR, OCCLUDED_MAJORITY = 4.0, 1.5, 0.5
# In the light of one picture: the standard deviation of an occluder's FittedLight.difference(); that of the object's, in its own
# deviations, for heavy tails; the largest log likelihood ratio of a pixel; and the window around it, in pixels.
FOREIGN_DEVIATION, TAIL_FACTOR, MAX_PIXEL_NATS, LIKELIHOOD_BLUR = 0.5, 1.5, 3.0, 4.0
OCCLUDER_MARGIN = 2  # pixels
SEEN_FROM = 0.05  # least share of a window that lies inside the object
LIGHT_ALTERNATIONS = 3
OCCLUDED_WEIGHT = 0.02
FULLY_VISIBLE = 0.65  # With a smaller visible share of the object, edge support is reduced.


def at_one_side(alpha: Tensor, side: int, share: float = LEFT_OUT) -> Tensor:
    """Return weights (h, w): 0 on one of OCCLUDER_SIDES sides of a silhouette (h, w), for such a share of it, and 1
    elsewhere; all 1 for EVERYWHERE."""
    h, w = alpha.shape
    angle = 2.0 * math.pi * side / OCCLUDER_SIDES
    rows, columns = (torch.arange(n, dtype=torch.float32) for n in (h, w))
    along = columns * math.cos(angle) + rows[:, None] * math.sin(angle)
    inside = along[alpha > 0.5]
    if side == EVERYWHERE or not len(inside):
        return torch.ones(h, w, dtype=torch.float32)
    return (along > inside.quantile(share)).float()


def occluded(lit: FittedLight, light: Tensor, most: float) -> Tensor:
    """Return where (h, w) the surface differs from what it is in a light (C, n) by more than `most`, over more than a pixel
    or two."""
    inside = lit.surface.inside
    off = torch.zeros_like(inside, dtype=torch.float32)
    off[inside] = (lit.difference(light) > most).float()
    share = smoothed(torch.stack([off, inside.float()]), OCCLUSION_BLUR)
    return (share[0] > OCCLUDED_MAJORITY * share[1]) & (share[1] > SEEN_FROM)


def visibility(lit: FittedLight) -> Tensor:
    """Return weights (h, w): OCCLUDED_WEIGHT where something covers the surface, by the fitted light, and 1 elsewhere."""
    inside, own = lit.surface.inside, min(TAIL_FACTOR * lit.deviation, FOREIGN_DEVIATION)
    # This is log N(e; FOREIGN_DEVIATION) − log N(e; own), by channel, clamped so that no pixel outweighs its neighbours.
    squares = 0.5 * lit.difference(lit.coefficients).square()
    evidence = squares * (own**-2 - FOREIGN_DEVIATION**-2) - len(lit.coefficients) * math.log(FOREIGN_DEVIATION / own)
    ratio = torch.zeros_like(inside, dtype=torch.float32)
    ratio[inside] = evidence.clamp(-MAX_PIXEL_NATS, MAX_PIXEL_NATS)
    found = inside & (smoothed(ratio[None], LIKELIHOOD_BLUR)[0] > 0.0)
    # Along the silhouette, a blur mixes the contours of object and occluder, so a margin counts as occluded.
    margin = F.max_pool2d(found.float()[None, None], 2 * OCCLUDER_MARGIN + 1, 1, OCCLUDER_MARGIN)[0, 0]
    return 1.0 - (1.0 - OCCLUDED_WEIGHT) * torch.where(inside, found.float(), margin)


def weighted(level: PhotoLevel, weights: list[Tensor]) -> PhotoLevel:
    """Return the level with the weights (h, w) of its pictures multiplied by others, of any size."""
    pictures = []
    for picture, weight in zip(level.pictures, weights, strict=True):
        at = F.interpolate(weight[None, None], picture.size, mode="bilinear")[0, 0]
        pictures.append(replace(picture, weight=picture.weight * at))
    return replace(level, pictures=pictures)


def occluder_weights(views: list[PictureComparison]) -> list[Tensor] | None:
    """Return the visibility() (h, w) of each view, alternating with the light of what is visible. None where the mesh has no
    colours, or too little of them is seen."""
    found = []
    for seen in views:
        lit, weight = seen.lit, torch.ones(seen.picture.size, dtype=torch.float32)
        for _ in range(LIGHT_ALTERNATIONS):
            if lit is None:
                return None
            weight[seen.box] = visibility(lit)
            part = replace(seen.part, weight=seen.part.weight * weight[seen.box])
            lit = FittedLight.from_picture(part, lit.surface, lit.coefficients.shape[1])
        found.append(weight)
    return found


def visible_share(views: list[PictureComparison], weights: list[Tensor]) -> float:
    """Return the visible share of the object, 0 … 1."""
    total = sum(float((seen.alpha * seen.picture.weight).sum()) for seen in views)
    kept = sum(
        float((seen.alpha * seen.picture.weight * F.interpolate(w[None, None], seen.picture.size, mode="bilinear")[0, 0]).sum())
        for seen, w in zip(views, weights, strict=True)
    )  # fmt: skip
    return kept / max(total, 1e-30)
