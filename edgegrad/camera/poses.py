"""Matrices of cameras: checked, and built from what users give."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..check import as_scalar, as_tensor, check_finite, check_float, check_positive_int, check_shape, values_visible
from ..warnings import warn

Vector = Tensor | Sequence[float]
RADIANS = 0.17, 2.3  # fields of view of 10° to 132° in radians, which few lenses have in degrees


def image_size(size: tuple[int, int]) -> tuple[int, int]:
    try:
        H, W = size
    except (TypeError, ValueError):
        raise TypeError(f"size: expected (height, width), got {size!r}") from None
    return check_positive_int("size", H, most=65536), check_positive_int("size", W, most=65536)


def constant(values: Sequence[Any], like: Tensor) -> Tensor:
    """Return numbers as a tensor of this kind and in this place. like.new_tensor() fails under torch.func in torch 2.4."""
    return torch.tensor(values, dtype=like.dtype, device=like.device)


def check_last_row(name: str, matrix: Tensor, expected: list[float], fix: str = "is it transposed?") -> None:
    """Check that `matrix` (…, n, n) is finite and ends with the row `expected`. Raises ValueError."""
    check_finite(name, matrix)
    if not values_visible(matrix):
        return
    last = matrix.detach()[..., -1, :]
    if not torch.equal(last, constant(expected, last).expand_as(last)):
        got = last.reshape(-1, len(expected))[0].tolist()
        raise ValueError(f"{name}: expected the last row {expected}, got {got}; {fix}")


def rotation(vector: Tensor) -> Tensor:
    """Return the rotation (3, 3) by a rotation vector (3,), radians, differentiable: the exponential of its cross-product
    matrix."""
    x, y, z = vector.unbind()
    o = torch.zeros_like(x)
    return torch.linalg.matrix_exp(torch.stack([o, -z, y, z, o, -x, -y, x, o]).reshape(3, 3))


def check_rotation(name: str, matrix: Tensor) -> None:
    """Check that `matrix` (…, 3, 3) is a rotation. Raises ValueError."""
    check_finite(name, matrix)
    if not values_visible(matrix):
        return
    R = matrix.detach().double()
    # 1e-3: far above what float32 rounding leaves of a product of rotations (1e-6), far below a scale in the matrix.
    error = (R @ R.mT - torch.eye(3, dtype=R.dtype, device=R.device)).abs().max().item()
    if error > 1e-3:
        raise ValueError(
            f"{name}: expected a rotation in the upper 3 × 3, got one with |R Rᵀ − 1| up to {error:.3g}; "
            "keep it orthogonal (for example optimise a rotation vector and use torch.linalg.matrix_exp)"
        )
    if bool((torch.linalg.det(R) < 0).any()):
        raise ValueError(
            f"{name}: expected a rotation, got a reflection (determinant −1); flip one axis, or take "
            "Camera.from_opengl and its like for poses of other conventions"
        )


def _vector(name: str, value: Vector, like: Tensor | None = None) -> Tensor:
    tensor = as_tensor(name, value, like=like)
    if not tensor.is_floating_point():
        tensor = tensor.to(torch.get_default_dtype())
    check_float(name, tensor)
    check_shape(name, tensor, (3,))
    check_finite(name, tensor)
    return tensor


def _direction(vector: Tensor) -> Tensor:
    """Return a vector (3,) that is not zero, at length one. It is scaled first, so that squares neither overflow nor vanish."""
    vector = vector / vector.detach().abs().max()
    return vector / vector.norm()


def rigid(R: Tensor, t: Tensor) -> Tensor:
    """Return (…, 4, 4) of R (…, 3, 3) and t (…, 3)."""
    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=R.dtype, device=R.device).expand(*R.shape[:-2], 1, 4)
    return torch.cat([torch.cat([R, t.to(R)[..., None]], -1), last], -2)


def _widest(tensors: Sequence[Tensor]) -> Tensor:
    return next((tensor for tensor in tensors if tensor.dtype == torch.float64), tensors[0])


def looking_at(eye: Vector, target: Vector, up: Vector) -> Tensor:
    given = [v for v in (eye, target, up) if isinstance(v, Tensor) and v.dtype in (torch.float32, torch.float64)]
    like = _widest(given) if given else None
    vectors = _vector("eye", eye, like), _vector("target", target, like), _vector("up", up, like)
    like = _widest(vectors) if like is None else like
    # In float32, distances of 1e±30 have no square, and a distant eye would round the directions.
    e, g, u = (v.to(like).double() for v in vectors)
    if values_visible(e, g, u):
        if torch.equal(e, g):
            raise ValueError(f"target: expected a point apart from eye, got both at {e.tolist()}")
        # 1e-6 of the sine of the angle: below it float32 rounding alone decides where right is.
        if not bool(u.any()) or float(torch.linalg.cross(_direction(g - e), _direction(u)).detach().norm()) <= 1e-6:
            raise ValueError(
                f"up: expected a direction apart from the line of sight, got {u.tolist()}; try another axis"
            )
    forward = _direction(g - e)
    right = _direction(torch.linalg.cross(forward, _direction(u)))
    R = torch.stack([right, torch.linalg.cross(forward, right), forward])
    return rigid(R, -(R * e).sum(-1)).to(like)


def intrinsics(fx: Tensor, fy: Tensor, cx: Tensor | float, cy: Tensor | float) -> Tensor:
    """Return K (…, 3, 3) of tensors (…)."""
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    rows = [fx, zero, cx * one], [zero, fy, cy * one], [zero, zero, one]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def intrinsics_of_view(
    fov_y: float | Tensor | None, fov_x: float | Tensor | None, size: tuple[int, int], like: Tensor
) -> Tensor:
    """Return K (3, 3) of square pixels, centred, from the one full field of view in degrees that is given; differentiable."""
    H, W = size
    name, fov, pixels = ("fov_y", fov_y, H) if fov_x is None else ("fov_x", fov_x, W)
    degrees = as_scalar(name, fov, like=like)
    if values_visible(degrees):
        given = float(degrees.detach())
        if not 0.0 < given < 180.0:
            raise ValueError(f"{name}: expected degrees between 0 and 180, got {given:g}")
        if RADIANS[0] < given < RADIANS[1]:
            text = (
                f"{name}: expected degrees, got {given:.4g}; a lens that narrow is rare. Of radians take math.degrees()"
            )
            warn(f"{name} in radians", text)
    focal = 0.5 * pixels / torch.tan(torch.deg2rad(degrees) * 0.5)
    return intrinsics(focal, focal, 0.5 * W, 0.5 * H)
