"""edgegrad.raster in NumPy, pixel by pixel and in float64, from the definitions alone: what the kernel is compared with."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def centers(height: int, width: int) -> tuple[Floats, Floats]:
    """x of the columns and y of the rows, row 0 at the bottom."""
    return (2 * np.arange(width) + 1) / width - 1, (2 * np.arange(height) + 1) / height - 1


def seen(pos: Floats, tri: Ints, x: float, y: float, behind: float = -np.inf) -> tuple[float, float, float, int]:
    """u, v, z/w and the triangle + 1 at a point of the image: solves Σ λ (x, y, w) = (x, y, 1) for each triangle."""
    best = (0.0, 0.0, 0.0, 0)
    nearest = np.inf
    for t, corners in enumerate(pos[tri]):
        matrix = corners[:, [0, 1, 3]].T
        if abs(np.linalg.det(matrix)) < 1e-14:
            continue
        weights = np.linalg.solve(matrix, np.array([x, y, 1.0]))
        if weights.min() < 0 or weights.sum() <= 0:
            continue
        depth = float(weights @ corners[:, 2])
        if -1 <= depth <= 1 and behind < depth < nearest:
            nearest = depth
            u, v, _ = weights / weights.sum()
            best = (float(u), float(v), depth, t + 1)
    return best


def rasterize(pos: Floats, tri: Ints, size: tuple[int, int], behind: Floats | None = None) -> Floats:
    """(H, W, 4)"""
    xs, ys = centers(*size)
    return np.array(
        [
            [seen(pos, tri, x, y, -np.inf if behind is None else behind[j, i]) for i, x in enumerate(xs)]
            for j, y in enumerate(ys)
        ]
    )


def barycentrics_at(pos: Floats, corners: Ints, x: float, y: float) -> Floats:
    """u and v of a triangle's plane anywhere in the image."""
    weights = np.linalg.solve(pos[corners][:, [0, 1, 3]].T, np.array([x, y, 1.0]))
    return weights[:2] / weights.sum()


def covers(corners: list[tuple[Fraction, Fraction]], x: Fraction, y: Fraction) -> bool:
    """Whether a triangle with w = 1 covers a centre, exactly; one on an edge as if it lay a little to the right and, less, up."""

    def side(a: tuple[Fraction, Fraction], b: tuple[Fraction, Fraction]) -> int:
        along = (b[0] - a[0], b[1] - a[1])
        for value in ((along[0] * (y - a[1]) - along[1] * (x - a[0])), -along[1], along[0]):
            if value:
                return 1 if value > 0 else -1
        return 0

    a, b, c = corners
    sides = {side(a, b), side(b, c), side(c, a)}
    return sides in ({1}, {-1})


class Texture(NamedTuple):
    """Texels of one image's texture (h, w, C), or of a cube (6, h, h, C), and what is beyond them."""

    texels: Floats
    border: str

    def texel(self, column: int, row: int) -> Floats:
        height, width, channels = self.texels.shape
        if self.border == "wrap":
            return self.texels[row % height, column % width]
        if self.border == "clamp":
            return self.texels[min(max(row, 0), height - 1), min(max(column, 0), width - 1)]
        inside = 0 <= row < height and 0 <= column < width
        return self.texels[row, column] if inside else np.zeros(channels)

    def linear(self, uv: Floats) -> Floats:
        if self.border == "cube":
            return self.linear_cube(uv)
        x, y = uv[0] * self.texels.shape[1] - 0.5, uv[1] * self.texels.shape[0] - 0.5
        i, j = int(np.floor(x)), int(np.floor(y))
        a, b = x - i, y - j
        below = (1 - a) * self.texel(i, j) + a * self.texel(i + 1, j)
        return (1 - b) * below + b * ((1 - a) * self.texel(i, j + 1) + a * self.texel(i + 1, j + 1))

    def nearest(self, uv: Floats) -> Floats:
        if self.border == "cube":
            side, s, t = side_of_cube(uv)
            n = self.texels.shape[1]
            return self.texels[side, min(int(t * n), n - 1), min(int(s * n), n - 1)]
        return self.texel(int(np.floor(uv[0] * self.texels.shape[1])), int(np.floor(uv[1] * self.texels.shape[0])))

    def linear_cube(self, direction: Floats) -> Floats:
        """Texels beyond a side are those that directions through the centres of its continued grid see."""
        side, s, t = side_of_cube(direction)
        n = self.texels.shape[1]
        x, y = s * n - 0.5, t * n - 0.5
        i, j = int(np.floor(x)), int(np.floor(y))
        a, b = x - i, y - j
        parts = {(i, j): (1 - a) * (1 - b), (i + 1, j): a * (1 - b), (i, j + 1): (1 - a) * b, (i + 1, j + 1): a * b}
        inside = range(n)
        outside = [at for at in parts if at[0] not in inside and at[1] not in inside]
        total = np.zeros(self.texels.shape[-1])
        for at, weight in parts.items():
            if at in outside:
                continue
            share = weight + (parts[outside[0]] / 3 if outside else 0)
            total += share * self.beyond(side, *at)
        return total

    def beyond(self, side: int, column: int, row: int) -> Floats:
        n = self.texels.shape[1]
        if 0 <= column < n and 0 <= row < n:
            return self.texels[side, row, column]
        # A point just beyond the edge of the side, next to the texel within it.
        s = min(max((column + 0.5) / n, -0.01 / n), 1 + 0.01 / n)
        t = min(max((row + 0.5) / n, -0.01 / n), 1 + 0.01 / n)
        return self.nearest(direction_of(side, s, t))


# OpenGL's table: of each side the direction as a function of sc, tc in −1 … 1 (Segal and Akeley, table of cube map faces).
CUBE = (
    lambda s, t: (1, -t, -s), lambda s, t: (-1, -t, s), lambda s, t: (s, 1, t),
    lambda s, t: (s, -1, -t), lambda s, t: (s, -t, 1), lambda s, t: (-s, -t, -1),
)  # fmt: skip


def direction_of(side: int, s: float, t: float) -> Floats:
    return np.array(CUBE[side](2 * s - 1, 2 * t - 1), float)


def side_of_cube(direction: Floats) -> tuple[int, float, float]:
    for side in range(6):
        axis, sign = side // 2, 1 - 2 * (side % 2)
        m = sign * direction[axis]
        if m > 0 and m >= np.abs(direction).max():
            p = direction / m
            sc = {0: -p[2], 1: p[2], 2: p[0], 3: p[0], 4: p[0], 5: -p[0]}[side]
            tc = {0: -p[1], 1: -p[1], 2: p[2], 3: -p[2], 4: -p[1], 5: -p[1]}[side]
            return side, (sc + 1) / 2, (tc + 1) / 2
    raise ValueError("direction: expected one of some length")


def pyramid(texels: Floats, border: str) -> list[Texture]:
    """The texture and its levels."""
    levels = [texels]
    while max(levels[-1].shape[-3:-1]) > 1:
        *front, height, width, channels = levels[-1].shape
        tall, wide = min(height, 2), min(width, 2)
        blocks = levels[-1].reshape(*front, height // tall, tall, width // wide, wide, channels)
        levels.append(blocks.mean((-4, -2)))
    return [Texture(level, border) for level in levels]


def at_level(levels: list[Texture], uv: Floats, level: float) -> Floats:
    level = min(max(level, 0.0), len(levels) - 1.0)
    below = int(level)
    above = min(below + 1, len(levels) - 1)
    share = level - below
    return (1 - share) * levels[below].linear(uv) + share * levels[above].linear(uv)


def antialias(color: Floats, rast: Floats, pos: Floats, tri: Ints) -> Floats:
    """(H, W, C): one image, each pair of pixels in turn."""
    height, width = color.shape[:2]
    xs, ys = centers(height, width)
    out = color.copy()
    for j in range(height):
        for i in range(width):
            for di, dj in ((1, 0), (0, 1)):
                p, q = (j, i), (j + dj, i + di)
                if q[0] >= height or q[1] >= width or rast[p][3] == rast[q][3]:
                    continue
                near, far = p, q
                if rast[p][3] == 0 or (rast[q][3] > 0 and rast[q][2] < rast[p][2]):
                    near, far = q, p
                d = reach(pos, tri, int(rast[near][3]) - 1, near, far, (xs, ys), (height, width))
                if d is None:
                    continue
                if d > 0.5:
                    out[far] += (d - 0.5) * (color[near] - color[far])
                else:
                    out[near] += (0.5 - d) * (color[far] - color[near])
    return out


def reach(
    pos: Floats, tri: Ints, triangle: int, near: tuple[int, int], far: tuple[int, int], at: tuple[Floats, Floats],
    size: tuple[int, int],
) -> float | None:  # fmt: skip
    """How far from the near centre to the far one the triangle goes, where it ends with a silhouette; all w are above zero."""
    xs, ys = at
    scale = np.array([size[1], size[0]]) / 2
    image = pos[:, :2] / pos[:, 3:] * scale  # in pixels
    a = np.array([xs[near[1]], ys[near[0]]]) * scale
    b = np.array([xs[far[1]], ys[far[0]]]) * scale
    for k in range(3):
        v, w = tri[triangle][(k + 1) % 3], tri[triangle][(k + 2) % 3]
        along = image[w] - image[v]

        def side(point: Floats, v: int = v, along: Floats = along) -> float:
            return along[0] * (point[1] - image[v][1]) - along[1] * (point[0] - image[v][0])

        others = [
            next(c for c in corners if c not in (v, w))
            for t, corners in enumerate(tri)
            if t != triangle and v in corners and w in corners
        ]
        if any(side(image[o]) * side(image[tri[triangle][k]]) < 0 for o in others):
            continue
        steep = abs(along[1]) >= abs(along[0])
        if steep != (near[0] == far[0]):
            continue
        # a + d (b − a) = image[v] + e along
        d, e = np.linalg.solve(np.stack([b - a, -along], 1), image[v] - a)
        if 0 <= d <= 1 and 0 <= e <= 1:
            return float(d)
    return None
