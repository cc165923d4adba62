"""Used by the other raster_*.py: matrices to clip space, rotations, a cube, and how they descend."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from tqdm import tqdm


def perspective(f: float = 2.0, near: float = 1.0, far: float = 20.0) -> Tensor:
    """(4, 4): OpenGL's, for an eye that looks along −z; f is 1 / tan of half the angle of view."""
    a, b = -(far + near) / (far - near), -2 * far * near / (far - near)
    return torch.tensor([[f, 0, 0, 0], [0, f, 0, 0], [0, 0, a, b], [0, 0, -1, 0]])


def rotations(count: int, generator: torch.Generator) -> Tensor:
    """(count, 3, 3), uniform: of random quaternions."""
    return of_quaternions(torch.randn(count, 4, generator=generator))


def of_quaternions(q: Tensor) -> Tensor:
    """(B, 3, 3) of quaternions (B, 4) of any length, the real part first."""
    w, x, y, z = (q / q.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).view(-1, 3, 3)


def in_clip_space(verts: Tensor, R: Tensor, distance: Tensor | float, projection: Tensor) -> Tensor:
    """(B, V, 4): vertices (V, 3) turned by R (B, 3, 3), as far before the eye as `distance`, a number or (B,)."""
    turned = verts @ R.mT
    away = torch.as_tensor(distance).expand(len(R))[:, None]
    moved = torch.stack([turned[..., 0], turned[..., 1], turned[..., 2] - away], 2)
    return torch.nn.functional.pad(moved, (0, 1), value=1.0) @ projection.T


def cube() -> tuple[Tensor, Tensor, Tensor]:
    """Vertices (8, 3), triangles (12, 3), and for each triangle three times the number of its side (12, 3)."""
    corners = torch.tensor([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
    sides = torch.tensor([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    triangles = torch.stack([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]], 1).reshape(-1, 3)
    return corners, triangles.int(), torch.arange(6).repeat_interleave(2)[:, None].expand(-1, 3).int()


def descend(
    optimizer: torch.optim.Optimizer, loss: Callable[[], Tensor], steps: int, last: float, name: str | None = None
) -> None:
    """Steps along the gradient of a loss that is made anew for each. Learning rates fall to the share `last` of what they were,
    by the same factor at each step. A bar of this name is shown."""
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: last ** (step / steps))
    bar = tqdm(range(steps), desc=name, disable=name is None)
    for _ in bar:
        optimizer.zero_grad()
        value = loss()
        value.backward()
        optimizer.step()
        schedule.step()
        bar.set_postfix(loss=f"{value.item():.1e}", refresh=False)
