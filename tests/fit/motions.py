"""Motions of a whole scene, and renders with their derivatives by them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import edgegrad as eg
from edgegrad.fit.pose.jacobian import Motion, Rendered, cross_matrices


def about(center: Tensor, axes: Tensor | None = None, size: float = 1.0) -> Motion:
    """Return six directions: rotations in radians about a centre (3,) around the axes, the rows of (3, 3) or those of the world,
    and shifts along them in units of `size`."""
    along = torch.eye(3, dtype=torch.float64) if axes is None else axes.double()
    turns = cross_matrices(along)
    return Motion(torch.cat([turns, torch.zeros_like(turns)]), torch.cat([-turns @ center.double(), size * along]))


def derivatives(
    scene: eg.Scene, camera: eg.Camera, aovs: Sequence[str], motion: Motion, spp: int = 16, seed: int = 0
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return channels (H, W, c) by name, and their derivatives (D, H, W, c) by the motion."""
    rendered = Rendered(scene, camera, aovs, spp, seed)
    return rendered.images, rendered.derivatives(motion)
