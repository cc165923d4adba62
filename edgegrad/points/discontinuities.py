"""Discontinuities that a shader declares (hits.where, hits.floor), and where they lie in the image.

Only values of a discontinuity's function s are known, so lines find where it is zero (Crofton). s is evaluated on a grid of
points with one random shift; between neighbours of different sign bisection finds the zero. A horizontal line crosses a
curve with the unit normal n once in Δ / |n_x| of its length, a vertical one once in Δ / |n_y|, so that

    Σ_{horizontal crossings} Δ g |n_x|  +  Σ_{vertical crossings} Δ g |n_y|

is an unbiased estimate of ∫ g dℓ, and its weights are bounded. Two crossings between the same neighbours are missed; a
smaller spacing Δ finds them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

SIGN, FLOOR = "sign", "floor"
BISECTIONS = 12  # to 1/4096 of the spacing
MOST_LEVELS = 4  # of a floor() between two neighbours; if there are more, so many are drawn


class Discontinuities:
    """The values of the functions of discontinuities that a shader declares at some points, in its order.

    `states` (N, K), if given, are the sides that the discontinuities are forced to, whatever the values say.
    """

    def __init__(self, states: Tensor | None = None) -> None:
        self.kinds: list[str] = []
        self.values: list[Tensor] = []  # (N,) each; NaN where the shader did not ask
        self._states = states

    @property
    def forced(self) -> bool:
        return self._states is not None

    def above_zero(self, s: Tensor) -> Tensor:
        forced = self._note(SIGN, s)
        return s > 0 if forced is None else forced > 0

    def floor(self, t: Tensor) -> Tensor:
        forced = self._note(FLOOR, t)
        return t.detach().floor() if forced is None else forced.to(t.dtype)

    def _note(self, kind: str, values: Tensor) -> Tensor | None:
        self.kinds.append(kind)
        self.values.append(values)
        if self._states is None:
            return None
        if len(self.kinds) > self._states.shape[1]:
            raise ValueError(UNEQUAL)
        return self._states[:, len(self.kinds) - 1].to(values.device)


class DiscontinuitiesOfSubset(Discontinuities):
    """Discontinuities declared of some of the points, and noted as those of all."""

    def __init__(self, discontinuities: Discontinuities, index: Tensor, count: int) -> None:
        super().__init__()
        self._all, self._index, self._count = discontinuities, index, count

    def _note(self, kind: str, values: Tensor) -> Tensor | None:
        nothing = values.new_full((self._count,), torch.nan)
        forced = self._all._note(kind, nothing.index_copy(0, self._index, values))
        return None if forced is None else forced[self._index]


UNEQUAL = (
    "shader: expected as many calls of hits.where(), hits.floor() and nearest lookups each time, in the same order; call them "
    "whatever the points are, and choose among what they return"
)


class ImagePoints(NamedTuple):
    """Points of the image, and the functions of discontinuities there."""

    x: Tensor  # (N, 2)
    face: Tensor  # (N,) int64, −1: none
    part: Tensor  # (N,) int64, the connected part of the surface, −1: none
    b: Tensor  # (N, 2)
    values: Tensor  # (N, K) float64; NaN where there is no face

    def select(self, index: Tensor) -> ImagePoints:
        return ImagePoints(*(part[index] for part in self))

    @staticmethod
    def choose(first: Tensor, a: ImagePoints, b: ImagePoints) -> ImagePoints:
        """Return the points of `a` where `first` (N,), of `b` elsewhere."""
        pairs = zip(a, b, strict=True)
        return ImagePoints(*(torch.where(first[:, None] if u.dim() == 2 else first, u, v) for u, v in pairs))


class Crossings(NamedTuple):
    """Where lines cross discontinuities."""

    x: Tensor  # (M, 2)
    face: Tensor  # (M,)
    b: Tensor  # (M, 2)
    number: Tensor  # (M,) int64, the number of the discontinuity, below K
    axis: Tensor  # (M,) int64: 0 on horizontal lines, 1 on vertical ones
    weight: Tensor  # (M,) px of lines that it stands for
    before: Tensor  # (M, K) the sides of all discontinuities just before it on the line
    after: Tensor  # (M, K) and just after it
    rises: Tensor  # (M,) bool: whether the function increases along the line


At = Callable[[Tensor], ImagePoints]


class _Lines(NamedTuple):
    """Pieces of lines between neighbours."""

    low: ImagePoints
    high: ImagePoints
    axis: Tensor

    def select(self, index: Tensor) -> _Lines:
        return _Lines(self.low.select(index), self.high.select(index), self.axis[index])


class _Candidates(NamedTuple):
    """Changes of a discontinuity's side between neighbours."""

    line: Tensor  # (M,) int64
    number: Tensor
    level: Tensor  # (M,) float64, the value that the function crosses
    weight: Tensor


def find_crossings(
    at: At, kinds: list[str], size: tuple[int, int], margin: float, spacing: float, seed: int
) -> Crossings:
    """Return the crossings in an image of `size` (height, width), widened by `margin` px. at(x) gives
    ImagePoints at places (N, 2)."""
    generator = np.random.default_rng(seed)  # torch's own draws nothing under torch.vmap
    lines = _at_jumps(at, _grid(at, size, margin, spacing, generator))
    found = []
    # If one surface ends before another within a piece, the piece is divided there and searched again.
    for last in (False, True):
        candidates = _candidates(lines, kinds, generator)
        low, high, good = _refine(at, lines, kinds, candidates)
        broken = torch.zeros(len(lines.axis), dtype=torch.bool).index_fill(0, candidates.line[~good], True)
        keep = good if last else good & ~broken[candidates.line]
        found.append(_crossings(low.select(keep), high.select(keep), kinds, candidates, keep, lines.axis, spacing))
        if last or not bool(broken.any()):
            break
        first = torch.full((len(lines.axis),), -1, dtype=torch.int64)
        bad = (~good).nonzero()[:, 0]
        first[candidates.line[bad]] = bad
        where = broken.nonzero()[:, 0]
        a, b, old = low.select(first[where]), high.select(first[where]), lines.select(where)
        lines = _joined(_Lines(old.low, a, old.axis), _Lines(b, old.high, old.axis))
    return Crossings(*map(torch.cat, zip(*found, strict=True)))


def _grid(at: At, size: tuple[int, int], margin: float, spacing: float, generator: np.random.Generator) -> _Lines:
    """Return the pieces of all lines of the grid, up to the border of the image."""
    shift = torch.from_numpy(generator.random(2))

    def inner(length: int, shift: Tensor) -> Tensor:
        low, high = -margin, length + margin
        first = low + spacing * shift
        return torch.arange(float(first), high, spacing, dtype=torch.float64)

    def ends(inner: Tensor, length: int) -> Tensor:
        return torch.cat([inner.new_tensor([-margin]), inner, inner.new_tensor([length + margin])])

    height, width = size
    xs, ys = inner(width, shift[0]), inner(height, shift[1])
    all_x, all_y = ends(xs, width), ends(ys, height)
    X, Y = all_x.expand(len(all_y), -1), all_y[:, None].expand(-1, len(all_x))
    points = at(torch.stack([X, Y], 2).reshape(-1, 2))
    number = torch.arange(X.numel()).reshape(X.shape)
    across = number[1:-1, :-1].reshape(-1), number[1:-1, 1:].reshape(-1)
    down = number[:-1, 1:-1].reshape(-1), number[1:, 1:-1].reshape(-1)
    low, high = torch.cat([across[0], down[0]]), torch.cat([across[1], down[1]])
    axis = (torch.arange(len(low)) >= len(across[0])).long()
    some = (points.face[low] >= 0) | (points.face[high] >= 0)
    return _Lines(points.select(low[some]), points.select(high[some]), axis[some])


def _at_jumps(at: At, lines: _Lines) -> _Lines:
    """Return the pieces, divided where a surface ends before another or before the background."""
    differ = lines.low.part != lines.high.part
    if int(differ.sum()) > len(differ) // 4:  # a triangle soup: only at the background
        differ = (lines.low.face < 0) != (lines.high.face < 0)
    if not bool(differ.any()):
        return lines
    there = lines.select(differ)
    low, high = _bisect(at, there.low, there.high, lambda mid, low: mid.part == low.part)
    halves = _joined(_Lines(there.low, low, there.axis), _Lines(high, there.high, there.axis))
    return _joined(lines.select(~differ), halves.select((halves.low.face >= 0) & (halves.high.face >= 0)))


def _joined(a: _Lines, b: _Lines) -> _Lines:
    def points(p: ImagePoints, q: ImagePoints) -> ImagePoints:
        return ImagePoints(*map(torch.cat, zip(p, q, strict=True)))

    return _Lines(points(a.low, b.low), points(a.high, b.high), torch.cat([a.axis, b.axis]))


def _bisect(
    at: At, low: ImagePoints, high: ImagePoints, like_low: Callable[[ImagePoints, ImagePoints], Tensor]
) -> tuple[ImagePoints, ImagePoints]:
    for _ in range(BISECTIONS if len(low.x) else 0):
        middle = at((low.x + high.x) / 2)
        lower = like_low(middle, low)
        low, high = ImagePoints.choose(lower, middle, low), ImagePoints.choose(lower, high, middle)
    return low, high


def _candidates(lines: _Lines, kinds: list[str], generator: np.random.Generator) -> _Candidates:
    found: list[_Candidates] = []
    for k, kind in enumerate(kinds):
        a, b = lines.low.values[:, k], lines.high.values[:, k]
        both = torch.isfinite(a) & torch.isfinite(b)
        if kind == SIGN:
            line = (both & ((a > 0) != (b > 0))).nonzero()[:, 0]
            found.append(_Candidates(line, torch.full_like(line, k), a.new_zeros(len(line)), a.new_ones(len(line))))
            continue
        below, above = torch.minimum(a, b).floor(), torch.maximum(a, b).floor()
        count = torch.where(both, above - below, 0.0)
        line = (count > 0).nonzero()[:, 0]
        n, first = count[line], below[line] + 1
        for i in range(MOST_LEVELS):
            drawn = (torch.from_numpy(generator.random(len(line))) * n).floor()
            level = first + torch.where(n > MOST_LEVELS, drawn, float(i))
            weight = (n / MOST_LEVELS).clamp(min=1)
            some = n > i
            found.append(_Candidates(line[some], torch.full_like(line[some], k), level[some], weight[some]))
    return _Candidates(*map(torch.cat, zip(*found, strict=True)))


def _refine(
    at: At, lines: _Lines, kinds: list[str], candidates: _Candidates
) -> tuple[ImagePoints, ImagePoints, Tensor]:
    """Return short pieces around the crossings, by their ends, and whether the function is continuous in each."""
    where, number, level = candidates.line, candidates.number, candidates.level
    signs = torch.tensor([kind == SIGN for kind in kinds])[number]

    def function(points: ImagePoints) -> Tensor:
        return points.values.gather(1, number[:, None])[:, 0] - level

    def above(points: ImagePoints) -> Tensor:
        f = function(points)
        return torch.where(signs, f > 0, f >= 0)

    low, high = lines.low.select(where), lines.high.select(where)
    whole = function(high) - function(low)
    low, high = _bisect(at, low, high, lambda mid, low: (above(mid) == above(low)) & (mid.face >= 0))
    rest = (function(high) - function(low)).abs()
    # A smooth function changes by 1/4096 of what it changed before, one that jumps by its jump. The ends may lie on two faces:
    # a border may run along an edge.
    good = (low.part == high.part) & (low.face >= 0) & (rest <= 0.05 * whole.abs())
    return low, high, good


def _crossings(
    low: ImagePoints,
    high: ImagePoints,
    kinds: list[str],
    candidates: _Candidates,
    keep: Tensor,
    axis: Tensor,
    spacing: float,
) -> Crossings:
    c = _Candidates(*(part[keep] for part in candidates))
    f = torch.stack([p.values.gather(1, c.number[:, None])[:, 0] - c.level for p in (low, high)])
    t = (f[0] / (f[0] - f[1]))[:, None].clamp(0, 1)
    signs = torch.tensor([kind == SIGN for kind in kinds])
    before, after = (torch.where(signs, (p.values > 0).double(), p.values.floor().nan_to_num()) for p in (low, high))
    same = (low.face == high.face)[:, None]  # else the crossing is put on the first face
    # Where several discontinuities change at once, the first stands for all.
    first = (before != after).double().argmax(1) == c.number
    found = Crossings(
        torch.lerp(low.x, high.x, t), low.face, torch.where(same, torch.lerp(low.b, high.b, t), low.b), c.number,
        axis[c.line], spacing * c.weight,
        before, after, f[1] > f[0],
    )  # fmt: skip
    return Crossings(*(part[first] for part in found))
