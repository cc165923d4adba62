"""Films for `edgegrad track`: videos, or folders of images."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

VIDEO = "edgegrad[video]", "reading or writing a video"
CODECS = "libx264", "mpeg4"  # for film.mp4; some builds of FFmpeg lack the first
BITS = 2.0  # per pixel, for codecs without a quality setting
USUAL_FPS = 25
MOST_FPS = 1000  # more is an error in a header, or a typing error


class ImageSequence(NamedTuple):
    """Pictures (H, W, 3) of linear radiance in their order."""

    frames: Iterator[Tensor]
    fps: Fraction | None  # None for a folder, and for a video that has none


def read_film(path: Path, camera: Path | None = None) -> ImageSequence:
    """Return a film of at least one frame, whose images are upright or stored as the camera file needs. Raises OSError,
    ValueError or ImportError, also while frames are read."""
    if path.is_dir():
        return _folder(path, camera)
    if not path.is_file():
        raise FileNotFoundError(2, "expected a video or a folder of images, got neither", str(path))
    return _video(path)


def _folder(folder: Path, camera: Path | None) -> ImageSequence:
    from .. import read_image
    from ..files.image import READABLE
    from .inputs import seen_by

    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in READABLE)
    if not paths:
        raise ValueError(f"{folder}: expected a folder with images, got none of {', '.join(READABLE)} in it")
    kind = type(seen_by(camera, paths[0]))  # upright or stored, for all frames
    return ImageSequence((read_image(kind(path), channels=3) for path in paths), None)


def _video(path: Path) -> ImageSequence:
    from ..optional import require

    av = require("av", *VIDEO)
    try:
        with av.open(str(path)) as container:
            streams = container.streams.video
            if not streams:
                raise ValueError(f"{path}: expected a video, got a file without pictures; is it sound alone?")
            fps = streams[0].average_rate
    except av.error.FFmpegError as error:
        raise _fault(path, error) from error
    frames = _decoded(path, av)
    first = next(frames, None)
    if first is None:
        raise ValueError(f"{path}: expected a video, got one without frames")
    return ImageSequence(chain([first], frames), fps if fps is not None and 0 < fps <= MOST_FPS else None)


def _decoded(path: Path, av: Any) -> Iterator[Tensor]:
    import torch

    from ..files.image import srgb_to_linear

    try:
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                picture = torch.from_numpy(frame.to_ndarray(format="rgb24")).float() / 255.0
                yield srgb_to_linear(upright(picture, *_orientation(frame)))
    except av.error.FFmpegError as error:
        raise _fault(path, error) from error


def _orientation(frame: Any) -> tuple[float, bool]:
    """Return the degrees to rotate a frame by counterclockwise, and whether it is mirrored left to right before. A display
    matrix (a b u; c d v; x y w) takes a pixel (p, q) to (a p + c q, b p + d q), with y downwards (ISO 14496-12)."""
    import numpy as np

    for data in frame.side_data:
        if "DISPLAYMATRIX" in str(data.type):
            a, b, _, c, d = np.frombuffer(data, np.int32)[:5].astype(np.float64)
            mirrored = a * d - b * c < 0.0
            a, b = (-a, -b) if mirrored else (a, b)  # the rotation of the mirrored frame
            return -math.degrees(math.atan2(b - c, a + d)), mirrored
    return getattr(frame, "rotation", 0), False


def upright(picture: Tensor, degrees: float, mirrored: bool = False) -> Tensor:
    """Return a picture (H, W, C) as players show it: mirrored left to right, as front cameras do, then rotated counterclockwise
    by the nearest right angle, as phones do."""
    picture = picture.flip(1) if mirrored else picture
    return picture.rot90(round(degrees / 90) % 4, (0, 1))


def _fault(path: Path, error: Exception) -> ValueError:
    return ValueError(f"{path}: expected a video, got a fault in it ({error})")


def write_film(folder: Path, pictures: list[Path], fps: Fraction) -> str | None:
    """Write film.mp4, or film.webp without PyAV, and return its name; None without pillow."""
    from ..files.paths import replacing
    from ..optional import DRAWING, require

    if not pictures:
        return None
    try:
        images = require("PIL.Image", *DRAWING)
    except ImportError as error:
        print(f"edgegrad: no film: {error}", file=sys.stderr)
        return None
    try:
        av = require("av", *VIDEO)
    except ImportError:
        with replacing(folder / "film.webp") as temporary:
            head, *rest = (images.fromarray(_read(images, path)) for path in pictures)
            head.save(temporary, save_all=True, append_images=rest, duration=round(1000 / fps), loop=0, quality=80)
        return "film.webp"
    with replacing(folder / "film.mp4") as temporary:
        _encode(av, temporary, (_read(images, path) for path in pictures), fps)
    return "film.mp4"


def _read(images: Any, path: Path) -> np.ndarray:
    import numpy as np

    with images.open(path) as image:
        return np.asarray(image.convert("RGB"))


def _encode(av: Any, path: Path, pictures: Iterator[np.ndarray], fps: Fraction) -> None:
    import numpy as np

    first = next(pictures)
    h, w = (side - side % 2 for side in first.shape[:2])  # colours have blocks of 2 × 2 pixels
    codec = next((name for name in CODECS if name in av.codecs_available), CODECS[-1])
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream(codec, rate=fps, options={"crf": "20"} if codec == "libx264" else {})
        if codec != "libx264":
            stream.bit_rate = round(BITS * h * w * fps)
        stream.width, stream.height, stream.pix_fmt = w, h, "yuv420p"
        for picture in chain([first], pictures):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture[:h, :w]), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
