"""Content of a glTF file that nobody reads: extensions, properties, attributes of vertices, kinds of primitives."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from .context import LoadContext
from .gltf import MATT, READ
from .gltf_nodes import note_rotations
from .gltf_schema import properties, schema

INSTEAD = {
    "EXT_mesh_gpu_instancing": "shown once",
    "KHR_materials_variants": "shown in the materials that the file itself chooses",
}
# Other formats of data that stands in the file a second time; where it does not, whoever asks for it is told.
COPIES = {
    "KHR_texture_basisu", "EXT_texture_avif", "MSFT_texture_dds", "EXT_meshopt_compression", "KHR_meshopt_compression",
}  # fmt: skip
OF_LIGHT = re.compile(r"[A-Z0-9]+_(materials|lights)_")  # without lit=True left out on purpose
ATTRIBUTES = re.compile(r"POSITION|NORMAL|TANGENT|COLOR_0|TEXCOORD_0|(JOINTS|WEIGHTS)_\d+")


def note_unread(tree: dict[str, Any], context: LoadContext) -> None:
    """Note all unread content that affects a picture; without lit=True content of lights and materials is left out."""
    lit, found = context.options.lit, list(_unknown(tree, schema(), "the file"))
    extensions = {name for kind, name in found if kind == "extension"} | set(tree.get("extensionsUsed", []))
    for name in sorted(extensions - READ - COPIES - {MATT}):  # MATT by material
        if name in INSTEAD or lit or not OF_LIGHT.match(name):
            context.unread.note(name, INSTEAD.get(name, "left out"))
    for kind, name in sorted(set(found)):
        if kind != "extension":
            context.unread.note(f"{name!r} of {kind}")
    for name, instead in {"animations": "shown at rest", "skins": "shown in the pose of their binding"}.items():
        if tree.get(name) and not context.options.rigged:
            context.unread.note(name, f"{instead}; eg.rig.load() has them")
    note_rotations(tree, context.unread)
    used = {f"TEXCOORD_{number}" for number in _values(tree.get("materials", []), "texCoord")}
    primitives = [primitive for mesh in tree.get("meshes", []) for primitive in mesh["primitives"]]
    attributes = {name for primitive in primitives for name in primitive["attributes"]}
    for name in sorted(name for name in attributes - used if not ATTRIBUTES.fullmatch(name)):
        context.unread.note(f"attribute {name}")
    if any("targets" in primitive for primitive in primitives) and not context.options.rigged:
        context.unread.note("morph targets", "shown without; eg.rig.load() has them")
    if any(primitive.get("mode", 4) in (0, 1, 2, 3) for primitive in primitives):
        context.unread.note("points and lines")


def _unknown(value: Any, schema: dict[str, Any], kind: str) -> Iterator[tuple[str, str]]:
    """Yield content that the format does not know: ("extension", its name), or the list that it stands in and its name."""
    if isinstance(value, list):
        for element in value:
            yield from _unknown(element, schema.get("items", {}), kind)
    elif isinstance(value, dict):
        known = properties(schema)
        for name, inner in value.items():
            if name == "extensions" and isinstance(inner, dict):
                for extension, held in inner.items():
                    yield "extension", extension
                    yield from _unknown(held, {}, extension)  # for others in it
            elif name == "extras":  # anything, which nobody needs to know
                continue
            elif name in known:
                yield from _unknown(inner, known[name], name)
            elif known and "additionalProperties" not in schema:
                yield kind, name
            else:
                yield from _unknown(inner, {}, kind)


def _values(thing: Any, name: str) -> Iterator[Any]:
    """Yield all values under a name, at any depth."""
    for key, inner in thing.items() if isinstance(thing, dict) else enumerate(thing) if isinstance(thing, list) else ():
        if key == name:
            yield inner
        yield from _values(inner, name)
