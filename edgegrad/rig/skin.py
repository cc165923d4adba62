"""Vertices that joints move: morph targets, then blended transformations."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ..check import as_double, as_tensor, check_finite
from .rotations import roma

RIGID = 1e-3  # of a joint's transformation from a rotation with one scale
SKINNINGS = ("linear", "dual quaternion")


@dataclass(frozen=True, eq=False)
class Skin:
    """The binding of a mesh to joints.

    Parameters
    ----------
    joints : (n,)
        Their places among all joints of the rig.
    inverse_binds : (n, 4, 4)
        From the mesh's coordinates to each joint's own.
    weights : (V, n)
        From 0; rows are divided by their sums, which must not be zero.
    morphs : int, default 0
        Place of its first morph among the rig's.
    targets : (M, V, 3), default no morphs
        How far a morph of weight 1 moves each vertex.
    normal_targets : (M, N, 3)
        How far it moves each normal.
    normal_verts : (N,), default the vertices
        The vertex of each normal.
    """

    joints: Tensor
    inverse_binds: Tensor
    weights: Tensor
    morphs: int = 0
    targets: Tensor | None = None
    normal_targets: Tensor | None = None
    normal_verts: Tensor | None = None

    def checked(self, name: str, joints: int, verts: Tensor, normals: Tensor | None) -> Skin:
        """Return the checked skin of a mesh, in its type. Raises TypeError or ValueError."""
        index = as_tensor(f"{name}: joints", self.joints).long()
        n, V = len(index), len(verts)
        weights = as_double(f"{name}: weights", self.weights, (V, n))
        inverse_binds = as_double(f"{name}: inverse_binds", self.inverse_binds, (n, 4, 4))
        if n and not bool(((index >= 0) & (index < joints)).all()):
            raise ValueError(f"{name}: joints: expected places from 0 to {joints - 1}, got {index.tolist()}")
        total = weights.sum(1, keepdim=True)
        if bool((weights < 0.0).any()) or bool((total <= 0.0).any()):
            bad = int(((weights < 0.0).any(1) | (total[:, 0] <= 0.0)).nonzero()[0])
            raise ValueError(
                f"{name}: weights: expected numbers from 0, not all 0 in a row, got {weights[bad].tolist()} at [{bad}]"
            )
        rows = V if normals is None else len(normals)
        owners = None if self.normal_verts is None else as_tensor(f"{name}: normal_verts", self.normal_verts).long()
        targets = _targets(f"{name}: targets", self.targets, V, verts)
        of_normals = None if normals is None else _targets(f"{name}: normal_targets", self.normal_targets, rows, verts)
        return Skin(index, inverse_binds, (weights / total).to(verts), self.morphs, targets, of_normals, owners)

    def bent(
        self, world: Tensor, morphs: Tensor, verts: Tensor, normals: Tensor | None, skinning: str
    ) -> tuple[Tensor, Tensor | None]:
        """Return vertices (…, V, 3) and normals (…, N, 3) by the joints' world transformations and morph weights.

        These are (…, J, 4, 4) and (…, M).
        """
        # Double is needed: a joint may be far from the origin, and its inverse bind takes it back.
        A = (world.index_select(-3, self.joints) @ self.inverse_binds)[..., :3, :]
        bases, turns = (_linear if skinning == "linear" else _dual_quaternion)(A, self.weights, normals is not None)
        points = _morphed(verts, self.targets, morphs, self.morphs)
        bent = (bases[..., :3] * points[..., None, :]).sum(-1) + bases[..., 3]
        if normals is None or turns is None:
            return bent, None
        turns = turns if self.normal_verts is None else turns.index_select(-3, self.normal_verts)
        n = _morphed(normals, self.normal_targets, morphs, self.morphs)
        return bent, F.normalize((turns * n[..., None, :]).sum(-1), dim=-1)


def _targets(name: str, given: Tensor | None, rows: int, like: Tensor) -> Tensor | None:
    if given is None:
        return None
    targets = as_tensor(name, given, floating=True).detach().to(like)
    if targets.dim() != 3 or targets.shape[1:] != (rows, 3):
        raise ValueError(
            f"{name}: expected shape (M, {rows}, 3), as many rows as the mesh has, got {tuple(targets.shape)}; export the morph "
            "targets again with the mesh"
        )
    check_finite(name, targets)
    return targets if len(targets) else None


def _morphed(rows: Tensor, targets: Tensor | None, morphs: Tensor, first: int) -> Tensor:
    """Return p + Σ wₖ dₖ, (…, V, 3)."""
    if targets is None:
        return rows
    own = morphs[..., first : first + len(targets)].to(rows)
    return rows + (own @ targets.flatten(1)).unflatten(-1, rows.shape)


def _linear(A: Tensor, weights: Tensor, normals: bool) -> tuple[Tensor, Tensor | None]:
    """Return linear blend skinning: Σ w A (…, V, 3, 4) of points, and the cofactors (…, V, 3, 3) of its linear part of normals,
    where they are asked for."""
    bases = (weights @ A.flatten(-2).to(weights)).unflatten(-1, (3, 4))
    if not normals:
        return bases, None
    a, b, c = bases[..., :3].unbind(-2)
    cross = torch.linalg.cross
    # The inverse transpose times the determinant: it is there for any matrix. In a mirror normals keep their side.
    cofactors = torch.stack([cross(b, c), cross(c, a), cross(a, b)], -2)
    side = torch.where((a * cofactors[..., 0, :]).sum(-1) < 0.0, -1.0, 1.0)
    return bases, cofactors * side[..., None, None]


def _dual_quaternion(A: Tensor, weights: Tensor, normals: bool) -> tuple[Tensor, Tensor]:
    """Return the same by dual-quaternion blending (Kavan, Collins, Žára and O'Sullivan, Skinning with Dual Quaternions, 2007)
    of rigid transformations with one scale each, which is blended apart. Raises ValueError for others."""
    L, t = A[..., :3], A[..., 3]
    scale = torch.linalg.det(L).clamp(min=1e-30) ** (1.0 / 3.0)
    R = L / scale[..., None, None]
    stray = float((R @ R.mT - torch.eye(3).to(R)).abs().max().detach())
    if not stray < RIGID:
        raise ValueError(
            'skinning: expected joints that turn and shift, with one scale for all axes, as "dual quaternion" needs, got '
            f'some that stretch by {stray:.2g} or mirror; take "linear"'
        )
    lib = roma()
    q = lib.rotmat_to_unitquat(R)  # x, y, z, w
    dual = 0.5 * lib.quat_product(torch.cat([t, torch.zeros_like(t[..., :1])], -1), q)
    # q and −q are one rotation: all on the side of the joint that a vertex hangs on most.
    first = q.index_select(-2, weights.argmax(1))
    signs = torch.where(first @ q.mT < 0.0, -1.0, 1.0).to(weights)
    w = weights * signs
    both = w @ torch.cat([q, dual], -1).to(weights)
    length = both[..., :4].norm(dim=-1, keepdim=True)
    real, moved = both[..., :4] / length, both[..., 4:] / length
    shift = 2.0 * lib.quat_product(moved, lib.quat_conjugation(real))[..., :3]
    turns = lib.unitquat_to_rotmat(real)
    size = weights @ scale[..., None].to(weights)
    return torch.cat([size[..., None] * turns, shift[..., None]], -1), turns
