"""Environments that a scene shows behind all surfaces."""

from __future__ import annotations

import torch
from torch import Tensor

from ..camera.poses import constant
from ..kernel.derivatives import moves
from ..scene.environment import Environment
from .image_context import ImageContext

PIXELS_AT_ONCE = 1 << 16  # pixels whose rays are in memory at a time


def environments(context: ImageContext) -> Tensor | None:
    """Return the image (H, W, C) of the visible environments, each pixel the mean of four rays; None if there are none, or a
    background."""
    scene = context.surfaces.scene
    shown = [light for light in scene.lights if isinstance(light, Environment) and light.visible]
    if scene.background is not None or not shown:
        return None
    y, x = torch.meshgrid(torch.arange(context.height), torch.arange(context.width), indexing="ij")
    corner = torch.stack([x, y], -1).reshape(-1, 2).double()
    offsets = torch.tensor([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]], dtype=torch.float64)
    back = torch.linalg.inv(context.view.world_to_camera[:3, :3])
    parts = []
    for pixels in corner.split(PIXELS_AT_ONCE):
        rays = context.sampler.rays_at((pixels[:, None] + offsets).reshape(-1, 2))
        along = rays.along
        if moves(context.intrinsics):
            along = along + rays.along_by_k @ (context.intrinsics - context.intrinsics.detach())
        if not context.view.perspective:
            along = torch.zeros_like(along) + constant([0.0, 0.0, 1.0], along)
        direction = context.here(along) @ back.mT
        total = torch.stack([light.towards(direction).expand(-1, scene.channels) for light in shown]).sum(0)
        parts.append(total.reshape(len(pixels), 4, -1).mean(1))
    return torch.cat(parts).reshape(context.height, context.width, -1).to(context.dtype)
