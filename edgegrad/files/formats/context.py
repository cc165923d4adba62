"""Context of reading a mesh file: its folder, its images as tensors, its options, and a record of what nobody reads."""

from __future__ import annotations

import io
import re
from collections.abc import Container
from itertools import chain, count
from pathlib import Path, PureWindowsPath
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
import torch
from torch import Tensor

from ...optional import require
from ...warnings import warn
from ..image import srgb_to_linear
from ..paths import PathLike
from .part import FormatError, LoadOptions

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


# Pillow may open these. EPS is not among them, because Pillow runs another program for it.
TEXTURES = ("PNG", "JPEG", "MPO", "JPEG2000", "WEBP", "BMP", "TIFF", "TGA", "GIF", "PPM", "DDS")


OR_WITHOUT_MATERIALS = ", or pass materials=False where only its appearance is missing"


class Folder:
    """The folder of a mesh file: files that the mesh names are read from there, and from nowhere else."""

    def __init__(self, path: PathLike, unread: UnreadLog) -> None:
        self.path, self.unread = path, unread
        self.root = Path(path).absolute().parent.resolve()

    def get(self, name: str, advice: str = OR_WITHOUT_MATERIALS) -> bytes:
        for text in (name.strip(), unquote(name.strip())):  # glTF writes names as URIs
            file = (self.root / text.replace("\\", "/")).resolve()
            if PureWindowsPath(text).drive or Path(text).is_absolute() or not file.is_relative_to(self.root):
                raise FormatError(f"names {name!r}, outside its folder, which is not read; copy it beside the mesh")
            if file.is_file():
                return file.read_bytes()
            similar = self._in_other_case(file)
            if similar is not None:
                self.unread.note(repr(name), f"{similar.relative_to(self.root).as_posix()} in its place")
                return similar.read_bytes()
        raise FileNotFoundError(
            f"{self.path}: names {name!r}, and there is no such file in {self.root}; put it there{advice}"
        )

    def _in_other_case(self, file: Path) -> Path | None:
        """Return a file whose name differs in upper and lower case alone, as programs of Windows write them."""
        found = self.root
        for word in file.relative_to(self.root).parts:
            names = (
                sorted(path for path in found.iterdir() if path.name.lower() == word.lower()) if found.is_dir() else []
            )
            if not names:
                return None
            found = names[0].resolve()
        return found if found.is_file() and found.is_relative_to(self.root) else None

    def holds(self, name: str) -> bool:
        try:
            return bool(self.get(name))
        except (FormatError, FileNotFoundError):
            return False

    def image(self, name: str) -> Any:
        """Return a Pillow image, not yet decoded. Raises FormatError or FileNotFoundError."""
        return opened(name, self.get(name))


def opened(name: str, content: bytes) -> Any:
    """Return a Pillow image, not yet decoded. Raises FormatError."""
    pillow = require("PIL.Image", "edgegrad[files]", "reading textures")
    check_file_type(content, f"an image in the texture {name!r}")
    try:
        return pillow.open(io.BytesIO(content))
    except (OSError, pillow.DecompressionBombError) as error:
        raise FormatError(
            f"expected an image in the texture {name!r}, got none that Pillow reads; save it as PNG or JPEG"
        ) from error


class Textures:
    """Textures as tensors; parts that share an image share its tensor."""

    def __init__(self) -> None:
        self.known: dict[object, Tensor] = {}

    def get(self, name: str, image: Any, factor: tuple[float, ...] = (1.0, 1.0, 1.0)) -> Tensor:
        """Return linear radiance (h, w, 3) of a Pillow image, row 0 on top, times a linear factor."""
        key = (id(image), factor)
        if key not in self.known:
            linear = srgb_to_linear(_texels(name, image)).float()
            self.known[key] = linear * linear.new_tensor(factor)
        return self.known[key]

    def data(self, name: str, image: Any, channels: slice = slice(None)) -> Tensor:
        """Return some channels (h, w, K) float32 of red, green and blue as they stand in the file, from 0 to 1."""
        key = (id(image), "data", channels.start, channels.stop)
        if key not in self.known:
            self.known[key] = _texels(name, image)[..., channels].float()
        return self.known[key]

    def alpha(self, image: Any, factor: float) -> Tensor | None:
        """Return alpha (h, w) float32 times a factor, of an image that get() took; None where it has none."""
        if "A" not in image.getbands() and "transparency" not in image.info:
            return None
        key = (id(image), factor, "alpha")
        if key not in self.known:
            texels = np.asarray(image.convert("RGBA"))[..., 3] / 255.0
            self.known[key] = factor * torch.from_numpy(texels).float()
        return self.known[key]


def _texels(name: str, image: Any) -> Tensor:
    """Return (h, w, 3) float64 in [0, 1]. Raises FormatError."""
    if image.format not in TEXTURES:
        raise FormatError(
            f"expected a {', '.join(TEXTURES)} image in the texture {name!r}, got {image.format}; convert it"
        )
    try:
        deep = image.mode.startswith("I")  # convert() would clip 16-bit grey
        texels = torch.from_numpy(np.asarray(image if deep else image.convert("RGB")) / (65535.0 if deep else 255.0))
    except (OSError, SyntaxError, ValueError) as error:
        raise FormatError(f"expected a whole image in the texture {name!r}, got a damaged one ({error})") from error
    return texels[..., None].expand(-1, -1, 3) if texels.dim() == 2 else texels


MOST_SAID = 20  # names in one warning


class UnreadLog:
    """A record of what a file holds or asks for and nobody reads, by name, and what is done instead."""

    def __init__(self) -> None:
        self.names: dict[str, str] = {}

    def note(self, name: str, instead: str = "left out") -> None:
        self.names[name] = instead

    def warn(self, path: PathLike, what: str = "not rendered as the file asks") -> None:
        if self.names:
            said = [f"{name} ({instead})" for name, instead in self.names.items()]
            more = [f"{len(said) - MOST_SAID} more"] if len(said) > MOST_SAID else []
            listed = "; ".join(said[:MOST_SAID] + more)
            warn(f"{path}: {listed}", f"{path}: {what}: {listed}")


class LoadContext(NamedTuple):
    """Everything that readers of a file share."""

    folder: Folder
    textures: Textures
    options: LoadOptions
    unread: UnreadLog

    @classmethod
    def from_path(cls, path: PathLike, options: LoadOptions) -> LoadContext:
        unread = UnreadLog()
        return cls(Folder(path, unread), Textures(), options, unread)


def linear_colors(what: str, values: np.ndarray, srgb: bool) -> Tensor:
    """Return linear float32 colours (N, 3) of integers of any width, or of floats. sRGB floats reach up to 1, which rounding
    may pass by a hundredth, or up to 255 where one is 2 or more. Raises FormatError."""
    values = np.asarray(values)
    colors = values[:, :3].astype(np.float64)
    if values.dtype.kind in "iu":
        colors /= np.iinfo(values.dtype).max
    elif srgb and colors.size and colors.max() >= 2.0:
        colors /= 255.0
    elif srgb:
        colors = np.where((colors > -0.01) & (colors < 1.01), np.clip(colors, 0.0, 1.0), colors)
    good = (colors >= 0.0) & (colors <= (1.0 if srgb else np.finfo(np.float32).max))
    if not good.all():
        bad = int(np.argwhere(~good)[0, 0])
        allowed = "from 0 to 1, or to 255" if srgb else "from 0 to 1"
        raise FormatError(f"expected {what} colours {allowed}, got {values[bad].tolist()} at {what} {bad}; repair it")
    linear = torch.from_numpy(colors)
    return (srgb_to_linear(linear) if srgb else linear).float()


def unique_name(taken: Container[str], *names: str) -> str:
    """Return the first name that is not taken; where all are, the last one with the first free number from 2 behind it."""
    numbered = (f"{names[-1]} ({k})" for k in count(2))
    return next(name for name in chain(names, numbered) if name not in taken)
