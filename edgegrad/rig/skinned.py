"""Meshes that joints move by skins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..check import check_choice
from ..scene.mesh import Mesh
from .control import Control
from .joints import Joints
from .skin import SKINNINGS, Skin


@dataclass(frozen=True, eq=False)
class SkinDeformer:
    """Joints, and a skin for each mesh."""

    joints: Joints
    skins: tuple[Skin, ...]
    controls: Mapping[str, Control]

    @staticmethod
    def from_skins(joints: Joints, skins: tuple[Skin, ...], morphs: tuple[str, ...], weights: Tensor) -> SkinDeformer:
        """Return the deformer at rest, of checked skins."""
        assert isinstance(joints.stretches, Tensor)
        names, J = tuple(joints.names), len(joints)
        controls = {
            "rotations": Control(torch.zeros(J, 3, dtype=torch.float64), names=names, rotates=True),
            "joint_translations": Control(joints.translations, names=names),
            "joint_scales": Control(joints.stretches.diagonal(dim1=-2, dim2=-1), names=names),
        }
        if morphs:
            controls["morphs"] = Control(weights, names=morphs)
        return SkinDeformer(joints, skins, controls)

    @property
    def parents(self) -> tuple[int, ...]:
        return tuple(self.joints.parents)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.joints.names)

    def with_controls(self, controls: Mapping[str, Control]) -> SkinDeformer:
        return replace(self, controls=controls)

    def __call__(
        self, values: Mapping[str, Tensor], meshes: Sequence[Mesh], skinning: str = "linear"
    ) -> tuple[list[Tensor], list[Tensor | None], Tensor]:
        check_choice("skinning", skinning, SKINNINGS)
        world = self.joints.world(values.get("rotations"), values.get("joint_translations"), values.get("joint_scales"))
        morphs = values.get("morphs", self.controls["morphs"].rest if "morphs" in self.controls else world.new_zeros(0))
        found = [
            skin.bent(world, morphs, mesh.verts, mesh.normals, skinning)
            for skin, mesh in zip(self.skins, meshes, strict=True)
        ]
        return [verts for verts, _ in found], [normals for _, normals in found], world[..., :3, 3]
