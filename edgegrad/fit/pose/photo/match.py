"""Where in a picture an object might be, and how it is turned.

Views of it from all sides are compared with the picture everywhere at low resolution, and the best matches are turned, moved and
resized by ever smaller amounts, at higher resolution, of which ever fewer are kept (a beam search).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import zip_longest

import torch
import torch.nn.functional as F
from torch import Tensor

from ....camera.poses import rotation
from ....files.image import linear_to_srgb
from ...views import area_mean
from ..pose import Pose
from ..task import PoseTask
from .cover import at_one_side
from .templates import Templates, surprise
from .views import Views, across, all_sides, pose_at

# Of the object's diagonal in the picture's shorter sides, and between two sizes.
SMALLEST, LARGEST, RATIO = 0.25, 1.25, 1.2
ACROSS = 20  # pixels, the object's diagonal in the first views
STRIDE = 2  # pixels between two places
# How much rare colours count. Pixels nearby are alike, and not drawn one by one: of an object with colours of its own all of
# them tell, of one with common colours hardly any.
RARE = (0.4, 1.0)
PLACES = 3  # of a view, at one size
RANKED = 1500  # matches at most that are compared with one another
MIP = 1.15  # between two sizes of the picture
SHIFT = 2  # pixels to all sides that a match is moved by
HIDDEN = 0.3  # of the object's pixels, at a side that is left out


@dataclass(frozen=True)
class Matches:
    """Views at places of a picture."""

    rotations: Tensor  # (n, 3, 3) float64, as Views have them
    positions: Tensor  # (n, 2) float64 of the object's centre, pixels of the picture
    pixels: Tensor  # (n,) float64 of the picture, across the object
    scores: Tensor  # (n,)
    sides: Tensor | None = None  # (n,), those that are left out, as at_one_side() counts them; None: all is compared

    def of(self, rows: Tensor) -> Matches:
        sides = None if self.sides is None else self.sides[rows]
        return Matches(self.rotations[rows], self.positions[rows], self.pixels[rows], self.scores[rows], sides)

    def turned(self, turns: Tensor) -> Matches:
        """Each of them by all rotations (k, 3, 3), not compared yet."""
        k = len(turns)
        positions, pixels = (x.repeat_interleave(k, 0) for x in (self.positions, self.pixels))
        sides = None if self.sides is None else self.sides.repeat_interleave(k, 0)
        rotations = (turns @ self.rotations[:, None]).flatten(0, 1)
        return Matches(rotations, positions, pixels, torch.full((len(rotations),), -math.inf), sides)

    def distinct(self, most: int, turned: float, placed: float, sized: float) -> Matches:
        """The best ones, the best first. Of two whose angle is below `turned` radians, whose distance is below `placed` of their
        size, and whose sizes differ by less than the factor `sized`, the better one is kept."""
        ranked = self.of(self.scores.argsort(descending=True, stable=True)[:RANKED])
        flat = ranked.rotations.flatten(1)
        cosine = 0.5 * (flat @ flat.T - 1.0)
        larger = torch.maximum(ranked.pixels[:, None], ranked.pixels)
        alike = cosine > math.cos(turned)
        alike &= torch.cdist(ranked.positions, ranked.positions) < placed * larger
        alike &= larger < sized * torch.minimum(ranked.pixels[:, None], ranked.pixels)
        kept: list[int] = []
        free = torch.ones(len(flat), dtype=torch.bool)
        while len(kept) < most and bool(free.any()):
            first = int(free.int().argmax())
            kept.append(first)
            free &= ~alike[first]
            free[first] = False
        return ranked.of(torch.tensor(kept, dtype=torch.long))

    def poses(self, task: PoseTask) -> list[Pose]:
        camera = task.shots[0].camera
        found = []
        for R, position, pixels in zip(self.rotations, self.positions, self.pixels.tolist(), strict=True):
            depth = 2.0 * task.size if camera.projection == "orthographic" else across(task, camera, 1.0) / pixels
            found.append(pose_at(task, R, position, depth))
        return found


@dataclass(frozen=True)
class Round:
    """Of the search near matches."""

    across: int  # pixels, the object's diagonal in the views
    turn: float  # radians, about each axis
    grow: float  # share of the size
    kept: int
    turned: float  # radians, of those that are kept, as Matches.distinct() has them
    placed: float


FIRST = Round(ACROSS, 0.2, 0.1, 200, 0.2, 0.1)
ROUNDS = (
    Round(20, 0.17, 0.1, 100, 0.1, 0.05),
    Round(32, 0.12, 0.07, 40, 0.1, 0.05),
    Round(32, 0.07, 0.04, 16, 0.15, 0.1),
)  # fmt: skip
MASKED = 2  # times fewer are kept with a mask, which says where the object is
DISTINCT = 24, 0.3, 0.15, 1.3  # of the places of given views, as Matches.distinct() has them
SIZED = 1.1  # factor between the sizes of matches that are kept both


class Mips:
    """The first picture at many sizes, from which what a match covers is taken. The last channel is surprise(), or the mask."""

    def __init__(self, task: PoseTask, finest: int) -> None:
        """`finest`: pixels across the smallest object."""
        shot = task.shots[0]
        self.masked = "alpha" in task.aovs and not task.clutter
        target = shot.target.float()
        mask = target[..., -1:].clamp(0.0, 1.0) if self.masked else None
        radiance = (target if mask is None else target[..., :-1]).clamp(0.0, 1.0)
        colours = linear_to_srgb(radiance if mask is None else radiance * (mask > 0.0))
        self.picture = colours if mask is None else torch.cat([colours, mask], -1)
        self.size = shot.camera.size
        self.factor = 1.0 if self.masked else min(1.0, finest / (SMALLEST * min(self.size)))
        self._levels: dict[int, Tensor] = {}

    def reduced(self, factor: float) -> Tensor:
        """(C + 1, h, w)."""
        size = max(1, round(self.size[0] * factor)), max(1, round(self.size[1] * factor))
        picture = area_mean(self.picture, size).movedim(-1, 0)
        return picture if self.masked else torch.cat([picture, surprise(picture)[None]])

    def crops(self, positions: Tensor, pixels: Tensor, across: int, side: int) -> Tensor:
        """(n, C + 1, side, side) around positions (n, 2), `across` of whose pixels are as long as so many (n,) of the picture."""
        wanted = ((self.factor * pixels / across).log() / math.log(MIP)).round().clamp(min=0).long()
        steps = torch.arange(side, dtype=torch.float64) + 0.5 - 0.5 * side
        H, W = self.size
        found = None
        for level in wanted.unique().tolist():
            rows = (wanted == level).nonzero()[:, 0]
            if level not in self._levels:
                self._levels[level] = self.reduced(self.factor * MIP**-level)
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
                found = seen.new_empty(len(positions), *seen.shape[1:])
            found[rows] = seen
        return torch.empty(0) if found is None else found


def matches(task: PoseTask, seed: int, tell: Callable[[str], object]) -> list[Pose]:
    """The best poses in the first picture, distinct, the best first. The mask, where there is one, says where they are. `tell` is
    called with what is done next."""
    mips = Mips(task, max(one.across for one in ROUNDS))
    tell("views from all sides")
    views = Views.of(task, all_sides(), ACROSS, seed)
    fewer = MASKED if mips.masked else 1
    ways = []
    for rare in RARE[:1] if mips.masked else RARE:
        found = _in_mask(views, mips) if mips.masked else _everywhere(views, mips, _ratios(views, rare))
        found = found.distinct(FIRST.kept // fewer, FIRST.turned, FIRST.placed, SIZED)
        for k, one in enumerate(ROUNDS):
            if len(found.scores):
                tell(f"views nearby, {k + 1} of {len(ROUNDS)}")
                found = closer(task, found, mips, one, rare, seed)
                found = found.distinct(one.kept // fewer, one.turned, one.placed, SIZED)
        ways.append(found.poses(task))
    return [pose for pair in zip_longest(*ways) for pose in pair if pose is not None]


def places(task: PoseTask, views: Views, sizes: tuple[float, float], lit: bool) -> list[Pose]:
    """The best of some views in the first picture, distinct, the best first, between two sizes of the object's diagonal in the
    picture's shorter sides. `lit`: their colours are in the light of the picture."""
    score = _errors(views) if lit else _ratios(views, RARE[0])
    return _everywhere(views, Mips(task, views.across), score, sizes).distinct(*DISTINCT).poses(task)


Score = Callable[
    [Tensor, float], Tensor
]  # of a picture (C + 1, h, w), in which so many of the whole one's are across the object


def _ratios(views: Views, rare: float) -> Score:
    """Log likelihood ratios, weighted: larger objects have more pixels, and those are alike."""
    templates = Templates(views, rare)
    return lambda picture, pixels: templates.everywhere(picture, STRIDE) * pixels


def _errors(views: Views) -> Score:
    """How alike views and picture are inside, pixel by pixel: the mean squared difference, negative."""
    inside = torch.where(views.alpha > 0.5, views.alpha, torch.zeros_like(views.alpha))
    area = inside.sum((1, 2)).clamp(min=1.0)[:, None, None]
    weighted = (inside[..., None] * views.colours).movedim(-1, 1)
    own = (weighted * views.colours.movedim(-1, 1)).sum((1, 2, 3))[:, None, None]

    def score(picture: Tensor, pixels: float) -> Tensor:
        colours = picture[:-1]
        squares = F.conv2d(colours.square().sum(0)[None, None], inside[:, None], stride=STRIDE)[0]
        return -(squares - 2.0 * F.conv2d(colours[None], weighted, stride=STRIDE)[0] + own) / area

    return score


def _everywhere(views: Views, mips: Mips, score: Score, sizes: tuple[float, float] = (SMALLEST, LARGEST)) -> Matches:
    (H, W), T = mips.size, views.alpha.shape[-1]
    margin = T // 3
    rotations, positions, extents, values = [], [], [], []
    for k in range(1 + math.floor(math.log(sizes[1] / sizes[0]) / math.log(RATIO))):
        pixels = sizes[0] * RATIO**k * min(H, W)  # across the object, in the picture
        picture = mips.reduced(min(1.0, views.across / pixels))
        h, w = picture.shape[1:]
        if min(h, w) + 2 * margin < T:
            continue
        scores = score(F.pad(picture[None], (margin,) * 4, mode="replicate")[0], pixels)
        columns = scores.shape[-1]
        best, at = scores.flatten(1).topk(min(PLACES, scores[0].numel()))
        middle = torch.stack([at % columns, at // columns], -1).double() * STRIDE + 0.5 * T - margin
        positions.append((middle * torch.tensor([W / w, H / h], dtype=torch.float64)).flatten(0, 1))
        rotations.append(views.rotations.repeat_interleave(best.shape[1], 0))
        extents.append(torch.full((best.numel(),), pixels, dtype=torch.float64))
        values.append(best.flatten())
    if not values:
        return Matches(
            torch.empty(0, 3, 3).double(), torch.empty(0, 2).double(), torch.empty(0).double(), torch.empty(0)
        )
    return Matches(torch.cat(rotations), torch.cat(positions), torch.cat(extents), torch.cat(values))


def _in_mask(views: Views, mips: Mips) -> Matches:
    """Each view as large as the mask, by their areas, and in its middle."""
    mask = mips.picture[..., -1]
    mass = mask.sum()
    H, W = mips.size
    rows, columns = torch.arange(H) + 0.5, torch.arange(W) + 0.5
    middle = torch.stack([(mask.sum(0) * columns).sum(), (mask.sum(1) * rows).sum()]) / mass.clamp(min=1e-3)
    T = views.alpha.shape[-1]
    area = views.alpha.sum((1, 2)).clamp(min=1.0)
    grid = torch.arange(T) + 0.5
    offset = torch.stack([(views.alpha.sum(1) * grid).sum(1), (views.alpha.sum(2) * grid).sum(1)], -1) / area[:, None]
    ratio = (mass.clamp(min=1e-3) / area).sqrt()  # pixels of the picture in one of the view
    positions = (middle + (0.5 * T - offset) * ratio[:, None]).double()
    pixels = views.across * ratio.double()
    scores = Templates(views, 0.0).near(mips.crops(positions, pixels, views.across, T), True)[:, 0, 0]
    return Matches(views.rotations, positions, pixels, scores)


def closer(task: PoseTask, found: Matches, mips: Mips, one: Round, rare: float, seed: int) -> Matches:
    """Each match at the best of the poses around it."""
    turns = [torch.zeros(3, dtype=torch.float64)]
    for axis in range(3):
        for sign in (one.turn, -one.turn):
            turns.append(torch.zeros(3, dtype=torch.float64).index_fill(0, torch.tensor([axis]), sign))
    n, k = len(found.scores), len(turns)
    best = fitted(task, found.turned(torch.stack([rotation(turn) for turn in turns])), mips, one, rare, seed)
    return best.of(torch.arange(n) * k + best.scores.reshape(n, k).argmax(1))


def fitted(task: PoseTask, given: Matches, mips: Mips, one: Round, rare: float, seed: int) -> Matches:
    """Each match at the best of the places and sizes around it, turned as it is."""
    views = Views.of(task, given.rotations, one.across, seed)
    shown = None
    if given.sides is not None:
        pairs = zip(views.alpha, given.sides.tolist(), strict=True)
        shown = torch.stack([at_one_side(alpha, side, HIDDEN) for alpha, side in pairs])
    templates, T = Templates(views, rare, shown), views.alpha.shape[-1]
    best = given
    for factor in (1.0 - one.grow, 1.0, 1.0 + one.grow):
        pixels = factor * given.pixels
        scores = templates.near(mips.crops(given.positions, pixels, one.across, T + 2 * SHIFT), mips.masked)
        values, places = scores.flatten(1).max(1)
        if not mips.masked:
            values = values * pixels.float()
        side = 2 * SHIFT + 1
        shift = torch.stack([places % side - SHIFT, places // side - SHIFT], -1) * (pixels / one.across)[:, None]
        up = values > best.scores
        best = replace(
            best, positions=torch.where(up[:, None], given.positions + shift, best.positions),
            pixels=torch.where(up, pixels, best.pixels), scores=torch.where(up, values, best.scores),
        )  # fmt: skip
    return best
