"""Tensors as the kernel takes them: on the CPU, of one floating-point type, contiguous."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..check import as_tensor, check_countable, check_finite, check_indices, check_integer, check_not_meta


def to_kernel(**given: Any) -> tuple[list[Tensor], torch.device]:
    """Return floating-point tensors in float32, or float64 if one of them is, and the device of the first. Raises TypeError."""
    tensors = {name: as_tensor(name, value, floating=True) for name, value in given.items()}
    for name, tensor in tensors.items():
        check_not_meta(name, tensor)
        if not tensor.is_floating_point():
            raise TypeError(f"{name}: expected a floating-point tensor, got {tensor.dtype}; use .float()")
    double = any(tensor.dtype == torch.float64 for tensor in tensors.values())
    dtype = torch.float64 if double else torch.float32
    moved = [tensor.to(device="cpu", dtype=dtype).contiguous() for tensor in tensors.values()]
    return moved, next(iter(tensors.values())).device


def triangles(tri: Any, vertices: int, of: str) -> Tensor:
    """Return tri (F, 3) int32 on the CPU, indices into `vertices` rows of `of`. Raises TypeError or ValueError."""
    tri = as_tensor("tri", tri)
    check_integer("tri", tri)
    if tri.dim() != 2 or tri.shape[1] != 3:
        raise ValueError(f"tri: expected shape (F, 3), got {tuple(tri.shape)}")
    check_countable("tri", tri, vertices, of)
    check_indices("tri", tri, vertices, of)
    return tri.to(device="cpu", dtype=torch.int32).contiguous()


def check_positions(pos: Tensor) -> None:
    """Check that clip-space positions are finite and not so small that areas of triangles vanish. Raises ValueError."""
    check_finite("pos", pos, smallest=1e-90)  # areas are products of three


def ranges_of(ranges: Any, triangles: int) -> Tensor:
    """Return ranges (B, 2) int32 on the CPU: the first triangle and how many, of `triangles`. Raises TypeError or
    ValueError."""
    ranges = as_tensor("ranges", ranges)
    check_integer("ranges", ranges)
    if ranges.dim() != 2 or ranges.shape[1] != 2:
        raise ValueError(f"ranges: expected shape (B, 2), got {tuple(ranges.shape)}")
    ranges = ranges.to(device="cpu", dtype=torch.int64)
    first, count = ranges.unbind(1)
    if bool((bad := (first < 0) | (count < 0) | (first > triangles) | (count > triangles - first)).any()):
        k = int(bad.nonzero()[0])
        raise ValueError(
            f"ranges: expected a first triangle and a number of triangles among the {triangles} of tri, "
            f"got {ranges[k].tolist()} at [{k}]"
        )
    return ranges.to(torch.int32).contiguous()


def check_image(name: str, tensor: Tensor, channels: int | str, like: Tensor | None = None) -> None:
    """Check for shape (B, H, W, channels), a string for any number of them, with the B, H, W of `like`. Raises ValueError."""
    fits = tensor.dim() == 4 and (isinstance(channels, str) or tensor.shape[3] == channels)
    fits = fits and (like is None or tensor.shape[:3] == like.shape[:3])
    if not fits:
        size = "B, H, W" if like is None else ", ".join(map(str, like.shape[:3]))
        raise ValueError(f"{name}: expected shape ({size}, {channels}), got {tuple(tensor.shape)}")


def contiguous(tensor: Tensor | None) -> Any:
    """Return the tensor as an array for the kernel; None as it is."""
    return None if tensor is None else tensor.detach().contiguous().numpy()
