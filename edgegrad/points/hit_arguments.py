"""Arguments of the methods of Hits, checked."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..check import as_tensor, check_float, check_shape, values_visible
from ..scene.material import WRAPS
from ..scene.mesh import FILTERS


def as_rows(index: Tensor, count: int, device: torch.device) -> Tensor:
    """Return the rows (M,) of `count` points that numbers or a mask name. Raises TypeError or ValueError."""
    index = as_tensor("index", index).to(device)
    if index.dtype == torch.bool:
        check_shape("index", index, (count,), fix="a mask has a value for each point")
        index = index.nonzero()[:, 0]
    if index.is_floating_point() or index.is_complex():
        raise TypeError(f"index: expected integers or a mask, got {index.dtype}")
    check_shape("index", index, (len(index) if index.dim() == 1 else "M",))
    index = index.long()
    wrong = (index < -count) | (index >= count)
    if values_visible(index) and bool(wrong.any()):
        raise ValueError(f"index: expected numbers from {-count} to {count - 1}, got {int(index[wrong][0])}")
    return index


def as_attribute(attribute: Tensor, per: str | None, V: int, F: int) -> tuple[Tensor, str]:
    """Return an attribute of V vertices, F faces or their corners, and of which. Raises TypeError or ValueError."""
    attribute = as_tensor("attribute", attribute, floating=True)
    check_float("attribute", attribute)
    check_shape("attribute", attribute, (V, "K"), (F, "K"), (F, 3, "K"))
    if per is None:
        per = "corner" if attribute.dim() == 3 else "vertex" if attribute.shape[0] == V else "face"
        if V == F and attribute.dim() == 2:
            raise ValueError(f'per: expected "vertex" or "face", for the scene has {V} of each; say which')
    rows = {"vertex": (V, 2), "face": (F, 2), "corner": (F, 3)}
    if per not in rows:
        raise ValueError(f'per: expected "vertex", "face" or "corner", got {per!r}')
    if (attribute.shape[0], attribute.dim()) != rows[per]:
        raise ValueError(f"attribute: expected one row a {per}, got shape {tuple(attribute.shape)}")
    return attribute, per


def as_texture(
    texture: Tensor, wrap: str | tuple[str, str], filter: str, mipmap: bool
) -> tuple[Tensor, tuple[str, ...]]:
    """Return a texture (h, w, K) and its continuations for u and for v. Raises TypeError or ValueError."""
    texture = as_tensor("texture", texture, floating=True)
    check_float("texture", texture)
    check_shape("texture", texture, ("h", "w", "K"))
    wraps = (wrap, wrap) if isinstance(wrap, str) or not isinstance(wrap, Sequence) else tuple(wrap)
    if len(wraps) != 2 or any(w not in WRAPS for w in wraps):
        raise ValueError(f'wrap: expected "repeat", "clamp" or "mirror", or two of these, got {wrap!r}')
    if filter not in FILTERS:
        raise ValueError(f'filter: expected "linear" or "nearest", got {filter!r}')
    if mipmap and filter == "nearest":
        raise ValueError('mipmap: expected filter="linear" with it, got "nearest"')
    return texture, wraps


def as_function(name: str, value: Tensor) -> Tensor:
    """Return the function of a discontinuity, finite, and not in the half precision that autocast gives. Raises TypeError or
    ValueError."""
    value = as_tensor(name, value, floating=True)
    if value.dtype in (torch.float16, torch.bfloat16):
        value = value.float()
    check_float(name, value)
    if values_visible(value) and not bool(torch.isfinite(value.detach()).all()):
        raise ValueError(
            f"{name}: expected finite numbers, got {value.detach()[~torch.isfinite(value.detach())][0].item()}"
        )
    return value


def as_sides(a: Tensor | float, b: Tensor | float, s: Tensor) -> list[Tensor]:
    """Return the values on both sides of a discontinuity, s = 0 at N points. Raises TypeError or ValueError."""
    sides = []
    for name, side in (("a", a), ("b", b)):
        value = as_tensor(name, side, like=s, floating=True)
        if value.dim() > 2 or (value.dim() == 2 and value.shape[0] not in (1, len(s))):
            raise ValueError(f"{name}: expected rows (N, C), a colour (C,) or a number, got {tuple(value.shape)}")
        if value.dim() == 1 and (value.shape[0] > 1024 or 64 < value.shape[0] == len(s)):
            raise ValueError(
                f"{name}: expected rows (N, C), a colour (C,) or a number, got shape {tuple(value.shape)}; a number a point "
                "is value[:, None]"
            )
        sides.append(value)
    channels = [value.shape[-1] if value.dim() else 1 for value in sides]
    if channels[0] != channels[1] and 1 not in channels:
        raise ValueError(f"b: expected as many channels as a has, {channels[0]}, got {channels[1]}")
    return sides
