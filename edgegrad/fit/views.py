"""What a fit compares with: pictures, masks and weights, each with its camera."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike as OsPath
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ..camera.camera import Camera
from ..check import as_tensor, check_finite, check_float, check_shape
from ..files.image import linear_to_srgb
from ..scene.tree import map_tensors
from ..warnings import warn
from .measured import Measurement, area_mean, measurements

Images = Tensor | Sequence[Tensor]
FULL = 0.98  # a mask of more covers the whole pixel
REACH = 8  # pixels
WITH_ALPHA = 2, 4  # channels of pictures
BYTE_ROUNDING = 1e-2  # of 255, by what resizes a picture
DARKEST_BYTE = 5.0  # median of a picture of 8-bit numbers that are not whole
HIGHLIGHTS = 0.01  # share of the pixels
ROUNDING = 0.02  # of a step of 8 bits: how far float32 takes a level from a whole number
FAINT = 0.5  # a mask that covers no pixel by more was read by another curve, or holds labels


@dataclass(frozen=True, eq=False)
class View:
    """One camera, and what it saw. With a mask, the picture is black outside of it."""

    camera: Camera
    image: Tensor | None  # (H, W, C) linear radiance
    mask: Tensor | None  # (H, W, 1), the share of each pixel that the object covers
    weight: Tensor | None  # (H, W, 1), zero where the picture says nothing
    sure: Tensor | None = None  # (H, W, 1), zero where its colour is not sure, for the mask is neither full nor empty
    measured: Mapping[str, Measurement] = field(default_factory=dict)  # by the channel of render_aovs()
    outlined: bool = False  # the picture tells where the object is, not its colours: alpha is rendered

    @property
    def aovs(self) -> list[str]:
        """The channels to render, as render_aovs() names them; the first is the one to show."""
        own = ["image"] * (self.image is not None and not self.outlined)
        own += ["alpha"] * (self.mask is not None or self.outlined)
        return [*own, *self.measured, *(["alpha"] if self.measured and self.mask is None else [])]

    @property
    def shown(self) -> Tensor:
        """(H, W, c) the picture, or the channel to show, from 0 to 1 where it is neither a colour nor a mask."""
        if self.outlined and self.image is not None:
            return self.image
        first = self.aovs[0]
        return (
            self.measured[first].displayed(self.measured[first].value) if first in self.measured else self.wanted[first]
        )

    @property
    def wanted(self) -> dict[str, Tensor]:
        """Image and alpha of the picture, (H, W, c) each."""
        both = {"image": None if self.outlined else self.image, "alpha": self.mask}
        return {name: value for name, value in both.items() if value is not None}

    @property
    def weights(self) -> dict[str, Tensor | None]:
        """How much the pixels of each channel count."""
        of_image = self.weight if self.sure is None else self.sure if self.weight is None else self.sure * self.weight
        return {"image": of_image, "alpha": self.weight}

    def resized(self, factor: float) -> View:
        """With the sides multiplied by `factor`; pixels are means over the area of the old ones."""
        H, W = self.camera.size
        size = max(1, round(H * factor)), max(1, round(W * factor))
        if size == (H, W):
            return self
        image, mask, weight, sure = (
            None if value is None else area_mean(value, size)
            for value in (self.image, self.mask, self.weight, self.sure)
        )
        measured = {name: one.resized(size) for name, one in self.measured.items()}
        return View(self.camera.resized(size), image, mask, weight, sure, measured, self.outlined)


def views_of(
    cameras: Camera | Sequence[Camera],
    images: Images | None,
    masks: Images | None = None,
    weights: Images | None = None,
    measured: Mapping[str, Any] | None = None,
) -> list[View]:
    """One View for each camera. Raises TypeError or ValueError that names the argument.

    cameras   one, a batch, or a sequence of cameras, of any sizes
    images    (H, W, C) for one camera, else (B, H, W, C) or a sequence; linear radiance
    masks     (H, W) or (H, W, 1) each, 1 on the object and 0 elsewhere
    weights   (H, W) or (H, W, 1) each, from 0: how much a pixel counts
    measured  "depths", "normals" and "positions", each as measurements() takes it

    In a sequence of any of them None stands where a camera has none.
    """
    split = cameras_of(cameras)
    pictures, shapes, counts = (
        _images(name, value, split) for name, value in (("images", images), ("masks", masks), ("weights", weights))
    )
    beside = measurements(measured or {}, split)
    views = []
    for i, (camera, image, mask, weight) in enumerate(zip(split, pictures, shapes, counts, strict=True)):
        for name, value in (("masks", mask), ("weights", weight)):
            if value is not None:
                check_shape(name, value, (*camera.size, 1))
        if weight is not None and not bool((weight >= 0).all()):
            raise ValueError(f"weights: expected numbers from 0 up, got {float(weight.min()):g}")
        if image is None and mask is None and not beside[i]:
            which = f" for cameras[{i}]" if any(x is not None for x in (*pictures, *shapes)) or any(beside) else ""
            raise ValueError(f"images: expected pictures or masks to compare with, got neither{which}")
        sure = None
        if image is not None and mask is not None:
            image, sure = before_black(image, mask)
        views.append(View(camera, image, mask, weight, sure, _counted(beside[i], mask, weight)))
    for name, values in (("masks", shapes), ("weights", counts)):
        given = [value for value in values if value is not None]
        if given and not any(bool((value > 0).any()) for value in given):
            raise ValueError(
                f"{name}: expected numbers above 0 somewhere, got zero in every pixel; there is nothing to fit"
            )
    warn_of_faint("masks", [mask for mask in shapes if mask is not None])
    return views


def outlined_views(views: Sequence[View]) -> list[View]:
    """The same for a loss of regions. Raises ValueError where there is something else to compare than pictures."""
    for view in views:
        if view.mask is not None:
            raise ValueError(
                'masks: expected none with loss="region", which finds the object by its colours, got some; leave out the masks, '
                'or the images and loss="region" (mask_loss compares masks)'
            )
        if view.measured:
            raise ValueError(
                f'{next(iter(view.measured))}s: expected none with loss="region", got some; give loss="l2" with masks or without'
            )
        if view.image is None:
            raise ValueError('images: expected a picture for each camera with loss="region", got None')
        check_without_alpha("images", view.image)
    return [replace(view, outlined=True) for view in views]


def _counted(measured: dict[str, Measurement], mask: Tensor | None, weight: Tensor | None) -> dict[str, Measurement]:
    """With the weights of the view's pixels. Where a mask is neither full nor empty, a depth may be that of the object, of what
    lies behind, or between; where it is empty, it is not the object's."""
    count = torch.ones(()) if weight is None else weight
    count = count if mask is None else count * (mask > FULL)
    return {name: replace(one, weight=one.weight * count) for name, one in measured.items()}


def cameras_of(cameras: object) -> list[Camera]:
    """One by one, as copies on the CPU. Raises TypeError."""
    given = [cameras] if isinstance(cameras, Camera) else cameras
    if not isinstance(given, Sequence):
        raise TypeError(f"cameras: expected a Camera or a sequence of them, got {type(cameras).__name__}")
    if not given:
        raise ValueError("cameras: expected one for each picture, got an empty list; give at least one")
    split: list[Camera] = []
    for i, camera in enumerate(given):
        if not isinstance(camera, Camera):
            raise TypeError(f"cameras[{i}]: expected a Camera, got {type(camera).__name__}")
        # Copies, for autograd does not keep tensors that were made in torch.inference_mode().
        camera = map_tensors(camera, lambda tensor: tensor.detach().cpu().clone())
        split += [camera] if camera.batch is None else [part_of(camera, k) for k in range(camera.batch)]
    return split


def part_of(camera: Camera, k: int) -> Camera:
    """One camera of a batch."""
    fields: dict[str, Any] = {"world_to_camera": 3, "K": 3, "distortion": 2}
    values = {name: getattr(camera, name) for name in fields}
    return camera.replace(
        **{name: v[k] if v is not None and v.dim() == fields[name] else v for name, v in values.items()}
    )


def _images(name: str, value: object, cameras: list[Camera]) -> list[Tensor | None]:
    """(H, W, c) float32 on the CPU, one for each camera. Raises TypeError or ValueError."""
    if value is None:
        return [None] * len(cameras)
    if len(cameras) == 1 and isinstance(value, (list, tuple)) and len(value) > 1 and hasattr(value[0], "ndim"):
        raise ValueError(f"{name}: expected one for each camera, got {len(value)} and one camera; give as many cameras")
    single = len(cameras) == 1 and not isinstance(value, (list, tuple)) and getattr(value, "ndim", 0) < 4
    given: Any = [value] if single else value
    if len(given) != len(cameras):
        raise ValueError(f"{name}: expected {len(cameras)}, one for each camera, got {len(given)}")
    return [
        None if image is None else check_image(name if single else f"{name}[{i}]", image, camera.size)
        for i, (image, camera) in enumerate(zip(given, cameras, strict=True))
    ]


def check_image(name: str, value: object, size: tuple[int, int]) -> Tensor:
    """(H, W, C) float32 on the CPU. Raises TypeError or ValueError."""
    if value is None or isinstance(value, (str, OsPath)):
        got = "None" if value is None else f"the path {str(value)!r}"
        read = "read_mask" if name.startswith("mask") else "read_image"
        raise TypeError(f"{name}: expected an image (H, W, C) of numbers, got {got}; read one with {read}(path)")
    image = as_tensor(name, value).detach().cpu()
    image = image.float() if image.dtype == torch.bool else image
    fix = "the camera must have the picture's size: camera.resized((H, W))"
    if name.startswith(("mask", "weight")):
        if not image.is_floating_point():
            raise TypeError(
                f"{name}: expected floating-point numbers, got {image.dtype}; of 8-bit numbers take x / 255, of 0 "
                "and 1 x.float()"
            )
        check_shape(name, image, size, (*size, 1), fix=fix)
    else:
        check_float(name, image)
    image = image[..., None] if image.dim() == 2 else image
    check_shape(name, image, (*size, "C"), fix=fix)
    check_finite(name, image)
    rounding = 1e-3
    if name.startswith("mask") and bool((image < -rounding).any() | (image > 1.0 + rounding).any()):
        raise ValueError(
            f"{name}: expected numbers from 0 to 1, got {float(image.min()):g} to {float(image.max()):g}; of 8-bit numbers take "
            "x / 255"
        )
    if not name.startswith("weight") and _is_of_bytes(image):
        whole = "whole " if bool((image == image.round()).all()) else ""
        warn(
            f"bytes {name}",
            f"{name}: expected linear radiance, as the scene's colours are, got {whole}numbers up to {float(image.max()):g}, "
            "as of a picture of 8 bits; take srgb_to_linear(x / 255), or read it with read_image",
        )
    return image.float()


def check_without_alpha(name: str, image: Tensor) -> None:
    """Of a picture (H, W, C) whose colours are all compared, and tell the object from what surrounds it. Raises ValueError."""
    if (C := image.shape[-1]) in WITH_ALPHA:
        raise ValueError(
            f"{name}: expected grey or colours, got {C} channels, of which the last one would be alpha; read it with "
            f"read_image(path, channels={C - 1}), or, if alpha is 1 on the object alone, give x[..., -1:] as its mask"
        )


def warn_of_faint(name: str, masks: Sequence[Tensor]) -> None:
    """Where no pixel of any mask is nearly covered."""
    most = max((float(mask.max()) for mask in masks), default=0.0)
    if 0.0 < most < FAINT:
        warn(
            f"faint {name}",
            f"{name}: expected 1 where the object covers the pixel, got at most {most:.3g}; divide by that number, or choose the "
            "object's label if the file has labels. read_image() is not for masks, for it undoes an sRGB curve: read_mask() is",
        )


def _is_of_bytes(image: Tensor) -> bool:
    """Whether it looks like 8-bit numbers that were made floats, or resized after that. Radiance that reaches so far, as of a
    picture with a sun in it, is hardly whole, and low in most pixels."""
    if not image.numel() or not 100.0 < float(image.max()) <= 255.0 + BYTE_ROUNDING:
        return False
    return bool((image == image.round()).all()) or float(image.median()) > DARKEST_BYTE


def before_black(image: Tensor, mask: Tensor) -> tuple[Tensor, Tensor | None]:
    """(H, W, C): the object alone, as a render before black shows it, from a picture of it before anything; and (H, W, 1)
    where this is sure, or None where it is so everywhere.

    Where the mask is full, the picture shows the object. A pixel that it covers in part may hold its colour as it is
    (straight alpha), times the mask (before black), or mixed with what lies behind (a photograph), and does not tell
    which. So it gets the mask times the colour beside it, grown from where the mask is full by up to REACH pixels, and
    what is farther from there the mask times its own. That is not sure."""
    colors, known = image, mask > FULL
    partial = (mask > 0.0) & ~known
    if not bool(known.any()) or not bool(partial.any()):
        return image * mask, None
    left = partial
    for _ in range(REACH):
        share = _around(known.to(image))
        fresh = left & (share > 0.01)  # a ninth, or rounding
        if not bool(fresh.any()):
            break
        colors = torch.where(fresh, _around(colors * known) / share.clamp(min=0.01), colors)
        known, left = known | fresh, left & ~fresh
    return colors * mask, (~partial).to(image)


def _around(image: Tensor) -> Tensor:
    """Means over 3 × 3 pixels, of zeros beyond the rim."""
    return F.avg_pool2d(image.movedim(-1, 0)[None], 3, stride=1, padding=1)[0].movedim(0, -1)


def grouped(views: Sequence[View]) -> list[list[int]]:
    """Places of views whose cameras can be rendered as one batch, with the same channels to compare."""
    groups: dict[Any, list[int]] = {}
    for i, view in enumerate(views):
        camera = view.camera
        lens = None if camera.distortion is None else camera.distortion.shape
        shape = None if view.image is None else view.image.shape[-1]
        key = camera.size, camera.projection, lens, camera.K.dtype, shape, view.mask is None
        key = *key, view.weight is None, view.sure is None, tuple(view.measured), view.outlined
        groups.setdefault(key, []).append(i)
    return list(groups.values())


def white_of(pixels: Tensor) -> float:
    """Return what one pixel in a hundred of (N, C) is brighter than: it counts as white. Linear radiance may be in any unit.

    Where that is black, the brightest pixel is white; where all are black, 1 is."""
    if not len(pixels):
        return 1.0
    brightest = pixels.amax(1)
    white = float(brightest.kthvalue(max(1, math.ceil((1.0 - HIGHLIGHTS) * len(brightest)))).values)
    white = white if white > 0.0 else float(brightest.max())
    return white if white > 0.0 else 1.0


def has_levels(picture: Tensor) -> bool:
    """Whether linear radiance, of any shape, has the 256 levels of a file of 8 bits. Such a picture says what is white, 1, also
    where it is dark."""
    levels = 255.0 * linear_to_srgb(picture)
    return float(picture.max()) <= 1.0 and bool(((levels - levels.round()).abs() < ROUNDING).all())
