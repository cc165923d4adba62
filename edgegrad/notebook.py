"""Notebooks show meshes and scenes as pictures.

IPython knows the classes by name: registering them imports nothing.
"""

from __future__ import annotations

from typing import Any

SHOWN = (("edgegrad.scene.mesh", "Mesh"), ("edgegrad.scene.scene", "Scene"))


def register(formatter: Any) -> None:
    """Add the pictures to IPython's formatter of PNGs."""
    for module, name in SHOWN:
        formatter.for_type_by_name(module, name, picture)


def picture(thing: Any) -> bytes | None:
    """A PNG of a mesh or scene; None where it cannot be drawn."""
    from .preview import thumbnail

    try:
        return thumbnail(thing)
    except (ImportError, MemoryError, OSError, TypeError, ValueError):
        return None
