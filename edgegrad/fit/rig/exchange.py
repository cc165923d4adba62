"""Two limbs of one build, as two legs, each put where the other one is.

Where limbs cross, outlines hardly tell one from the other, and a descent from one of the two poses does not reach the other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from ...rig.joints import Joints
from ...rig.rig import Rig
from ...rig.rotations import roma
from ...rig.skinned import Skinned
from .sought import Sought

Exchange = Callable[[Mapping[str, Tensor], Sequence[int], Sequence[int]], Tensor]


def exchange_of(rig: Rig, sought: Sought, name: str) -> Exchange:
    """Of values that are sought, the value `name`, rotation vectors, with two groups of its rows exchanged. Where a rig does not
    say how its joints hang, each row takes its counterpart's rotation vector."""
    joints = rig.deformer.joints if isinstance(rig.deformer, Skinned) else None

    def places_exchanged(values: Mapping[str, Tensor], one: Sequence[int], other: Sequence[int]) -> Tensor:
        value = values[name].clone()
        if joints is None:
            value[[*one, *other]] = value[[*other, *one]]
            return value
        rows = sought.rows.get(name, torch.arange(len(value)))
        every = sought.all(values)
        rotations = roma().rotvec_to_rotmat(every[name].double())
        ours, theirs = (rows[list(limb)].tolist() for limb in (one, other))
        found = exchanged(joints, rotations, ours, theirs, every["joint_translations"], every["joint_scales"])
        both = [*one, *other]
        value[both] = roma().rotmat_to_rotvec(found[rows[both]]).to(value)
        return value

    return places_exchanged


def exchanged(
    joints: Joints, rotations: Tensor, one: Sequence[int], other: Sequence[int],
    translations: Tensor | None = None, scales: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """(J, 3, 3) rotations of all joints, as Joints.world() takes them.

    one, other   joints of the two limbs, each with its parents before it, in one order

    Each joint turns from rest as its counterpart does, and then by the smallest rotation that points it to where the
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
    """(J, 3, 3) without what stretches."""
    return roma().special_procrustes(world[:, :3, :3])


def _smallest(along: Tensor, wanted: Tensor) -> Tensor:
    """(3, 3), the rotation by the smallest angle that turns one direction (3,) to another."""
    axis = torch.linalg.cross(along, wanted)
    angle = torch.atan2(axis.norm(), along @ wanted)
    return roma().rotvec_to_rotmat(angle * axis / axis.norm().clamp(min=1e-12))
