"""Template matching: where in a picture an object might be, and how it is rotated.

Views of it from all sides are compared with the picture everywhere at low resolution. The best matches are rotated, moved and
resized by ever smaller amounts at higher resolution, and ever fewer of them are kept (a beam search).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ....files.image import linear_to_srgb
from ...placement import Pose
from ...views import area_mean
from ..settings import TEMPLATES, Round
from ..task import PoseTask, scaled
from .template_views import TemplateViews, across, all_sides, pose_at, rotations
from .templates import Templates, surprise


class Matches(NamedTuple):
    """Views at places of a picture."""

    rotations: Tensor  # (n, 3, 3) float64, as TemplateViews have them
    positions: Tensor  # (n, 2) float64 of the object's centre, pixels of the picture
    pixels: Tensor  # (n,) float64 of the picture, across the object
    scores: Tensor  # (n,)

    def select(self, rows: Tensor) -> Matches:
        return Matches(*(field[rows] for field in self))

    def turned(self, turns: Tensor) -> Matches:
        """Rotate each match by all rotations (k, 3, 3), without comparing."""
        k = len(turns)
        positions, pixels = (x.repeat_interleave(k, 0) for x in (self.positions, self.pixels))
        rotations = (turns @ self.rotations[:, None]).flatten(0, 1)
        return Matches(rotations, positions, pixels, torch.full((len(rotations),), -math.inf, dtype=torch.float32))

    def distinct(self, most: int, turned: float, spacing: float, sized: float) -> Matches:
        """Return the best matches, the best first, that differ from one another. Of two whose angle is below `turned` radians,
        whose distance is below `spacing` of their size, and whose sizes differ by less than the factor `sized`, the better one
        is kept."""
        ranked = self.select(self.scores.argsort(descending=True, stable=True)[: TEMPLATES.most_ranked])
        flat = ranked.rotations.flatten(1)
        cosine = 0.5 * (flat @ flat.T - 1.0)
        larger = torch.maximum(ranked.pixels[:, None], ranked.pixels)
        same = cosine > math.cos(turned)
        same &= torch.cdist(ranked.positions, ranked.positions) < spacing * larger
        same &= larger < sized * torch.minimum(ranked.pixels[:, None], ranked.pixels)
        kept: list[int] = []
        free = torch.ones(len(flat), dtype=torch.bool)
        while len(kept) < most and bool(free.any()):
            first = int(free.int().argmax())
            kept.append(first)
            free &= ~same[first]
            free[first] = False
        return ranked.select(torch.tensor(kept, dtype=torch.long))

    def poses(self, task: PoseTask) -> list[Pose]:
        camera = task.shots[0].camera
        found = []
        for R, position, pixels in zip(self.rotations, self.positions, self.pixels.tolist(), strict=True):
            depth = 2.0 * task.size if camera.projection == "orthographic" else across(task, camera, 1.0) / pixels
            found.append(pose_at(task, R, position, depth))
        return found


class Mips:
    """The first picture at many sizes, from which matches take crops. The last channel is surprise(), or the mask."""

    def __init__(self, task: PoseTask, finest: int) -> None:
        """`finest` is the number of pixels across the smallest object."""
        shot = task.shots[0]
        self.masked = "alpha" in task.aovs and not task.clutter
        target = shot.target.float()
        mask = target[..., -1:].clamp(0.0, 1.0) if self.masked else None
        radiance = (target if mask is None else target[..., :-1]).clamp(0.0, 1.0)
        colors = linear_to_srgb(radiance if mask is None else radiance * (mask > 0.0))
        self.picture = colors if mask is None else torch.cat([colors, mask], -1)
        self.size = shot.camera.size
        self.factor = 1.0 if self.masked else min(1.0, finest / (TEMPLATES.smallest * min(self.size)))
        self._levels: dict[int, Tensor] = {}

    def reduced(self, factor: float) -> Tensor:
        """Return the picture (C + 1, h, w) at another size."""
        picture = area_mean(self.picture, scaled(self.size, factor)).movedim(-1, 0)
        return picture if self.masked else torch.cat([picture, surprise(picture)[None]])

    def crops(self, positions: Tensor, pixels: Tensor, across: int, side: int) -> Tensor:
        """Return crops (n, C + 1, side, side) around positions (n, 2), `across` of whose pixels are as long as so many (n,)
        of the picture."""
        # Means of four samples have the blur of pixels, which differences of neighbours depend on.
        wanted = (
            ((self.factor * pixels / (2 * across)).log() / math.log(TEMPLATES.mip_ratio)).round().clamp(min=0).long()
        )
        steps = 0.5 * (torch.arange(2 * side, dtype=torch.float64) + 0.5 - side)
        H, W = self.size
        found = None
        for level in wanted.unique().tolist():
            rows = (wanted == level).nonzero()[:, 0]
            if level not in self._levels:
                self._levels[level] = self.reduced(self.factor * TEMPLATES.mip_ratio**-level)
            image = self._levels[level]
            offsets = (pixels[rows] / across)[:, None] * steps
            x = 2.0 * (positions[rows, :1] + offsets) / W - 1.0
            y = 2.0 * (positions[rows, 1:] + offsets) / H - 1.0
            at = torch.stack(torch.broadcast_tensors(x[:, None, :], y[:, :, None]), -1).float()
            padding = "zeros" if self.masked else "border"
            seen = F.grid_sample(
                image[None].expand(len(rows), -1, -1, -1), at, align_corners=False, padding_mode=padding
            )
            if found is None:
                found = seen.new_empty(len(positions), seen.shape[1], side, side)
            found[rows] = F.avg_pool2d(seen, 2)
        return torch.empty(0, dtype=torch.float32) if found is None else found


def matches(task: PoseTask, seed: int, report: Callable[[str], object]) -> list[Pose]:
    """Return the best poses in the first picture, distinct, the best first. The mask, where there is one, shows where they
    are. `report` is called with what is done next."""
    mips = Mips(task, 2 * max(one.across for one in TEMPLATES.beam_rounds))
    report("views from all sides")
    views = TemplateViews.from_rotations(task, all_sides(), TEMPLATES.view_pixels, seed)
    fewer = TEMPLATES.fewer_with_mask if mips.masked else 1
    found = _in_mask(views, mips) if mips.masked else _everywhere(views, mips)
    found = found.distinct(TEMPLATES.coarse // fewer, *TEMPLATES.distinct)
    for k, one in enumerate(TEMPLATES.beam_rounds):
        if len(found.scores):
            report(f"views nearby, {k + 1} of {len(TEMPLATES.beam_rounds)}")
            found = closer(task, found, mips, one, seed).distinct(one.kept // fewer, *TEMPLATES.distinct)
    return found.poses(task)


def places(task: PoseTask, views: TemplateViews, sizes: tuple[float, float]) -> list[Pose]:
    """Return the best places of some views in the first picture, distinct, the best first. The object's diagonal is between
    two `sizes`, relative to the picture's shorter side."""
    found = _everywhere(views, Mips(task, views.across), sizes)
    return found.distinct(TEMPLATES.places, *TEMPLATES.distinct).poses(task)


def _everywhere(
    views: TemplateViews, mips: Mips, sizes: tuple[float, float] = (TEMPLATES.smallest, TEMPLATES.largest)
) -> Matches:
    (H, W), T, templates = mips.size, views.alpha.shape[-1], Templates(views)
    margin = T // 3
    found = [
        Matches(torch.empty(0, 3, 3).double(), torch.empty(0, 2).double(), torch.empty(0).double(), torch.empty(0))
    ]
    for k in range(1 + math.floor(math.log(sizes[1] / sizes[0]) / math.log(TEMPLATES.size_ratio))):
        pixels = sizes[0] * TEMPLATES.size_ratio**k * min(H, W)  # across the object, in the picture
        picture = mips.reduced(min(1.0, views.across / pixels))
        h, w = picture.shape[1:]
        if min(h, w) + 2 * margin < T:
            continue
        padded = F.pad(picture[None], (margin,) * 4, mode="replicate")
        # These are log likelihood ratios: larger objects have more pixels, and these correlate.
        scores = templates.scores(padded, TEMPLATES.stride) * pixels
        columns = scores.shape[-1]
        best, at = scores.flatten(1).topk(min(TEMPLATES.places_per_view, scores[0].numel()))
        middle = torch.stack([at % columns, at // columns], -1).double() * TEMPLATES.stride + 0.5 * T - margin
        positions = (middle * torch.tensor([W / w, H / h], dtype=torch.float64)).flatten(0, 1)
        rotations = views.rotations.repeat_interleave(best.shape[1], 0)
        extents = torch.full((best.numel(),), pixels, dtype=torch.float64)
        found.append(Matches(rotations, positions, extents, best.flatten()))
    return Matches(*(torch.cat(fields) for fields in zip(*found, strict=True)))


def _in_mask(views: TemplateViews, mips: Mips) -> Matches:
    """Match each view to the middle of the mask, at equal areas."""
    mask = mips.picture[..., -1]
    mass = mask.sum()
    rows, columns = (torch.arange(n, dtype=torch.float32) + 0.5 for n in mips.size)
    middle = torch.stack([(mask.sum(0) * columns).sum(), (mask.sum(1) * rows).sum()]) / mass.clamp(min=1e-3)
    T = views.alpha.shape[-1]
    area = views.alpha.sum((1, 2)).clamp(min=1.0)
    grid = torch.arange(T, dtype=torch.float32) + 0.5
    offset = torch.stack([(views.alpha.sum(1) * grid).sum(1), (views.alpha.sum(2) * grid).sum(1)], -1) / area[:, None]
    ratio = (mass.clamp(min=1e-3) / area).sqrt()  # pixels of the picture in one of the view
    positions = (middle + (0.5 * T - offset) * ratio[:, None]).double()
    pixels = views.across * ratio.double()
    scores = Templates(views).scores(mips.crops(positions, pixels, views.across, T), masked=True)[:, 0, 0]
    return Matches(views.rotations, positions, pixels, scores)


def closer(task: PoseTask, found: Matches, mips: Mips, one: Round, seed: int) -> Matches:
    """Move each match to the best of the poses around it."""
    axes = one.turn * torch.eye(3, dtype=torch.float64)
    turns = rotations(torch.cat([torch.zeros_like(axes[:1]), axes, -axes]))
    n, k = len(found.scores), len(turns)
    best = fitted(task, found.turned(turns), mips, one, seed)
    return best.select(torch.arange(n) * k + best.scores.reshape(n, k).argmax(1))


def fitted(task: PoseTask, given: Matches, mips: Mips, one: Round, seed: int) -> Matches:
    """Move each match to the best of the places and sizes around it, with its rotation."""
    views = TemplateViews.from_rotations(task, given.rotations, one.across, seed)
    templates, T = Templates(views), views.alpha.shape[-1]
    best = given
    for factor in (1.0 - one.grow, 1.0, 1.0 + one.grow):
        pixels = factor * given.pixels
        crops = mips.crops(given.positions, pixels, one.across, T + 2 * TEMPLATES.shift_pixels)
        scores = templates.scores(crops, masked=mips.masked)
        values, places = scores.flatten(1).max(1)
        if not mips.masked:
            values = values * pixels.float()
        side = 2 * TEMPLATES.shift_pixels + 1
        shift = torch.stack([places % side, places // side], -1) - TEMPLATES.shift_pixels
        moved = given.positions + shift * (pixels / one.across)[:, None]
        up = values > best.scores
        best = Matches(
            best.rotations, torch.where(up[:, None], moved, best.positions), torch.where(up, pixels, best.pixels),
            torch.where(up, values, best.scores),
        )  # fmt: skip
    return best
