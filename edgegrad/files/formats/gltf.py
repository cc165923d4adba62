"""glTF 2.0 and GLB files: their JSON, and the entries that it refers to by number."""

from __future__ import annotations

import codecs
import json
import re
from typing import Any, NamedTuple

from .gltf_schema import explained
from .part import FormatError

GLOSS = "KHR_materials_pbrSpecularGlossiness"
MATT = "KHR_materials_specular"  # with a factor of 0: what is not metal has no highlight
DRACO = "KHR_draco_mesh_compression"
VISIBILITY = "KHR_node_visibility"
PUNCTUAL = "KHR_lights_punctual"
UNLIT = "KHR_materials_unlit"
QUANTIZED = "KHR_mesh_quantization"
# Extensions that are read, or that change no picture.
READ = {
    PUNCTUAL, DRACO, VISIBILITY, QUANTIZED, UNLIT, "KHR_materials_emissive_strength", "KHR_texture_transform",
    "EXT_texture_webp", "KHR_xmp", "KHR_xmp_json_ld",
}  # fmt: skip
# These extensions of lit materials are left out, and a file may not require them.
NEEDLESS = re.compile(r"KHR_materials_(?!pbrSpecularGlossiness)")


GLB = b"glTF"  # its first bytes
MARK = codecs.BOM_UTF8 + b" \t\r\n"


class File(NamedTuple):
    """A file before its arrays are read."""

    tree: dict[str, Any]  # its JSON
    chunk: bytes | None  # the buffer that a GLB holds


def read(data: bytes, kind: str) -> File:
    """Read a glTF or GLB file, whichever of both its name says. Raises FormatError for another version or a required extension
    that is not read, and ValueError where the file ends early."""
    is_text = data[:4] != GLB and (kind == "gltf" or data.lstrip(MARK)[:1] == b"{")
    text, chunk = (data, None) if is_text else _chunks(data)
    tree = json.loads(text)
    if not isinstance(tree, dict):
        raise FormatError(f"expected a JSON object, got {type(tree).__name__}; export it again")
    with explained(tree):
        asset = tree.get("asset", {})
        version = asset.get("version", "1.0" if isinstance(tree.get("meshes"), dict) else "2.0")
        _check_version(str(asset.get("minVersion", version)))
        needed = [name for name in tree.get("extensionsRequired", []) if name not in READ and not NEEDLESS.match(name)]
    if needed:
        raise FormatError(f"expected plain glTF 2.0, got one that needs {', '.join(needed)}; export it without")
    return File(tree, chunk)


def _check_version(version: str) -> None:
    major, _, minor = version.partition(".")
    if major == "1":
        raise FormatError(
            f"expected glTF 2.0, got version {version}, another format of that name; convert it, for instance with "
            "gltf-pipeline, or export it again as glTF 2.0"
        )
    if (major, minor) != ("2", "0"):
        raise FormatError(f"expected glTF 2.0, got version {version!r}; export it as glTF 2.0")


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON and the buffer, if there is one, of a GLB file. Chunks of other types are left out, as its specification
    asks."""
    if data[:4] != GLB or len(data) < 20:
        raise FormatError("expected a GLB file, got something else; export it again")
    version = int.from_bytes(data[4:8], "little")
    if version != 2:
        _check_version(f"{version}.0")
    chunks: dict[bytes, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        size, name = int.from_bytes(data[at : at + 4], "little"), data[at + 4 : at + 8]
        if at + 8 + size > len(data):
            raise ValueError(f"a chunk of {size} bytes at byte {at} of {len(data)}")
        chunks.setdefault(name, data[at + 8 : at + 8 + size])
        at += 8 + size
    if b"JSON" not in chunks:
        raise FormatError("expected a GLB file, got one without JSON; export it again")
    return chunks[b"JSON"], chunks.get(b"BIN\0")


def entry(tree: dict[str, Any], name: str, index: Any) -> dict[str, Any]:
    """Return the entry that the file refers to by number in one of its lists. Raises FormatError."""
    entries = tree.get(name, [])
    if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(entries):
        raise FormatError(f"expected one of its {len(entries)} {name} by number, got {index!r}; export it again")
    return entries[index]
