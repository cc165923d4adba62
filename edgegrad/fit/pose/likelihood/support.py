"""Evidence for a pose in photographs: above all the share of the render's edges that they show, of contours and inside."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ....files.image import linear_to_srgb
from ...contour_colors import ALONE_INFORMATION, ALONE_SHOWN, COLOUR_WINDOW, CONTRAST, PURE
from ...edge_support import edge_support
from ...placement import Pose
from ...region import information, smoothed_within
from ..settings import POSE
from ..task import PoseTask
from .contour import ContourNoise, Sides
from .objective import Comparison, PoseLevel

RESOLVED = 40.0  # Pixels across the object: before unknown things, light and colours fitted to fewer match any picture.
MIN_SHOWN_CONTOUR = 0.5  # Edge support is reduced if less of the contour shows.
FULLY_VISIBLE = 0.65  # Of an object that is hidden more, what is left matches something by chance.


def enough_support(task: PoseTask) -> float:
    """Return the least edge support of a right pose."""
    return POSE.plain_support if task.colorless else POSE.photo_support


class Evidence(NamedTuple):
    """The evidence for a pose in pictures."""

    edges: float  # share, 0 … 1, of the render's edges that the pictures show, without what covers the object
    visible: float  # share of the object that nothing seems to cover
    nats: float  # log likelihood ratio to pictures without the object, of a pixel of it
    across: float  # pixels across the object, in the picture that shows it largest


def evidence_of(level: PoseLevel, pose: Pose) -> Evidence:
    """Return what speaks for a pose in the pictures of a level."""
    compared = replace(level, dofs=()).comparisons([pose])
    total = max(sum(float(one.seen.alpha.sum()) for one in compared), 1e-30)
    visible = sum(float((one.seen.alpha * one.visible).sum()) for one in compared) / total
    nats = -sum(float(one.term.cost) for one in compared) / total
    extent = max(picture.extent for picture in level.pictures)
    known = _before_known(compared)
    resolved = known + (1.0 - known) * min(1.0, extent / RESOLVED)
    edges = _share(compared, resolved, level.harmonics > 0, False)
    if edges < 1.0 and visible >= FULLY_VISIBLE:
        edges = max(edges, _share(compared, resolved, level.harmonics > 0, True))
    return Evidence(edges, visible, nats, extent)


def _before_known(compared: list[Comparison]) -> float:
    """Return the share of the pixels around the object that a mask is known of, or that show the background as it is known."""
    shown = around = 0.0
    for part, alpha in ((one.part, one.seen.alpha[0]) for one in compared):
        count = part.weight * (alpha < PURE)
        around += float(count.sum())
        if part.mask is None:
            off = math.inf if part.background is None else (part.display - part.background).abs().amax(0)
            count = count * (off < CONTRAST * POSE.first_contour[1])
        shown += float(count.sum())
    return shown / max(around, 1e-30)


def _share(compared: list[Comparison], resolved: float, colored: bool, uncovered: bool) -> float:
    pairs: list[tuple[Tensor, Tensor, Tensor, Tensor | None]] = []
    contour, bits, pixels = torch.zeros(2), 0.0, 0.0
    for one in compared:
        part, seen = one.part, one.seen
        visible, every = one.visible if uncovered else torch.ones_like(one.visible), seen.box.cut(one.colors.every)
        sides = Sides.from_picture(part, seen, visible, None, every, ContourNoise(), COLOUR_WINDOW)
        weight = (part.weight * visible)[0]
        contour = contour + contour_length(sides, part.weight * visible)
        if not colored:
            soft = smoothed_within(seen.alpha, COLOUR_WINDOW)
            ring = ((soft > PURE) & (soft < 1.0 - PURE)) * part.weight
            inside, outside = seen.box.cut(one.colors.inside), seen.box.cut(one.colors.outside)
            bits += float((ring * information(inside / (inside + outside), seen.alpha)).sum())
            pixels += float(ring.sum())
        mixed, band = sides.mixed[0], sides.band[0]
        if one.light is None or part.mask is not None:
            pairs.append(compared_images(mixed, part.outlined, band))
        if one.light is not None:
            inner = one.light.inside[0]
            expected = linear_to_srgb(one.light.predicted[0].clamp(0.0, 1.0))
            covered = torch.where(inner, weight, 0.0)
            if part.mask is None:
                expected, covered = torch.where(inner, expected, mixed), torch.where(inner, weight, band)
            pairs.append(compared_images(expected, part.display, covered))
    length, shown = contour.tolist()
    if length == 0.0:
        return 0.0
    share = edge_support(pairs, softer=True) * resolved
    if colored:
        return share * min(1.0, shown / length / MIN_SHOWN_CONTOUR)
    # Off the object, both sides of a contour have similar colours, however strong the edges that it follows.
    sure = max(0.0, min(1.0, bits / max(pixels, 1e-30) / ALONE_INFORMATION))
    return share * min(1.0, shown / length / ALONE_SHOWN) * sure


def contour_length(sides: Sides, near: Tensor) -> Tensor:
    """Return the pixels (2,) along contours, weighted by `near` (N, h, w), and those of them whose two sides differ visibly."""
    on = ((sides.alpha > PURE) & (sides.alpha < 1.0 - PURE)) * near
    return torch.stack([on.sum(), (on * (sides.contrast > CONTRAST) * (sides.band > 0.0)).sum()])


def compared_images(expected: Tensor, picture: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """Return what edge_support() compares, of images (C, h, w) and weights (h, w)."""
    first = expected.movedim(0, -1)
    return first, first, picture.movedim(0, -1), weight[..., None]
