"""Tables of bad calls and the messages that they get: each names the argument, what was expected and what came."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest
import torch
from scenes import cube, front_camera

import edgegrad as eg

T, V = TypeError, ValueError
NAN, INF = torch.nan, torch.inf
VERTS, FACES = cube().verts.float(), cube().faces
CAMERA = front_camera(8)
POSE, K = CAMERA.world_to_camera, CAMERA.K


def mesh(**fields: object) -> eg.Mesh:
    return eg.Mesh(**{"verts": VERTS, "faces": FACES, **fields})


def textured(**fields: object) -> eg.Mesh:
    return mesh(**{"texture": torch.rand(4, 5, 3), "uvs": torch.rand(8, 2), "uv_faces": FACES, **fields})


def camera(**fields: object) -> eg.Camera:
    return eg.Camera(**{"world_to_camera": POSE, "K": K, "size": (8, 8), **fields})


def put(tensor: torch.Tensor, index: tuple[int, ...] | int, value: float) -> torch.Tensor:
    """Return a copy with one element replaced."""
    tensor = tensor.clone()
    tensor[index] = value
    return tensor


def check_message(call: Callable[[], object], error: type[Exception], *parts: str) -> None:
    """Assert that the call raises this very error, and that its message has all the parts in their order."""
    with pytest.raises((TypeError, ValueError, OSError), match=r"[\s\S]*".join(map(re.escape, parts))) as raised:
        call()
    assert raised.type is error


def bad_calls(table: dict[str, tuple]) -> pytest.MarkDecorator:
    """Parametrise a test by the call, the error and the parts of the message of each row of the table."""
    cases = [pytest.param(call, error, parts, id=name) for name, (call, error, *parts) in table.items()]
    return pytest.mark.parametrize(("call", "error", "parts"), cases)
