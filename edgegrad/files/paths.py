"""Paths in and out: checked before a library sees them, written whole or not at all."""

from __future__ import annotations

import json
import os
import secrets
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

if sys.platform == "win32":
    from pathlib import WindowsPath as NativePath
else:
    from pathlib import PosixPath as NativePath

PathLike = str | os.PathLike[str]


class StoredPath(NativePath):
    """The path of an image that is read as it is stored: its EXIF orientation is not applied.

    Cameras and texture coordinates in files describe these pixels. COLMAP, instant-ngp, nerfstudio and Blender do not apply the
    orientation either.
    """


def check_readable(path: PathLike, suffixes: Collection[str]) -> Path:
    """Return the path of an existing, non-empty file whose name ends in one of `suffixes`. Raises FileNotFoundError when
    nothing is there, PermissionError when it may not be read, ValueError when it is a directory or a device, of another kind or
    empty."""
    file = check_suffix(path, suffixes)
    if file.is_dir():
        raise ValueError(f"{path}: expected a file, got a directory; name a file in it")
    if not file.exists():
        raise FileNotFoundError(f"{path}: expected a file, got no such file; look for it in {file.absolute().parent}")
    if not file.is_file():
        raise ValueError(f"{path}: expected a file, got a pipe or a device, which may never end; copy it to a file")
    if not os.access(file, os.R_OK):
        raise PermissionError(f"{path}: expected a file that may be read, got one without the permission; chmod it")
    if file.stat().st_size == 0:
        raise ValueError(f"{path}: expected data, got an empty file; export it again")
    return file


def check_suffix(path: PathLike, suffixes: Collection[str]) -> Path:
    """Return `path` when its name ends in one of `suffixes`, in any case. Raises TypeError or ValueError."""
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"path: expected a str or pathlib.Path, got {type(path).__name__}")
    file = Path(path)
    if file.suffix.lower() not in suffixes and not file.is_dir():
        raise ValueError(
            f"{path}: expected a file name that ends in {', '.join(suffixes)}, got {file.suffix or 'no ending'!r}; "
            "convert the file or rename it"
        )
    return file


@contextmanager
def replacing(path: PathLike) -> Iterator[Path]:
    """Yield a temporary file in the same folder that replaces `path` when the block succeeds and vanishes when it fails.
    Missing folders are made. Raises OSError with the path where something fails, ValueError when `path` is a directory."""
    file = Path(path)
    if file.is_dir():
        raise ValueError(f"{path}: expected a file name, got a directory; add a name to it")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"{path}: expected a folder to write to, got {file.parent} ({error.strerror})") from error
    # Libraries choose the format by the ending. Files of tempfile may only be read by their owner.
    temporary = file.with_name(f".{file.stem[:64]}-{secrets.token_hex(6)}{file.suffix}")
    try:
        yield temporary
        os.replace(temporary, file)
    except OSError as error:
        said = f"expected to write it, got: {error.strerror or error}; make room or rights"
        raise type(error)(error.errno, said, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: PathLike, text: str) -> None:
    """Write a text file in UTF-8, whole or not at all. Raises OSError."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: PathLike, content: Any, indent: int = 2) -> None:
    """Write a JSON file, whole or not at all. Raises OSError."""
    write_text(path, json.dumps(content, indent=indent) + "\n")


def write_figures(folder: Path, draw: Mapping[str, Callable[[], Any]]) -> list[str]:
    """Write matplotlib figures, each whole or not at all, and return their names. Raises OSError or what drawing raises."""
    for name, figure in draw.items():
        with replacing(folder / name) as temporary:
            figure().savefig(temporary)
    return list(draw)
