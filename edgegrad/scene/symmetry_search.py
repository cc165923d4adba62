"""The search of Symmetries.find(): the rotations after which a mesh is where it was, from its surface.

A symmetry keeps the centroid of the surface's area and commutes with its covariance. Where the three variances differ, only half
turns about the principal axes are left; where two are equal, the third axis may be of any order, and others lie across it. Where
all are equal, rotations are searched for on a grid over all of them, each refined by iterated closest points (Besl and McKay
1992), on the distances to the planes of the nearest faces (Chen and Medioni 1992). What comes out is a group, whose products are
verified as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from .nearest import NEIGHBOURS, NearestPoints, SurfaceIndex
from .symmetry_axis import SymmetryAxis, about

DECIDING_SAMPLES = 600  # of the surface, and as many vertices, whose distances decide
RANKING_SAMPLES = 120  # of these for what only ranks candidates
TURNS = 24  # of a rotation about an axis, by which it counts as continuous
GOLDEN = math.pi * (3.0 - math.sqrt(5.0))  # multiples of this angle are evenly spread
GRID = 600  # rotations of the grid over all, some 25° apart
REFINED_ROTATIONS = 16  # of these, refined: the best at least DISTINCT_ROTATION from known symmetries
DISTINCT_ROTATION = math.radians(30.0)
ICP_STEPS = 12  # of iterated closest points
LONGEST_STEP = 0.3  # radians of such a step
FEWER_NEIGHBOURS = 4  # faces near a point that are looked at in the first half of these
SMALLEST_POLYHEDRAL, LARGEST_POLYHEDRAL = 12, 60  # rotations of the tetrahedron and of the icosahedron
LARGEST_GROUP = 144
ODD_COLORS = 0.01  # share of the points whose colours may differ: at the borders of texels

Group = tuple[Tensor, list[SymmetryAxis]]  # discrete motions (N, 4, 4), the identity first, and continuous ones


@dataclass
class SymmetrySearch:
    """The rotations of a surface onto itself, looked for by the arguments of Symmetries.find()."""

    surface: SurfaceIndex
    tolerance: float
    textured: bool
    color_tolerance: float
    max_order: int
    center: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        surface = self.surface
        self.center, self.variances, self.axes = _moments(surface.triangles, surface.area)
        samples = surface.samples(DECIDING_SAMPLES, seed=0)
        corners = np.unique(surface.triangles.reshape(-1, 3), axis=0)
        corners = corners[np.linspace(0, len(corners) - 1, min(DECIDING_SAMPLES, len(corners))).round().astype(int)]
        self.points = np.concatenate([samples.position, corners]) - self.center
        farthest = np.linalg.norm(surface.triangles.reshape(-1, 3) - self.center, axis=1).max()
        self.size = 2.0 * float(farthest)
        self.limit = self.tolerance * self.size
        self.few = samples.position[:: DECIDING_SAMPLES // RANKING_SAMPLES] - self.center
        colors = surface.colors(samples) if self.textured else None
        self.brightest = 1.0 if colors is None else max(float(colors.max()), 1e-30)
        self.colors = None if colors is None else self._seen(colors)

    def run(self) -> Group:
        radius = np.linalg.norm(self.points, axis=1)
        if radius.max() - radius.min() <= self.limit and all(self._maps(self._any(k)) for k in range(TURNS)):
            return self._with([], list(np.eye(3)))
        # For each axis, this tells whether the variances along the two others are equal.
        equal = [self._equal((i + 1) % 3, (i + 2) % 3) for i in range(3)]
        axes = [self.axes[:, i] for i in range(3)]
        round_one = next((axis for i, axis in enumerate(axes) if equal[i] and self._continuous(axis)), None)
        group = [np.eye(3)]
        if round_one is None and all(equal):
            group, round_one = self._anywhere()
        if round_one is not None:
            return self._with(self._flips(round_one), [round_one])
        if len(group) >= SMALLEST_POLYHEDRAL:
            return self._with(group[1:], [])
        for i, axis in enumerate(axes):
            orders = range(2, self.max_order + 1) if equal[i] else [2]
            for n in orders:
                group = self._with_one_more(group, _turn(axis, 2.0 * math.pi / n))
            if equal[i] and len(group) < SMALLEST_POLYHEDRAL:
                for flip in self._flips(axis):
                    group = self._with_one_more(group, flip)
        return self._with(group[1:], [])

    def _with(self, rotations: list[np.ndarray], axes: list[np.ndarray]) -> Group:
        """Return what rotations and axes make, with the identity, about the centroid."""
        R = torch.from_numpy(np.stack([np.eye(3), *rotations]))
        center = torch.from_numpy(self.center)
        motions = torch.eye(4, dtype=torch.float64).repeat(len(R), 1, 1)
        motions[:, :3, :3], motions[1:, :3, 3] = R, (center - R @ center)[1:]
        return motions, [SymmetryAxis(torch.from_numpy(axis.copy()), center) for axis in axes]

    # -- what a symmetry is ----------------------------------------------------------------------------------------------

    def _maps(self, R: np.ndarray) -> bool:
        """Return whether a rotation about the centroid is a symmetry: all points come near the surface, and nearly all to the
        same colour."""
        rough = self.surface.rough_distance(self.few @ R.T + self.center)
        if np.median(rough) > 3.0 * self.limit + 0.02 * self.size:
            return False
        moved = self.points @ R.T + self.center
        there = self.surface.nearest(moved)
        if np.linalg.norm(there.position - moved, axis=1).max() > self.limit:
            return False
        if self.colors is None:
            return True
        colors = self.surface.colors(
            NearestPoints(there.position[:DECIDING_SAMPLES], there.face[:DECIDING_SAMPLES], there.b[:DECIDING_SAMPLES])
        )
        assert colors is not None
        odd = (self._seen(colors) - self.colors).abs().amax(1) > self.color_tolerance
        return float(odd.double().mean()) <= ODD_COLORS

    def _seen(self, colors: Tensor) -> Tensor:
        """Return square roots (N, C) of colours, of which the brightest is 1."""
        return (colors.clamp(min=0.0) / self.brightest).sqrt()

    def _equal(self, i: int, j: int) -> bool:
        """Return whether a surface whose points are off by the tolerance may have these two variances and be symmetric.
        Shifting points of standard deviation σ by d moves σ² by up to 2 σ d."""
        a, b = self.variances[i], self.variances[j]
        return abs(a - b) <= 4.0 * self.limit * math.sqrt(max(a, b)) + 1e-9 * max(a, b)

    def _continuous(self, axis: np.ndarray) -> bool:
        return all(self._maps(_turn(axis, (k + 1) * GOLDEN)) for k in range(TURNS))

    def _any(self, k: int) -> np.ndarray:
        """Return the k-th of some rotations about different axes by different angles."""
        axis = np.array([math.cos(k * GOLDEN), math.sin(k * GOLDEN), (2 * k + 1) / TURNS - 1.0])
        return _turn(axis / np.linalg.norm(axis), 1.0 + 0.7 * k)

    # -- where they are looked for ---------------------------------------------------------------------------------------

    def _flips(self, axis: np.ndarray) -> list[np.ndarray]:
        """Return a half turn about an axis across the given one, or none: the others follow from the rotations about the given
        one."""
        side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
        side /= np.linalg.norm(side)
        count = 4 * self.max_order
        angles = np.arange(count) * (math.pi / count)
        across = np.stack([_turn(axis, angle) @ side for angle in angles])
        turns = 2.0 * across[:, :, None] * across[:, None, :] - np.eye(3)
        score = self._rough(turns)
        for i in np.argsort(score, kind="stable")[: 2 * (count // self.max_order)]:
            R = self._refined(turns[i])
            u, angle = _axis_angle(R)
            u = u - axis * (u @ axis)
            if abs(angle - math.pi) > 0.2 or np.linalg.norm(u) < 0.9:
                continue
            u /= np.linalg.norm(u)
            flip = 2.0 * np.outer(u, u) - np.eye(3)
            if self._maps(flip):
                return [flip]
        return []

    def _anywhere(self) -> tuple[list[np.ndarray], np.ndarray | None]:
        """Return the group that a grid of all rotations leads to; or the axis of a continuous one."""
        group = [np.eye(3)]
        grid = _rotations(GRID)
        order = np.argsort(self._rough(grid), kind="stable")
        tried = 0
        for R in grid[order]:
            if tried == REFINED_ROTATIONS or len(group) >= LARGEST_POLYHEDRAL:
                break
            if self._nearest_in(R, group) < DISTINCT_ROTATION:  # they lead to what is known
                continue
            tried += 1
            R = self._refined(R)
            if self._nearest_in(R, group) < DISTINCT_ROTATION / 2 or not self._maps(R):
                continue
            axis, _ = _axis_angle(R)
            if self._continuous(axis):
                return group, axis
            group = self._with_one_more(group, self._of_whole_order(R))
        return group, None

    def _rough(self, rotations: np.ndarray) -> np.ndarray:
        """Return the root mean squared distance (N,) of a few points, by which candidates are ranked."""
        moved = np.einsum("nij,pj->npi", rotations, self.few) + self.center
        return np.sqrt((self.surface.rough_distance(moved) ** 2).mean(1))

    def _refined(self, R: np.ndarray) -> np.ndarray:
        """Take Gauss-Newton steps on the distances to the planes of the nearest faces, about the centroid. They stop where they
        do not lead near a symmetry."""
        for k in range(ICP_STEPS):
            turned = self.few @ R.T
            there = self.surface.nearest(turned + self.center, FEWER_NEIGHBOURS if k < ICP_STEPS // 2 else NEIGHBOURS)
            n = self.surface.normal[there.face]
            residual = (n * (turned + self.center - there.position)).sum(1)
            if k == ICP_STEPS // 3 and np.sqrt((residual**2).mean()) > 2.0 * self.limit:
                break
            J = np.cross(turned, n)
            damping = 1e-9 * np.trace(J.T @ J) * np.eye(3)
            step = -np.linalg.solve(J.T @ J + damping, J.T @ residual)
            length = float(np.linalg.norm(step))
            if length > 0.0:
                R = _turn(step / length, min(length, LONGEST_STEP)) @ R
        return R

    # -- what they make together -----------------------------------------------------------------------------------------

    def _with_one_more(self, group: list[np.ndarray], R: np.ndarray) -> list[np.ndarray]:
        """Return the group with R and all products, or as it is if one of these is no symmetry, or there are too many."""
        if self._known(R, group) or not self._maps(R):
            return group
        larger, done = [*group, R], 0
        while done < len(larger):
            for other in list(larger):
                for product in (larger[done] @ other, other @ larger[done]):
                    if self._known(product, larger):
                        continue
                    if len(larger) == LARGEST_GROUP or not self._maps(product):
                        return group
                    larger.append(product)
            done += 1
        return larger

    def _known(self, R: np.ndarray, group: list[np.ndarray]) -> bool:
        return self._nearest_in(R, group) < math.pi / (2 * self.max_order)

    def _nearest_in(self, R: np.ndarray, group: list[np.ndarray]) -> float:
        """Return the radians from R to the nearest of the group."""
        cosine = 0.5 * (np.einsum("ij,gij->g", R, np.stack(group)).max() - 1.0)
        return math.acos(min(1.0, max(-1.0, cosine)))

    def _of_whole_order(self, R: np.ndarray) -> np.ndarray:
        """Return the rotation about the same axis with the nearest angle 360° k / n."""
        axis, angle = _axis_angle(R)
        fractions = sorted({k / n for n in range(2, self.max_order + 1) for k in range(1, n // 2 + 1)})
        return _turn(axis, 2.0 * math.pi * min(fractions, key=lambda f: abs(angle - 2.0 * math.pi * f)))


def _moments(triangles: np.ndarray, area: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centroid (3,), variances (3,) and principal axes (3, 3) in columns, of the area. Of a triangle the integral of x
    xᵀ is its area / 12 times (Σ v vᵀ + s sᵀ), with s the sum of its corners v."""
    weight = area / area.sum()
    center = weight @ triangles.mean(1)
    v = triangles - center
    s = v.sum(1)
    covariance = (np.einsum("f,fki,fkj->ij", weight, v, v) + np.einsum("f,fi,fj->ij", weight, s, s)) / 12.0
    variances, axes = np.linalg.eigh(covariance)
    return center, variances, axes


def _turn(axis: np.ndarray, angle: float) -> np.ndarray:
    return about(torch.from_numpy(axis.copy()), torch.tensor([angle], dtype=torch.float64))[0].numpy()


def _axis_angle(R: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the unit axis and the angle, 0 … π."""
    # R + Rᵀ has the axis as its eigenvector with the largest eigenvalue, at all angles but 0.
    axis = np.linalg.eigh(R + R.T)[1][:, 2]
    about_it = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    angle = math.atan2(0.5 * np.linalg.norm(about_it), 0.5 * (np.trace(R) - 1.0))
    return (-axis if axis @ about_it < 0.0 else axis), angle


def _rotations(count: int) -> np.ndarray:
    """Return rotations (count, 3, 3), evenly over all of them: super-Fibonacci spirals (Alexa 2022)."""
    s = np.arange(count) + 0.5
    t, phi, psi = s / count, math.sqrt(2.0), 1.533751168755204288118041
    alpha, beta = 2.0 * math.pi * s / phi, 2.0 * math.pi * s / psi
    r, q = np.sqrt(t), np.sqrt(1.0 - t)
    x, y, z, w = r * np.sin(alpha), r * np.cos(alpha), q * np.sin(beta), q * np.cos(beta)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
