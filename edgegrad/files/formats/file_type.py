"""Recognition of files that are something else than their name says, whatever the format."""

from __future__ import annotations

import re

from .part import FormatError

PACKED = {b"\x1f\x8b": "data compressed by gzip", b"PK\x03\x04": "an archive of zip", b"BZh": "data compressed by bzip2",
          b"\xfd7zXZ\0": "data compressed by xz", b"7z\xbc\xaf\x27\x1c": "an archive of 7-Zip"}  # fmt: skip
PAGE = re.compile(rb"(\xef\xbb\xbf)?\s*<(!doctype html|html)\b", re.IGNORECASE)


def check_file_type(data: bytes, what: str) -> None:
    """Raise FormatError for a git-lfs pointer, a web page or an archive in the place of a file."""
    if data.startswith(b"version https://git-lfs.github.com/spec"):
        raise FormatError(f"expected {what}, got a pointer of git-lfs to it; fetch the file itself with: git lfs pull")
    if PAGE.match(data):
        raise FormatError(
            f"expected {what}, got a page of the web (HTML), as servers send with an error; download it again"
        )
    for start, name in PACKED.items():
        if data.startswith(start):
            raise FormatError(f"expected {what}, got {name}; unpack it first")
