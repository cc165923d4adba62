"""Elements and attributes of a 3MF that nobody reads, by namespace."""

from __future__ import annotations

from typing import Any

from ...optional import require
from .context import LoadContext

MICROSOFT = "http://schemas.microsoft.com/3dmanufacturing"
CORE, MATERIAL = f"{MICROSOFT}/core/2015/02", f"{MICROSOFT}/material/2015/02"
PRODUCTION, SETS = f"{MICROSOFT}/production/2015/06", f"{MICROSOFT}/trianglesets/2021/07"
NEEDED = {CORE, MATERIAL, PRODUCTION, SETS}  # extensions that a file may require

# Elements that are read, and their attributes that are, or that change no picture.
PATH, UUID = f"{{{PRODUCTION}}}path", f"{{{PRODUCTION}}}UUID"
PLACE = {"objectid", "transform", PATH, UUID}
KNOWN = {
    f"{{{CORE}}}{name}": attributes
    for name, attributes in {
        "model": {
            "unit", "requiredextensions", "recommendedextensions", "thumbnail", "{http://www.w3.org/XML/1998/namespace}lang",
        },
        "resources": set(),
        "basematerials": {"id"},
        "base": {"name", "displaycolor"},
        "object": {"id", "type", "thumbnail", "partnumber", "name", "pid", "pindex", UUID},
        "mesh": set(),
        "vertices": set(),
        "vertex": {"x", "y", "z"},
        "triangles": set(),
        "triangle": {"v1", "v2", "v3", "p1", "p2", "p3", "pid"},
        "components": set(),
        "component": PLACE,
        "build": {UUID},
        "item": {*PLACE, "partnumber"},
    }.items()
} | {f"{{{MATERIAL}}}colorgroup": {"id", "displaypropertiesid"}, f"{{{MATERIAL}}}color": {"color"}}  # fmt: skip
HARMLESS = {f"{{{CORE}}}metadata", f"{{{CORE}}}metadatagroup", f"{{{SETS}}}trianglesets"}


def note_unread(root: Any, context: LoadContext) -> None:
    """Note elements of a model part, each with all that lies below it, and attributes that nobody reads."""
    elements: dict[str, str] = {}  # tag to a name with the prefix of the file
    attributes: dict[str, set[str]] = {}
    # The many vertices and triangles without further attributes are not visited one by one.
    odd = require("lxml.etree", "edgegrad[files]", "reading 3MF").XPath(
        "*[@*[4] or not(self::c:vertex or self::c:triangle)]", namespaces={"c": CORE}
    )
    waiting = [root]
    while waiting:
        element = waiting.pop()
        if not isinstance(element.tag, str) or element.tag in HARMLESS:  # comments; metadata
            continue
        if element.tag not in KNOWN:
            elements[element.tag] = f"{element.prefix}:{_local(element.tag)}" if element.prefix else _local(element.tag)
            continue
        attributes.setdefault(element.tag, set()).update(element.keys())
        waiting.extend(odd(element))
    for name in sorted(elements.values()):
        context.unread.note(f"element {name}")
    for tag, names in sorted(attributes.items()):
        for name in sorted(map(_local, names - KNOWN[tag])):
            context.unread.note(f"attribute {name} of {_local(tag)}")


def _local(name: str) -> str:
    return name.rpartition("}")[2]
