"""A mesh file, the files that it names, its images as tensors, and what it asks for in vain."""

from __future__ import annotations

import io
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
from .disguised import check_disguised
from .part import Fault, Wanted

# What Pillow is let loose on. Not EPS, above all, for which it runs another program.
TEXTURES = ("PNG", "JPEG", "MPO", "JPEG2000", "WEBP", "BMP", "TIFF", "TGA", "GIF", "PPM", "DDS")


WITHOUT_LOOK = ", or pass materials=False where only its look is missing"


class Folder:
    """The folder of a mesh file, from which those that the mesh names are read, and from nowhere else."""

    def __init__(self, path: PathLike, unsupported: Unsupported) -> None:
        self.path, self.unsupported = path, unsupported
        self.root = Path(path).absolute().parent.resolve()

    def get(self, name: str, advice: str = WITHOUT_LOOK) -> bytes:
        """Raises Fault or FileNotFoundError."""
        for text in (name.strip(), unquote(name.strip())):  # glTF writes names as URIs
            file = (self.root / text.replace("\\", "/")).resolve()
            if PureWindowsPath(text).drive or Path(text).is_absolute() or not file.is_relative_to(self.root):
                raise Fault(f"names {name!r}, outside its folder, which is not read; copy it beside the mesh")
            if file.is_file():
                return file.read_bytes()
            similar = self._in_other_case(file)
            if similar is not None:
                self.unsupported.note(repr(name), f"{similar.relative_to(self.root).as_posix()} in its place")
                return similar.read_bytes()
        raise FileNotFoundError(
            f"{self.path}: names {name!r}, and there is no such file in {self.root}; put it there{advice}"
        )

    def _in_other_case(self, file: Path) -> Path | None:
        """A file whose name differs in upper and lower case alone, as programs of Windows write them."""
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
        except (Fault, FileNotFoundError):
            return False

    def image(self, name: str) -> Any:
        """A Pillow image, not yet decoded. Raises Fault or FileNotFoundError."""
        return opened(name, self.get(name))


def opened(name: str, content: bytes) -> Any:
    """A Pillow image, not yet decoded. Raises Fault."""
    pillow = require("PIL.Image", "edgegrad[files]", "reading textures")
    check_disguised(content, f"an image in the texture {name!r}")
    try:
        return pillow.open(io.BytesIO(content))
    except (OSError, pillow.DecompressionBombError) as error:
        raise Fault(
            f"expected an image in the texture {name!r}, got none that Pillow reads; save it as PNG or JPEG"
        ) from error


class Textures:
    """Textures as tensors; parts that share an image share its tensor."""

    def __init__(self) -> None:
        self.known: dict[object, Tensor] = {}

    def get(self, name: str, image: Any, factor: tuple[float, ...] = (1.0, 1.0, 1.0)) -> Tensor:
        """(h, w, 3) linear radiance from a Pillow image, row 0 on top, times a linear factor."""
        key = (id(image), factor)
        if key not in self.known:
            linear = srgb_to_linear(_texels(name, image)).float()
            self.known[key] = linear * linear.new_tensor(factor)
        return self.known[key]

    def data(self, name: str, image: Any, channels: slice = slice(None)) -> Tensor:
        """(h, w, K) float32: some channels of red, green and blue as they stand in the file, from 0 to 1."""
        key = (id(image), "data", channels.start, channels.stop)
        if key not in self.known:
            self.known[key] = _texels(name, image)[..., channels].float()
        return self.known[key]

    def alpha(self, image: Any, factor: float) -> Tensor | None:
        """(h, w) float32, of an image that get() took, times a factor; None where it has none."""
        if "A" not in image.getbands() and "transparency" not in image.info:
            return None
        key = (id(image), factor, "alpha")
        if key not in self.known:
            texels = np.asarray(image.convert("RGBA"))[..., 3] / 255.0
            self.known[key] = factor * torch.from_numpy(texels).float()
        return self.known[key]


def _texels(name: str, image: Any) -> Tensor:
    """(h, w, 3) float64 in [0, 1]. Raises Fault."""
    if image.format not in TEXTURES:
        raise Fault(f"expected a {', '.join(TEXTURES)} image in the texture {name!r}, got {image.format}; convert it")
    try:
        deep = image.mode.startswith("I")  # convert() would clip 16-bit grey
        texels = torch.from_numpy(np.asarray(image if deep else image.convert("RGB")) / (65535.0 if deep else 255.0))
    except (OSError, SyntaxError, ValueError) as error:
        raise Fault(f"expected a whole image in the texture {name!r}, got a damaged one ({error})") from error
    return texels[..., None].expand(-1, -1, 3) if texels.dim() == 2 else texels


MOST_SAID = 20  # names in one warning


class Unsupported:
    """What a file holds or asks for and nobody reads, by name, and what is done instead."""

    def __init__(self) -> None:
        self.names: dict[str, str] = {}

    def note(self, name: str, instead: str = "left out") -> None:
        self.names[name] = instead

    def say(self, path: PathLike, what: str = "not rendered as the file asks") -> None:
        """One warning for a file."""
        if self.names:
            said = [f"{name} ({instead})" for name, instead in self.names.items()]
            more = [f"{len(said) - MOST_SAID} more"] if len(said) > MOST_SAID else []
            listed = "; ".join(said[:MOST_SAID] + more)
            warn(f"{path}: {listed}", f"{path}: {what}: {listed}")


class Source(NamedTuple):
    """What is known of a file while it is read."""

    folder: Folder
    textures: Textures
    wanted: Wanted
    unsupported: Unsupported

    @classmethod
    def of(cls, path: PathLike, wanted: Wanted) -> Source:
        unsupported = Unsupported()
        return cls(Folder(path, unsupported), Textures(), wanted, unsupported)


def linear_colors(what: str, values: np.ndarray, srgb: bool) -> Tensor:
    """Linear float32 colours (N, 3) from integers of any width, or from floats. sRGB floats reach up to 1, beyond which rounding
    may bring them by a hundredth, or, where one is 2 or more, up to 255. Raises Fault."""
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
        wanted = "from 0 to 1, or to 255" if srgb else "from 0 to 1"
        raise Fault(f"expected {what} colours {wanted}, got {values[bad].tolist()} at {what} {bad}; repair it")
    linear = torch.from_numpy(colors)
    return (srgb_to_linear(linear) if srgb else linear).float()
