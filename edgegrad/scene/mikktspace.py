"""Tangents at the corners of faces as MikkTSpace averages them, which glTF requires (M. S. Mikkelsen, Simulation of Wrinkled
Surfaces Revisited, 2008, chapter 3.2, and his mikktspace.c of 2011).

Corners share a tangent if their position, normal and texture coordinates are equal and faces with the same handedness connect
them around that vertex. Each face's ∂x/∂u, projected onto the plane of the vertex normal, counts by the face's angle there.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

Rows = tuple[np.ndarray, np.ndarray]  # values (N, K), and the indices (F, 3) of corners of faces


class Fans(NamedTuple):
    """The corners of faces that share a tangent."""

    of_corner: Tensor  # (F, 3) int32, from 0
    hand: Tensor  # (F,) float64, −1 where the image is mirrored on the face
    counts: Tensor  # (F,) bool: whether the face has an area in the texture

    @classmethod
    def from_corners(cls, position: Rows, normal: Rows, uv: Rows) -> Fans:
        """Return the fans of faces whose corners have these values (N, K), by indices (F, 3)."""
        (_, faces), (_, normal_faces), (coordinates, uv_faces) = position, normal, uv
        place, turn, image = (same_rows(values) for values, _ in (position, normal, uv))
        same = np.array_equal(faces, normal_faces) and np.array_equal(faces, uv_faces)
        if same and len(place) == len(turn) == len(image):
            vertex = _pairs(_pairs(place, turn), image)[faces]
        else:
            vertex = _pairs(_pairs(place[faces], turn[normal_faces]), image[uv_faces])
        at = coordinates.astype(np.float64)[uv_faces]
        (u1, v1), (u2, v2) = ((at[:, k] - at[:, 0]).T for k in (1, 2))
        area = u1 * v2 - v1 * u2
        # Areas this small are rounding errors of the float32 coordinates in files.
        flat = np.abs(area) <= 2.0**-22 * (np.abs(u1 * v2) + np.abs(v1 * u2))
        hand = np.where(flat, 0, np.sign(area)).astype(np.int8)
        own = place[faces]
        solid = (own != np.roll(own, 1, 1)).all(1)
        fan, hand = _fans(vertex.astype(np.int32).tobytes(), hand.tobytes(), solid.tobytes())
        return cls(torch.from_numpy(fan), torch.from_numpy(hand), torch.from_numpy(~flat))

    def tangents(self, corners: Tensor, normal: Tensor, uv: Tensor) -> Tensor:
        """Return unit tangents at the corners and the handedness, (F, 3, 4) float64, differentiable; zero where there is no
        tangent. The corners are (F, 3, 3), with normals of any length and texture coordinates (F, 3, 2)."""
        n = _unit(normal.double().permute(2, 0, 1))
        p, uv = corners.double().permute(2, 0, 1).contiguous(), uv.double()
        along = tangents(corners.double(), uv)[0].T[:, :, None]
        on_face = _unit(along - n * _dot(n, along))
        # The angle between the edges a and b of a corner, seen along its normal: their cross product there is that of their
        # projections.
        a, b = p.roll(-1, 2) - p, p.roll(-2, 2) - p
        sine, cosine = _dot(n, torch.linalg.cross(a, b, dim=0)).abs(), _dot(a, b) - _dot(n, a) * _dot(n, b)
        some = (sine > 0) & self.counts.to(p.device)[:, None]
        weight = torch.where(some, torch.atan2(torch.where(some, sine, 1.0), cosine), 0.0)
        fan = self.of_corner.to(p.device).reshape(-1)
        total = p.new_zeros((3, int(fan.max()) + 1)).index_add(1, fan, (weight * on_face).reshape(3, -1))
        hand = self.hand.to(p)[:, None].expand(-1, 3)
        return torch.stack([*_unit(total).index_select(1, fan).reshape(3, -1, 3), hand], -1)


def tangents(corners: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Return ∂x/∂u times the determinant's size, and its sign, of faces with corners (N, 3, 3) and texture coordinates (N, 3,
    2)."""
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    d1, d2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    determinant = (d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0])[:, None]
    sign = torch.where(determinant.detach() < 0, -1.0, 1.0).to(uv)
    return sign * (d2[:, 1:2] * e1 - d1[:, 1:2] * e2), sign


@lru_cache(maxsize=8)  # each step of a fit asks for the same
def _fans(vertices: bytes, hands: bytes, solids: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return numbers (F, 3) of fans and the handedness (F,). The input is the vertices (F, 3) int32 of faces, their handedness
    (F,) int8, 0 where there is none, and whether they have three different corners (F,) bool: others join nothing."""
    vertex = np.frombuffer(vertices, np.int32).astype(np.int64).reshape(-1, 3)
    hand = np.frombuffer(hands, np.int8).astype(np.float64)
    face, corner, other, other_corner = _neighbours(vertex, np.frombuffer(solids, bool))
    begin, end = 3 * face + corner, 3 * other + (other_corner + 1) % 3
    while True:
        joins = hand[face] == hand[other]
        fan = _components(vertex.size, begin[joins], end[joins])
        # A face without an area in the texture takes the handedness of the first fan that reaches it.
        open_ = np.flatnonzero((hand[face] == 0) & (hand[other] != 0))
        if not len(open_):
            break
        first = np.minimum(fan[end], fan[3 * other + other_corner])[open_]
        open_ = open_[np.argsort(-first, kind="stable")]  # of what is written to one place the last stays
        hand[face[open_]] = hand[other[open_]]
    number = np.cumsum(fan == np.arange(len(fan))) - 1
    return number[fan].reshape(-1, 3).astype(np.int32), np.where(hand < 0, -1.0, 1.0)


def same_rows(rows: np.ndarray) -> np.ndarray:
    """Return equal numbers (N,) int64 for equal rows (N, K)."""
    order = np.lexsort(rows.T)
    ordered = rows[order]
    found = np.empty(len(rows), np.int64)
    found[order] = np.cumsum(np.r_[False, (ordered[1:] != ordered[:-1]).any(1)])
    return found


def _pairs(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return equal numbers from 0 for equal pairs of numbers, of which there are some 2³¹."""
    return np.unique(a * (int(b.max(initial=0)) + 1) + b, return_inverse=True)[1].reshape(a.shape)


def _neighbours(vertex: np.ndarray, solid: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return pairs of faces that run along an edge in opposite directions, each twice. They are given as face, the corner at
    which its edge begins, and the same of the other. Of more than two faces at an edge, each one has one partner."""
    face, corner = np.repeat(np.arange(len(vertex)), 3), np.tile(np.arange(3), len(vertex))
    begin, end = vertex[face, corner], vertex[face, (corner + 1) % 3]
    edge, runs_up = _pairs(np.minimum(begin, end), np.maximum(begin, end)), begin < end
    order = np.argsort(2 * edge + runs_up, kind="stable")
    order = order[solid[face[order]]]
    # The first of those that run up belongs to the first of those that run down.
    starts = np.r_[0, np.flatnonzero(np.diff((2 * edge + runs_up)[order])) + 1]
    number = np.arange(len(order)) - np.repeat(starts, np.diff(np.r_[starts, len(order)]))
    key = _pairs(edge[order], number)
    up = runs_up[order]
    _, i, j = np.intersect1d(key[up], key[~up], assume_unique=True, return_indices=True)
    one, two = order[up][i], order[~up][j]
    first, second = np.r_[one, two], np.r_[two, one]
    return face[first], corner[first], face[second], corner[second]


def _components(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the smallest number (count,) that pairs a–b connect each number with."""
    label = np.arange(count)
    while True:
        low, high = np.minimum(label[a], label[b]), np.maximum(label[a], label[b])
        if np.array_equal(low, high):
            return label
        np.minimum.at(label, high, low)
        while not np.array_equal(label, label[label]):
            label = label[label]


def _dot(a: Tensor, b: Tensor) -> Tensor:
    (a0, a1, a2), (b0, b1, b2) = a.unbind(), b.unbind()
    return a0 * b0 + a1 * b1 + a2 * b2


def _unit(v: Tensor) -> Tensor:
    """Return vectors (3, …) with the length 1; zero, without a derivative, where they have no direction."""
    squared = _dot(v, v)
    some = squared > 0
    return v * torch.where(some, torch.where(some, squared, 1.0).rsqrt(), 0.0)
