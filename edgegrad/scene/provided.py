"""What scenes and hits can do with the help of packages that stand above them, which set their functions here
(edgegrad/__init__.py)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .mesh import Mesh
    from .scene import Scene


def _missing(*args: Any) -> Any:
    raise ImportError("expected the whole package; import edgegrad first")


from_trimesh: Callable[[Any], Mesh] = _missing
to_trimesh: Callable[[Mesh], Any] = _missing
points_by_material: Callable[[Any, Any, int], list[Any]] = _missing  # of hits and a light, so many
thumbnail: Callable[[Scene | Mesh], bytes] = _missing


def picture(thing: Scene | Mesh) -> bytes | None:
    """What notebooks show; None where it cannot be drawn."""
    try:
        return thumbnail(thing)
    except (ImportError, MemoryError, OSError, TypeError, ValueError):
        return None
