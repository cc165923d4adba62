"""Ambiguous poses: those that outlines hardly separate from another one, and that no descent from that one reaches.

Two limbs of one build, as two legs, may each be where the other one is; joints in a row may share a rotation about their axes
otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...rig.joints import Joints
from ...rig.rig import Rig
from ...rig.rotations import roma
from ...rig.skinned import SkinDeformer
from .free_parameters import FreeParameters


@dataclass(frozen=True, eq=False)
class AxialRotation:
    """A rotation of a joint about the line to its child, which is rotated back; without a child, about its own limb."""

    row: int
    child: int | None
    axis: Tensor  # (3,) along the joint's own axes, of length 1


@dataclass(frozen=True)
class Alternatives:
    """Other values of the rotation vectors `name`, given those that are sought."""

    rig: Rig
    free: FreeParameters
    name: str

    @property
    def joints(self) -> Joints | None:
        """The joints; None where a rig does not say how they hang."""
        return self.rig.deformer.joints if isinstance(self.rig.deformer, SkinDeformer) else None

    def exchanged(self, values: Mapping[str, Tensor], one: Sequence[int], other: Sequence[int]) -> Tensor:
        """Put two groups of rows each where the other one is. Without joints, rows take their counterparts' rotation
        vectors."""
        both = [*one, *other]
        if self.joints is None:
            value = values[self.name].clone()
            value[both] = value[[*other, *one]]
            return value
        rotations, every = self._rotations(values), self.free.all(values)
        ours, theirs = (self._places(values)[list(limb)].tolist() for limb in (one, other))
        found = exchanged(self.joints, rotations, ours, theirs, every["joint_translations"], every["joint_scales"])
        return self._changed(values, found, both)

    def axial_rotations(self, values: Mapping[str, Tensor]) -> list[AxialRotation]:
        """Return those of each sought joint on which one other hangs, of those that are sought, or none."""
        if self.joints is None:
            return []
        places = self._places(values).tolist()
        row_of, below = {place: row for row, place in enumerate(places)}, dict.fromkeys(range(len(self.joints)), 0)
        for place in places:
            at = self.joints.parents[place]
            while at >= 0:
                below[at] += 1
                at = self.joints.parents[at]
        found = []
        for row, place in enumerate(places):
            branches = [
                j for j, parent in enumerate(self.joints.parents) if parent == place and (below[j] or j in row_of)
            ]
            if not branches:
                along = self._middle(place)
            elif len(branches) == 1 and branches[0] in row_of:
                along = self.free.all(values)["joint_translations"][branches[0]]
            else:
                continue
            if float(along.norm()) > 0.0:
                found.append(AxialRotation(row, row_of[branches[0]] if branches else None, along / along.norm()))
        return found

    def with_rotation(self, values: Mapping[str, Tensor], rotation: AxialRotation, angle: float) -> Tensor:
        """Rotate by so many radians. What hangs on the child stays as it is."""
        assert self.joints is not None
        places, rotations = self._places(values), self._rotations(values)
        at, rows = int(places[rotation.row]), [rotation.row]
        Q = roma().rotvec_to_rotmat(angle * rotation.axis)
        found = rotations.clone()
        found[at] = rotations[at] @ Q
        if rotation.child is not None:
            below = int(places[rotation.child])
            hung = self.joints.rotations[below]
            found[below] = hung.mT @ Q.mT @ hung @ rotations[below]
            rows.append(rotation.child)
        return self._changed(values, found, rows)

    def _middle(self, place: int) -> Tensor:
        """Return the weighted mean (3,) of the vertices that hang on a joint, from it, along its own axes at rest."""
        assert isinstance(self.rig.deformer, SkinDeformer)
        total, count = torch.zeros(3, dtype=torch.float64), 0.0
        for skin, mesh in zip(self.rig.deformer.skins, self.rig.meshes, strict=True):
            for k in (skin.joints == place).nonzero()[:, 0].tolist():
                weights, bind = skin.weights[:, k].double(), skin.inverse_binds[k]
                total = total + (weights[:, None] * (mesh.verts.double() @ bind[:3, :3].mT + bind[:3, 3])).sum(0)
                count += float(weights.sum())
        return total / max(count, 1e-12)

    def _places(self, values: Mapping[str, Tensor]) -> Tensor:
        """Return the places of the rows among all joints."""
        return self.free.rows.get(self.name, torch.arange(len(values[self.name])))

    def _rotations(self, values: Mapping[str, Tensor]) -> Tensor:
        """Return the rotation matrices (J, 3, 3)."""
        return roma().rotvec_to_rotmat(self.free.all(values)[self.name].double())

    def _changed(self, values: Mapping[str, Tensor], rotations: Tensor, rows: list[int]) -> Tensor:
        value = values[self.name].clone()
        value[rows] = roma().rotmat_to_rotvec(rotations[self._places(values)[rows]]).to(value)
        return value


def exchanged(
    joints: Joints, rotations: Tensor, one: Sequence[int], other: Sequence[int],
    translations: Tensor | None = None, scales: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """Return the rotations (J, 3, 3) of all joints, as Joints.world() takes them, with two limbs exchanged.

    one, other   joints of the two limbs, each with its parents before it, in one order

    Each joint rotates from rest as its counterpart does, and then by the smallest rotation that points it to where the
    counterpart's children are.
    """
    rest, before = (joints.world(R, translations, scales) for R in (None, rotations))
    turned, upright = _orientations(before), _orientations(rest)
    found = rotations.clone()
    for ours, theirs in ((one, other), (other, one)):
        for j, twin in zip(ours, theirs, strict=True):
            after = joints.world(found, translations, scales)
            orientation = turned[twin] @ upright[twin].mT @ upright[j]
            below = [(a, b) for a, b in zip(ours, theirs, strict=True) if joints.parents[a] == j]
            if below:
                own, wanted = [a for a, _ in below], [b for _, b in below]
                along = orientation @ upright[j].mT @ (rest[own, :3, 3].mean(0) - rest[j, :3, 3])
                orientation = _smallest(along, before[wanted, :3, 3].mean(0) - after[j, :3, 3]) @ orientation
            parent = joints.parents[j]
            above = torch.eye(3).to(orientation) if parent < 0 else _orientations(after)[parent]
            found[j] = (above @ joints.rotations[j]).mT @ orientation
    return found


def _orientations(world: Tensor) -> Tensor:
    """Return the rotations (J, 3, 3) without stretch."""
    return roma().special_procrustes(world[:, :3, :3])


def _smallest(along: Tensor, wanted: Tensor) -> Tensor:
    """Return the rotation (3, 3) by the smallest angle from one direction (3,) to another."""
    axis = torch.linalg.cross(along, wanted)
    angle = torch.atan2(axis.norm(), along @ wanted)
    return roma().rotvec_to_rotmat(angle * axis / axis.norm().clamp(min=1e-12))
