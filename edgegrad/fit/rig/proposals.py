"""Limbs, and poses that outlines hardly separate from another one, and that no descent from that one reaches.

Two limbs of one build, as two legs, may each be where the other one is; joints in a row may share a rotation about their axes
otherwise.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ...rig.joints import Joints
from ...rig.rig import Rig
from ...rig.rotations import roma
from ...rig.skinned import SkinDeformer
from .free_parameters import FreeParameters
from .settings import RIG


@dataclass(frozen=True)
class Limb:
    """Rows that are drawn together."""

    rows: list[int]
    twins: tuple[list[int], list[int]] | None = None  # rows of two limbs of one build


def limbs(rig: Rig, rows: Sequence[int]) -> list[Limb]:
    """Return each of the joints `rows` with those below it, as places in `rows`; and pairs that hang on one joint, as two
    legs do."""
    parents, whole, found = rig.deformer.parents, {}, []
    for row in rows:
        group = [place for place, other in enumerate(rows) if row in _above(parents, other)]
        if len(group) <= max(1.0, RIG.limb_share * len(rows)):
            whole[row] = group
        found.append(Limb(whole.get(row, [list(rows).index(row)])))
    for a, b in itertools.combinations(whole, 2):
        one, other = whole[a], whole[b]
        if parents[a] == parents[b] and len(one) > 1 and _hung(parents, rows, one) == _hung(parents, rows, other):
            found.append(Limb([*one, *other], (one, other)))
    return found


def _above(parents: Sequence[int], joint: int) -> list[int]:
    """Return a joint and all that it hangs on."""
    found = [joint]
    while parents[found[-1]] >= 0:
        found.append(parents[found[-1]])
    return found


def _hung(parents: Sequence[int], rows: Sequence[int], limb: Sequence[int]) -> list[int]:
    """Return for each joint of a limb which of these it hangs on, −1 for none."""
    places = {rows[place]: k for k, place in enumerate(limb)}
    return [places.get(parents[rows[place]], -1) for place in limb]


@dataclass(frozen=True, eq=False)
class AxialRotation:
    """A rotation of a joint about the line to its child, which is rotated back; without a child, about its own limb."""

    row: int
    child: int | None
    axis: Tensor  # (3,) along the joint's own axes, of length 1


@dataclass(frozen=True)
class Proposals:
    """Other values of the rotation vectors `name`, given those that are sought."""

    rig: Rig
    free: FreeParameters
    name: str

    @property
    def joints(self) -> Joints | None:
        """The joints; None where a rig does not say how they hang."""
        return self.rig.deformer.joints if isinstance(self.rig.deformer, SkinDeformer) else None

    @property
    def places(self) -> Tensor:
        """The places of the sought rows among all joints."""
        return self.free.rows[self.name]

    @property
    def rest(self) -> Tensor:
        """The sought rows at rest."""
        return self.rig.controls[self.name].rest[self.places]

    @cached_property
    def limbs(self) -> list[Limb]:
        """The limbs of the rows that are sought; each row by itself where a rig does not say what hangs on what."""
        rows = range(len(self.places))
        if not self.rig.deformer.parents:
            return [Limb([k]) for k in rows]
        if self.name == "angles":
            return [Limb([*rows[k:]]) for k in rows]
        return limbs(self.rig, self.places.tolist())

    def exchanged(self, values: Mapping[str, Tensor], one: Sequence[int], other: Sequence[int]) -> Tensor:
        """Put two groups of rows each where the other one is. Without joints, rows take their counterparts' rotation
        vectors."""
        both = [*one, *other]
        if self.joints is None:
            value = values[self.name].clone()
            value[both] = value[[*other, *one]]
            return value
        rotations, every = self._rotations(values), self.free.all(values)
        ours, theirs = (self.places[list(limb)].tolist() for limb in (one, other))
        found = exchanged(self.joints, rotations, ours, theirs, every["joint_translations"], every["joint_scales"])
        return self._changed(values, found, both)

    def axial_rotations(self, values: Mapping[str, Tensor]) -> list[AxialRotation]:
        """Return those of each sought joint on which one other hangs, of those that are sought, or none."""
        if self.joints is None:
            return []
        places, parents = self.places.tolist(), self.joints.parents
        row_of = {place: row for row, place in enumerate(places)}
        moved = {joint for place in places for joint in _above(parents, place)}  # what has a sought joint below it
        found = []
        for row, place in enumerate(places):
            branches = [j for j, parent in enumerate(parents) if parent == place and j in moved]
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
        rotations = self._rotations(values)
        at, rows = int(self.places[rotation.row]), [rotation.row]
        Q = roma().rotvec_to_rotmat(angle * rotation.axis)
        found = rotations.clone()
        found[at] = rotations[at] @ Q
        if rotation.child is not None:
            below = int(self.places[rotation.child])
            hung = self.joints.rotations[below]
            found[below] = hung.mT @ Q.mT @ hung @ rotations[below]
            rows.append(rotation.child)
        return self._changed(values, found, rows)

    def about_bone(
        self, values: Mapping[str, Tensor], rotation: AxialRotation, angles: Sequence[float]
    ) -> list[Tensor]:
        """Rotate by each of these angles to both sides, and across a flat limb."""
        angles = (*angles, *([RIG.flat_angle] if rotation.child is None else []))
        return [self.with_rotation(values, rotation, side * angle) for angle in angles for side in (-1.0, 1.0)]

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

    def _rotations(self, values: Mapping[str, Tensor]) -> Tensor:
        """Return the rotation matrices (J, 3, 3)."""
        return roma().rotvec_to_rotmat(self.free.all(values)[self.name].double())

    def _changed(self, values: Mapping[str, Tensor], rotations: Tensor, rows: list[int]) -> Tensor:
        value = values[self.name].clone()
        value[rows] = roma().rotmat_to_rotvec(rotations[self.places[rows]]).to(value)
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
