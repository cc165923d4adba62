"""Warnings of scenes that other libraries' conventions make: allowed, but hardly ever meant."""

from __future__ import annotations

import torch
from torch import Tensor

from ..check import values_visible
from ..warnings import warn

BYTES = 16.0, 255.0  # the largest of whole numbers that are bytes rather than radiance


def warn_if_behind(verts: Tensor, world_to_camera: Tensor) -> None:
    """Warn where all vertices (V, 3) lie behind each of the cameras (B, 4, 4)."""
    if not values_visible(verts, world_to_camera):
        return
    # One vertex is tested first, in numbers of Python, because a small scene renders in a millisecond.
    # Tensors under torch.func have no tolist() in torch 2.9 and before.
    first, row = [x.item() for x in verts[0]], [x.item() for x in world_to_camera[0, 2]]
    if sum(a * b for a, b in zip(first, row, strict=False)) + row[3] > 0.0:
        return
    with torch.no_grad():
        ahead, shift = world_to_camera[:, 2, :3], world_to_camera[:, 2, 3:]
        depth = float((verts @ ahead.mT + shift.mT).max())
    if depth <= 0.0:
        warn(
            "behind the camera",
            f"world_to_camera: all vertices lie behind the camera (Z up to {depth:.3g}), and only background is seen. It looks "
            "along +Z, with +Y down: Camera.from_opengl takes poses that look along −Z (OpenGL, Blender, NeRF). A pose from "
            "camera to world must be inverted",
        )


def warn_of_bytes(name: str, image: Tensor) -> None:
    """Warn where an image (…, C) has whole numbers up to 255 instead of radiance from 0 to 1."""
    if image.numel() < 64 or not values_visible(image):
        return
    values = image.detach()
    some = values.reshape(-1)[:: max(1, values.numel() // 64)]
    if bool((some != some.round()).any()) or bool((values != values.round()).any()):
        return
    largest = float(values.max())
    if float(values.min()) >= 0.0 and BYTES[0] < largest <= BYTES[1]:
        warn(
            f"bytes in {name}",
            f"{name}: expected linear radiance, where 1 is white, got whole numbers up to {largest:g}; of 8-bit sRGB values "
            "take srgb_to_linear(image / 255)",
        )
