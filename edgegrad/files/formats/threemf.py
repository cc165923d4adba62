"""What trimesh passes over without a word in 3MF files."""

from __future__ import annotations

import io
import zipfile

from ...optional import require
from .part import Fault

MOST_INSTANCES = 100_000  # of the parts of a file: nested components multiply


def instances(data: bytes) -> int:
    """How many parts a 3MF places. trimesh gives up without a word where many components are nested, and leaves out those that
    are not defined. Raises Fault, also for an archive that would fill the memory and for XML that names other files."""
    etree = require("lxml.etree", "edgegrad[files]", "reading 3MF")
    require("networkx", "edgegrad[files]", "reading 3MF")
    safe = require("trimesh.exchange.common", "trimesh", "reading meshes").XML_PARSER_OPTIONS
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        size = sum(member.file_size for member in archive.infolist())  # no reader goes beyond
        if size > max(100 * len(data), 64_000_000):
            raise Fault(
                f"expected an archive that grows up to 100 times, got {size} bytes in {len(data)}; export it again"
            )
        for member in archive.namelist():
            if b"<!DOCTYPE" in archive.read(member).replace(b"\0", b""):  # without the zeros of UTF-16
                raise Fault(
                    f"expected XML without a DOCTYPE, which may name other files, got one in {member!r}; remove it"
                )
        name = next((name for name in archive.namelist() if "3d/3dmodel.model" in name.lower()), None)
        if name is None:
            raise Fault("expected a 3MF file, got an archive without 3D/3dmodel.model; export it again")
        model = io.BytesIO(archive.read(name))
    components: dict[str, list[str]] = {}
    items: list[str] = []
    for _, element in etree.iterparse(model, tag=("{*}object", "{*}build"), **safe):
        if element.tag.endswith("object"):
            components[element.get("id")] = [child.get("objectid") for child in element.iter("{*}component")]
        else:
            items += [child.get("objectid") for child in element.iter("{*}item")]
        element.clear()
    counts: dict[str, int] = {}

    def leaves(index: str, above: tuple[str, ...]) -> int:
        if index in above:
            raise Fault(f"expected components inside one another, got object {index} inside itself; export it again")
        if index not in counts:
            inside = components.get(index, [])
            counts[index] = sum(leaves(child, (*above, index)) for child in inside) if inside else 1
        return counts[index]

    count = sum(leaves(index, ()) for index in items)
    if count > MOST_INSTANCES:
        raise Fault(f"expected at most {MOST_INSTANCES} instances of objects, got {count}; export it flat")
    return count
