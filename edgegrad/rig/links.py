"""Links of a robot, which its joints move as rigid bodies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ..scene.mesh import Mesh
from .control import Control


@dataclass(frozen=True, eq=False)
class RobotLinks:
    """A chain of pytorch-kinematics, and the link that carries each mesh, whose vertices are in the link's coordinates."""

    chain: Any  # pytorch_kinematics.Chain, float64
    carries: tuple[int, ...]  # by mesh, the place of its link
    names: tuple[str, ...]  # of links
    parents: tuple[int, ...]
    couple: Tensor  # (n, m) by which the chain's n joints follow the m angles, and
    offset: Tensor  # (n,)
    controls: Mapping[str, Control]

    def with_controls(self, controls: Mapping[str, Control]) -> RobotLinks:
        return replace(self, controls=controls)

    def __call__(
        self, values: Mapping[str, Tensor], meshes: Sequence[Mesh]
    ) -> tuple[list[Tensor], list[Tensor | None], Tensor]:
        angles = values.get("angles", self.controls["angles"].rest)
        every = torch.atleast_2d(angles @ self.couple.T + self.offset)
        # Its own backward pass has no forward mode.
        frames = self.chain.forward_kinematics_tensor(every, analytical_grad=False)
        places = self.chain.get_frame_indices(*self.names)
        world = frames[places].movedim(0, 1)  # (B, L, 4, 4)
        world = world.squeeze(0) if angles.dim() == 1 else world
        verts, normals = [], []
        for mesh, link in zip(meshes, self.carries, strict=True):
            R, t = world[..., link, :3, :3].to(mesh.verts), world[..., link, :3, 3].to(mesh.verts)
            verts.append(mesh.verts @ R.mT + t[..., None, :])
            normals.append(None if mesh.normals is None else mesh.normals @ R.mT.to(mesh.normals))
        return verts, normals, world[..., :3, 3]
