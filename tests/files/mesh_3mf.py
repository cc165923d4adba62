"""3MF packages that tests write."""

from __future__ import annotations

import io
import zipfile
from functools import cache

MODEL = (
    '<model unit="millimeter" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><resources>'
    '<object id="1" type="model"><mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/>'
    '<vertex x="0" y="1" z="0"/></vertices><triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh></object>'
    '</resources><build><item objectid="1"/></build></model>'
)


@cache
def bomb(megabytes: int) -> bytes:
    """Return a 3MF of a few kilobytes that holds so many spaces."""
    head, tail = MODEL.split("</resources>")
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("3D/3dmodel.model", "w") as model:
        model.write(head.encode())
        for _ in range(megabytes):
            model.write(b" " * 2**20)
        model.write(b"</resources>" + tail.encode())
    return stream.getvalue()


def triangle_3mf(changes: dict[str, str] | None = None, extra: dict[str, str] | None = None) -> bytes:
    """Return a 3MF of a triangle with its text changed, and with more files."""
    text = MODEL
    for old, new in (changes or {}).items():
        assert old in text
        text = text.replace(old, new)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in {"3D/3dmodel.model": text, **(extra or {})}.items():
            archive.writestr(name, content)
    return stream.getvalue()


def nested(depth: int) -> dict[str, str]:
    """Return changes that make objects of two components each, the one below: 2^depth triangles."""
    objects = "".join(
        f'<object id="{i}"><components><component objectid="{i - 1}"/>'
        f'<component objectid="{i - 1}" transform="1 0 0 0 1 0 0 0 1 0 0 {2.0**i}"/></components></object>'
        for i in range(2, depth + 2)
    )
    return {"</resources>": objects + "</resources>", 'item objectid="1"': f'item objectid="{depth + 1}"'}


def chain(depth: int) -> dict[str, str]:
    """Return changes that make objects of one component each, the one below."""
    objects = "".join(
        f'<object id="{i}"><components><component objectid="{i - 1}"/></components></object>'
        for i in range(2, depth + 1)
    )
    return {"</resources>": objects + "</resources>", 'item objectid="1"': f'item objectid="{depth}"'}


PRODUCTION = "http://schemas.microsoft.com/3dmanufacturing/production/2015/06"
DOCTYPE_BOMB = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
