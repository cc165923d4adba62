"""Where in a picture an object might be, and how it is turned: views of it, compared with the picture everywhere at low
resolution.

A view explains a part of a picture by the mesh's colours in the light that fits them best there. What it has to beat is, for one
list of matches, one colour for all of the part, where the view has one around the object, and for another that the pixels are
drawn from the colours of the whole picture: the first finds contours and patterns, the second rare colours. With the basis B of
colours times harmonics inside the silhouette, the squared error is Σy² − bᵀA⁻¹b, with b = Σ B y and A = Σ B Bᵀ (a matched
subspace filter, Scharf and Friedlander 1994). A does not depend on the place, and b is a correlation, so all places are had at
once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ....files.image import linear_to_srgb
from ...views import area_mean
from ..pose import Pose, angle
from ..task import PoseTask
from .views import ACROSS, RING, Views, across, pose_at

SIZES, RATIO = (0.25, 1.25), 1.2  # the object's diagonal in the picture's shorter sides, and between two sizes
STRIDE = 2  # pixels between two places
AT_ONCE = 128  # views
NOISE = 0.06  # standard deviation of a pixel, sRGB values: of noise, and of what views lack by their spacing
SHADE = 0.3  # of the light's slopes, relative to its constant
WHITE = 0.15  # of the light's colour
SHAPE = 0.25  # of a mask's error beside that of colours
POWERS = (
    1.0,
    1.4,
)  # of the object's size, that the ratios are multiplied by: larger ones have more pixels, which are alike
PLACES = 3  # of a view, at one size
TURNED_APART, PLACED_APART, SIZED_APART = 0.3, 0.15, 1.3  # radians, object sizes, factor: poses that are kept both
KEPT = 24
ALIKE = 0.08  # standard deviation of colours that look alike, sRGB values
COUNTED = 1500  # pixels that tell how frequent colours are
RANKED = 2000


class Match(NamedTuple):
    """A view, somewhere in a picture."""

    score: float
    view: int
    position: Tensor  # (2,) of the object's centre, pixels of the picture
    pixels: float  # of the picture, across the object


def matches(task: PoseTask, views: Views, sizes: tuple[float, float] = SIZES) -> list[Pose]:
    """The best poses in the first picture, distinct, the best first. The mask, where there is one, says where they are, or else
    they have `sizes` between two, of the object's diagonal in the picture's shorter sides."""
    masked = "alpha" in task.aovs and not task.clutter
    if masked:
        return _distinct(task, views, _in_mask(task, views), KEPT)
    first, second = (_distinct(task, views, found, KEPT) for found in _everywhere(task, views, sizes))
    return [pose for pair in zip(first, second, strict=False) for pose in pair]


def look_alikes(task: PoseTask, views: Views, sizes: tuple[float, float]) -> list[Pose]:
    """As matches(), of views whose colours are in the light of the picture: where they are alike inside, pixel by pixel."""
    inside = torch.where(views.alpha > 0.5, views.alpha, torch.zeros_like(views.alpha))
    area = inside.sum((1, 2)).clamp(min=1.0)[:, None, None]
    weighted = (inside[..., None] * views.colours).movedim(-1, 1)
    own = (weighted * views.colours.movedim(-1, 1)).sum((1, 2, 3))[:, None, None]
    found = []
    for picture, pixels, factors, margin in _sized(task, views, sizes):
        squares = F.conv2d(picture.square().sum(0)[None, None], inside[:, None], stride=STRIDE)[0]
        error = (squares - 2.0 * F.conv2d(picture[None], weighted, stride=STRIDE)[0] + own) / area
        found += _best(-error, pixels, factors, margin, views)
    return _distinct(task, views, found, KEPT)


class _Filter:
    """Views as filters of pictures with the channels C."""

    def __init__(self, views: Views) -> None:
        alpha, colours, normals = views.alpha, views.colours, views.normals
        self.C = colours.shape[-1]
        self.inside = torch.where(alpha > 0.5, alpha, torch.zeros_like(alpha))
        near = F.max_pool2d((alpha > 0.02).float()[:, None], 2 * RING + 1, 1, RING)[:, 0]
        self.around = near * (alpha < 0.02)
        Y = torch.cat([torch.ones_like(normals[..., :1]), normals], -1)
        basis = colours[..., None] * Y[..., None, :]  # (n, T, T, C, 4)
        weighted = basis * self.inside[..., None, None]
        A = torch.einsum("nijck,nijcl->nckl", weighted, basis)
        self.inverse = torch.linalg.inv(_with_prior(A.double())).float()  # (n, 4C, 4C)
        self.filters = weighted.permute(0, 3, 4, 1, 2)  # (n, C, 4, T, T)

    def scores(self, picture: Tensor, surprise: Tensor, stride: int) -> Tensor:
        """(2, n, h, w) of a picture (C, H, W), of whose pixels `surprise` (H, W) is −log of the density of their colours: log
        likelihood ratios of the view to one colour for all, a pixel, and to the colours of the whole picture."""
        parts = []
        sides = torch.stack([self.inside, self.around], 1)
        for at in range(0, len(self.inside), AT_ONCE):
            rows = slice(at, at + AT_ONCE)
            n = len(self.inside[rows])
            b, sums = [], []
            for c in range(self.C):
                both = torch.cat([self.filters[rows, c], sides[rows]], 1).flatten(0, 1)[:, None]
                out = F.conv2d(picture[None, c : c + 1], both, stride=stride)[0]
                out = out.reshape(n, 6, *out.shape[1:])
                b.append(out[:, :4])
                sums.append(out[:, 4:])
            squares = F.conv2d(picture.square().sum(0)[None, None], sides[rows].flatten(0, 1)[:, None], stride=stride)[
                0
            ]
            squares = squares.reshape(n, 2, *squares.shape[1:])
            rare = F.conv2d(surprise[None, None], self.inside[rows, None], stride=stride)[0]
            parts.append(self._ratios(torch.cat(b, 1), torch.stack(sums, 2), squares, rare, rows))
        return torch.cat(parts, 1)

    def _ratios(self, b: Tensor, sums: Tensor, squares: Tensor, rare: Tensor, rows: slice) -> Tensor:
        """b (n, 4C, h, w); sums (n, 2, C, h, w) and squares (n, 2, h, w) of what is inside and around; rare (n, h, w)."""
        inside, around = (x[rows].sum((1, 2)).clamp(min=1e-3)[:, None, None] for x in (self.inside, self.around))
        error = (squares[:, 0] - (b * torch.einsum("nkl,nlhw->nkhw", self.inverse[rows], b)).sum(1)).clamp(min=0.0)
        beside = (squares[:, 1] - sums[:, 1].square().sum(1) / around).clamp(min=0.0)
        even = (squares.sum(1) - sums.sum(1).square().sum(1) / (inside + around)).clamp(min=0.0)
        noise = NOISE**2 * self.C * (inside + around)
        variance = error / (self.C * inside) + NOISE**2
        return torch.stack([
            torch.log((even + noise) / (error + beside + noise)),
            rare - 0.5 * self.C * inside * (variance.log() + math.log(2.0 * math.pi) + 1.0),
        ])  # fmt: skip

    def errors(self, crops: Tensor) -> Tensor:
        """(n,) squared errors inside each view, of pictures (n, C, T, T)."""
        b = torch.einsum("ncfij,ncij->ncf", self.filters, crops).flatten(1)
        total = (crops.square().sum(1) * self.inside).sum((1, 2))
        return (total - torch.einsum("nk,nkl,nl->n", b, self.inverse, b)).clamp(min=0.0)


def _with_prior(A: Tensor) -> Tensor:
    """(n, 4C, 4C) of (n, C, 4, 4): the light is about white, and its slopes are smaller than its constant."""
    n, C = A.shape[:2]
    full = torch.zeros(n, C, 4, C, 4, dtype=A.dtype)
    differ = torch.eye(C, dtype=A.dtype) - 1.0 / C
    full += (NOISE / WHITE) ** 2 * differ[None, :, None, :, None] * torch.eye(4, dtype=A.dtype)[None, None, :, None, :]
    slopes = torch.tensor([1e-3, 1.0, 1.0, 1.0], dtype=A.dtype) * (NOISE / SHADE) ** 2
    for c in range(C):
        full[:, c, :, c] += A[:, c] + torch.diag(slopes)
    return full.reshape(n, 4 * C, 4 * C)


def _everywhere(task: PoseTask, views: Views, sizes: tuple[float, float]) -> list[list[Match]]:
    """By each of the ratios."""
    filters = _Filter(views)
    found: list[list[Match]] = [[], []]
    for picture, pixels, factors, margin in _sized(task, views, sizes):
        both = filters.scores(picture, _surprise(picture), STRIDE)
        for kind, (scores, power) in enumerate(zip(both, POWERS, strict=True)):
            found[kind] += _best(scores * pixels**power, pixels, factors, margin, views)
    return found


def _sized(
    task: PoseTask, views: Views, sizes: tuple[float, float]
) -> Iterator[tuple[Tensor, float, tuple[float, float], int]]:
    """The first picture (C, h, w) at sizes at which objects have that of views; pixels across such objects in it, of how many
    pixels of it one is a mean (x, y), and how many there are beside it."""
    shot = task.shots[0]
    H, W = shot.camera.size
    target = linear_to_srgb(shot.target.float().clamp(0.0, 1.0))
    T = views.alpha.shape[-1]
    margin = T // 3
    for k in range(1 + math.floor(math.log(sizes[1] / sizes[0]) / math.log(RATIO))):
        pixels = sizes[0] * RATIO**k * min(H, W)  # across the object, in the picture
        factor = min(1.0, ACROSS / pixels)
        size = max(1, round(H * factor)), max(1, round(W * factor))
        if min(size) + 2 * margin < T:
            continue
        picture = F.pad(area_mean(target, size).movedim(-1, 0)[None], (margin,) * 4, mode="replicate")[0]
        yield picture, pixels, (W / size[1], H / size[0]), margin


def _best(scores: Tensor, pixels: float, factors: tuple[float, float], margin: int, views: Views) -> list[Match]:
    """Of (n, h, w), the best places of each view."""
    w, middle = scores.shape[-1], 0.5 * views.alpha.shape[-1] - margin
    best, places = scores.flatten(1).topk(min(PLACES, scores[0].numel()))
    found = []
    for n, (values, here) in enumerate(zip(best.tolist(), places.tolist(), strict=True)):
        for value, place in zip(values, here, strict=True):
            x, y = STRIDE * (place % w) + middle, STRIDE * (place // w) + middle
            found.append(Match(value, n, torch.tensor([x * factors[0], y * factors[1]]), pixels))
    return found


def _surprise(picture: Tensor) -> Tensor:
    """(H, W), −log of the density of each pixel's colour in (C, H, W)."""
    C, H, W = picture.shape
    pixels = picture.flatten(1).T
    some = pixels[:: max(1, len(pixels) // COUNTED)]
    log = (-0.5 * (torch.cdist(pixels, some) / ALIKE).square()).logsumexp(1) - math.log(len(some))
    return (C * math.log(ALIKE * math.sqrt(2.0 * math.pi)) - log).reshape(H, W)


def _in_mask(task: PoseTask, views: Views) -> list[Match]:
    """Each view as large as the mask, by their areas, and in its middle."""
    shot = task.shots[0]
    target = shot.target.float()
    mask = target[..., -1].clamp(0.0, 1.0)
    mass = mask.sum()
    if not float(mass) > 0.0:
        return []
    H, W = shot.camera.size
    rows, columns = torch.arange(H) + 0.5, torch.arange(W) + 0.5
    middle = torch.stack([(mask.sum(0) * columns).sum(), (mask.sum(1) * rows).sum()]) / mass
    T = views.alpha.shape[-1]
    area = views.alpha.sum((1, 2)).clamp(min=1.0)
    grid = torch.arange(T) + 0.5
    offset = torch.stack([(views.alpha.sum(1) * grid).sum(1), (views.alpha.sum(2) * grid).sum(1)], -1) / area[:, None]
    ratio = (mass / area).sqrt()  # pixels of the picture in one of the view
    # As small as the smallest view has it, so that what is sampled is a mean.
    factor = min(1.0, 1.0 / float(ratio.median()))
    size = max(1, round(H * factor)), max(1, round(W * factor))
    colours = linear_to_srgb(target[..., :-1].clamp(0.0, 1.0)) if target.shape[-1] > 1 else torch.zeros(H, W, 0)
    small = area_mean(torch.cat([colours * (mask[..., None] > 0.0), mask[..., None]], -1), size).movedim(-1, 0)
    x = middle[0] + (grid[None] - offset[:, :1]) * ratio[:, None]  # (n, T)
    y = middle[1] + (grid[None] - offset[:, 1:]) * ratio[:, None]
    at = torch.stack(torch.broadcast_tensors(x[:, None, :] / W, y[:, :, None] / H), -1) * 2.0 - 1.0
    seen = F.grid_sample(small[None].expand(len(at), -1, -1, -1), at, align_corners=False)  # (n, C + 1, T, T)
    error = SHAPE * (seen[:, -1] - views.alpha).square().sum((1, 2))
    if target.shape[-1] > 1:
        error = error + _Filter(views).errors(seen[:, :-1])
    scores = -torch.log(error / area + NOISE**2)
    found = []
    for n, value in enumerate(scores.tolist()):
        position = middle + (0.5 * T - offset[n]) * ratio[n]
        found.append(Match(value, n, position, ACROSS * float(ratio[n])))
    return found


def _distinct(task: PoseTask, views: Views, found: list[Match], most: int) -> list[Pose]:
    camera = task.shots[0].camera
    kept: list[tuple[Match, Pose]] = []
    for one in sorted(found, key=lambda one: -one.score)[:RANKED]:
        depth = 2.0 * task.size if camera.projection == "orthographic" else across(task, camera, 1.0) / one.pixels
        pose = pose_at(task, views.rotations[one.view], one.position, depth)
        if all(_apart(one, pose, *other) for other in kept):
            kept.append((one, pose))
            if len(kept) == most:
                break
    return [pose for _, pose in kept]


def _apart(one: Match, pose: Pose, other: Match, known: Pose) -> bool:
    larger = max(one.pixels, other.pixels)
    if float((one.position - other.position).norm()) > PLACED_APART * larger:
        return True
    return larger > SIZED_APART * min(one.pixels, other.pixels) or angle(pose.R, known.R) > TURNED_APART
