"""glTF 2.0 and GLB files: their JSON, and what trimesh may see of it."""

from __future__ import annotations

import json
import re
from typing import Any

from .gltf_nodes import placed
from .part import Fault
from .source import Source

MOST_ZEROS = 1 << 24  # rows that a glTF may ask for without holding them
GLOSS = "KHR_materials_pbrSpecularGlossiness"
MATT = "KHR_materials_specular"  # with a factor of 0: what is not metal has no highlight
NEEDLESS = re.compile(r"KHR_materials_(?!pbrSpecularGlossiness)|KHR_lights|KHR_texture_transform|EXT_texture_webp")
# Extensions that are read, or that change no picture.
READ = {
    "KHR_lights_punctual", "KHR_materials_unlit", "KHR_materials_emissive_strength", "KHR_texture_transform", "EXT_texture_webp",
    "KHR_xmp", "KHR_xmp_json_ld",
}  # fmt: skip
SHAPING = {"EXT_mesh_gpu_instancing": "shown once"}  # those that change the shape of what is shown


def read_tree(data: bytes, kind: str) -> dict[str, Any]:
    """The JSON of a glTF or GLB file. Raises Fault where it needs what trimesh lacks."""
    if kind == "glb":
        if data[:4] != b"glTF" or data[16:20] != b"JSON":
            raise Fault("expected a GLB file, got something else; export it again")
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    tree = json.loads(data)
    if not isinstance(tree, dict):
        raise Fault(f"expected a JSON object, got {type(tree).__name__}; export it again")
    needed = [name for name in tree.get("extensionsRequired", []) if not NEEDLESS.match(name)]
    if needed:
        raise Fault(f"expected plain glTF 2.0, got one that needs {', '.join(needed)}; export it without compression")
    return tree


def for_trimesh(data: bytes, kind: str, tree: dict[str, Any]) -> bytes:
    """The file as trimesh may see it. Raises Fault when it asks for large arrays that it does not hold.

    Texture coordinates are attributes of their own, for trimesh knows but one set. Nodes have no cameras, for it leaves out what
    lies below them. Materials are without an extension for which it would decode images at once, before their format was
    looked at. Meshes with a skin stand at the root, for the transformation of their own node does not count (glTF 2.0, section
    3.7.3.3).
    """
    zeros = sum(accessor["count"] for accessor in tree.get("accessors", []) if "bufferView" not in accessor)
    if zeros > MOST_ZEROS:
        raise Fault(f"expected accessors with data, got some without that would fill {zeros} rows; export it plain")

    def without(thing: dict[str, Any], name: str) -> dict[str, Any]:
        return {key: value for key, value in thing.items() if key != name}

    def primitive(given: dict[str, Any]) -> dict[str, Any]:
        own = {f"_{n}" if n.startswith("TEXCOORD_") else n: i for n, i in given["attributes"].items()}
        return {**given, "attributes": own}

    seen = _skinned_at_root(tree)
    for name, change in {
        "materials": lambda m: {**m, "extensions": without(m.get("extensions", {}), GLOSS)},
        "meshes": lambda m: {**m, "primitives": [primitive(p) for p in m["primitives"]]},
        "nodes": lambda n: without(n, "camera"),
    }.items():
        if name in tree:
            seen[name] = [change(thing) for thing in seen[name]]
    text = json.dumps(seen).encode()
    if kind == "gltf":
        return text
    text += b" " * (-len(text) % 4)
    rest = data[20 + int.from_bytes(data[12:16], "little") :]
    sizes = [(20 + len(text) + len(rest)).to_bytes(4, "little"), len(text).to_bytes(4, "little")]
    return data[:8] + sizes[0] + sizes[1] + b"JSON" + text + rest


def _skinned_at_root(tree: dict[str, Any]) -> dict[str, Any]:
    nodes, scenes = list(tree.get("nodes", [])), list(tree.get("scenes", []))
    if not scenes or not any("skin" in node and "mesh" in node for node in nodes):
        return dict(tree)
    shown = {id(node) for node, _ in placed(tree)}
    roots = list(scenes[tree.get("scene", 0)].get("nodes", []))
    for index, node in enumerate(tree["nodes"]):
        if "skin" in node and "mesh" in node and id(node) in shown:
            roots.append(len(nodes))
            nodes.append({key: node[key] for key in ("mesh", "name") if key in node})
            nodes[index] = {key: value for key, value in node.items() if key not in ("mesh", "skin")}
    scenes[tree.get("scene", 0)] = {**scenes[tree.get("scene", 0)], "nodes": roots}
    return {**tree, "nodes": nodes, "scenes": scenes}


def primitives(tree: dict[str, Any], geometry: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The primitive of the file that each loaded part was made from. Raises Fault where trimesh misreads one."""
    found = [primitive for mesh in tree.get("meshes", []) for primitive in mesh["primitives"]]
    for primitive in found:
        if primitive.get("mode", 4) == 6:
            raise Fault("expected triangles or strips, got a triangle fan; export triangles")
        used = {**primitive["attributes"], "indices": primitive.get("indices")}
        for key, index in used.items():
            if index is None or not re.match("POSITION|NORMAL|TEXCOORD_|COLOR_0|indices", key):
                continue
            accessor = tree["accessors"][index]
            may_be_int = key == "indices" or key[0] == "C" or accessor.get("normalized", False)
            whole = accessor.get("componentType", 5126) == 5126 or (may_be_int and key not in ("POSITION", "NORMAL"))
            if not whole or "sparse" in accessor:
                raise Fault(f"expected {key} in full, got it {'sparse' if whole else 'quantized'}; export it plain")
    loaded = [primitive for primitive in found if primitive.get("mode", 4) in (0, 1, 4, 5)]  # others are left out
    return dict(zip(geometry, loaded, strict=True))


def note_unsupported(tree: dict[str, Any], source: Source) -> None:
    """Of the file as a whole: of its shape, and of a lit one all extensions."""
    used = set(tree.get("extensionsUsed", [])) | set(tree.get("extensions", {}))
    for name in sorted(used - READ - {MATT} if source.wanted.lit else used & set(SHAPING)):
        source.unsupported.note(name, SHAPING.get(name, "left out"))
    for name, instead in {"animations": "shown at rest", "skins": "shown in the pose of their binding"}.items():
        if tree.get(name):
            source.unsupported.note(name, instead)
    if any("targets" in primitive for mesh in tree.get("meshes", []) for primitive in mesh["primitives"]):
        source.unsupported.note("morph targets", "shown without")
