"""The views that a fit compares with: pictures, masks and weights, each with its camera."""

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
from .by_camera import numbered, one_for_each
from .measured import SIZE_FIX, Measurement, area_mean, measurements

Images = Tensor | Sequence[Tensor | None]
WITH_ALPHA = 2, 4  # channels of pictures with alpha


@dataclass(frozen=True)
class PictureSettings:
    """Numbers by which pictures are checked and prepared."""

    full: float = 0.98  # A pixel with a higher mask is covered.
    fill_reach: int = 8  # pixels by which colours grow into partly covered ones
    byte_rounding: float = 1e-2  # above 255, by resizing a picture
    darkest_byte: float = 5.0  # median of a picture of 8-bit numbers that are not whole
    highlights: float = 0.01  # share of the pixels that are brighter than white
    rounding: float = 0.02  # distance of a level from a whole number in float32, in steps of 8 bits
    faint_mask: float = 0.5  # A mask whose pixels are all below was read with another curve, or holds labels.


PICTURES = PictureSettings()


@dataclass(frozen=True, eq=False)
class Observation:
    """The pictures of one camera. If there is a mask, the image is black outside of it."""

    camera: Camera
    image: Tensor | None  # (H, W, C) linear radiance
    mask: Tensor | None  # (H, W, 1), covered share of each pixel
    weight: Tensor | None  # (H, W, 1), zero where the picture says nothing
    sure: Tensor | None = None  # (H, W, 1), zero where the mask is between and leaves the colour open
    measured: Mapping[str, Measurement] = field(default_factory=dict)  # by the channel of render_aovs()
    by_region: bool = False  # the picture's colours say where the object is, and alpha is rendered

    @property
    def aovs(self) -> list[str]:
        """The channels to render, as render_aovs() names them; the first is the one to show."""
        own = ["image"] * (self.image is not None and not self.by_region)
        own += ["alpha"] * (self.mask is not None or self.by_region)
        return [*own, *self.measured, *(["alpha"] if self.measured and self.mask is None else [])]

    @property
    def shown(self) -> Tensor:
        """The picture (H, W, c), or the channel to show, in 0 … 1 if it is neither a colour nor a mask."""
        if self.by_region and self.image is not None:
            return self.image
        first = self.aovs[0]
        return (
            self.measured[first].displayed(self.measured[first].value) if first in self.measured else self.wanted[first]
        )

    @property
    def wanted(self) -> dict[str, Tensor]:
        """Image and alpha (H, W, c) of the picture."""
        both = {"image": None if self.by_region else self.image, "alpha": self.mask}
        return {name: value for name, value in both.items() if value is not None}

    @property
    def weights(self) -> dict[str, Tensor | None]:
        """The weights of the pixels of each channel."""
        of_image = self.weight if self.sure is None else self.sure if self.weight is None else self.sure * self.weight
        return {"image": of_image, "alpha": self.weight}

    def resized(self, factor: float) -> Observation:
        """Multiply the sides by `factor`; pixels are means over the area of the old ones."""
        H, W = self.camera.size
        size = max(1, round(H * factor)), max(1, round(W * factor))
        if size == (H, W):
            return self
        image, mask, weight, sure = (
            None if value is None else area_mean(value, size)
            for value in (self.image, self.mask, self.weight, self.sure)
        )
        measured = {name: one.resized(size) for name, one in self.measured.items()}
        return Observation(self.camera.resized(size), image, mask, weight, sure, measured, self.by_region)


def views_of(
    cameras: Camera | Sequence[Camera],
    images: Images | None,
    masks: Images | None = None,
    weights: Images | None = None,
    measured: Mapping[str, Any] | None = None,
    names: tuple[str, str] = ("images", "masks"),
    by_region: bool = False,
) -> list[Observation]:
    """Return one observation for each camera. Raises TypeError or ValueError that names the argument.

    cameras   one, a batch, or a sequence of cameras, of any sizes
    images    (H, W, C) for one camera, else (B, H, W, C) or a sequence; linear radiance
    masks     (H, W) or (H, W, 1) each, 1 on the object and 0 elsewhere
    weights   (H, W) or (H, W, 1) each, ≥ 0: how much a pixel counts
    measured  "depths", "normals" and "positions", each as measurements() takes it
    names     of the arguments images and masks
    by_region whether the loss "region" compares them

    In a sequence of any of them None stands where a camera has none.
    """
    split = cameras_of(cameras)
    n = len(split)
    pictures, shapes, counts = (
        [
            None if one is None else check_image(numbered(name, k, n), one, split[k].size)
            for k, one in enumerate(one_for_each(name, value, n, dims))
        ]
        for name, value, dims in ((names[0], images, 3), (names[1], masks, 2), ("weights", weights, 2))
    )
    by_camera = measurements(measured or {}, split)
    views = []
    for i, (camera, image, mask, weight) in enumerate(zip(split, pictures, shapes, counts, strict=True)):
        if image is None and mask is None and not by_camera[i]:
            which = f" for cameras[{i}]" if any(x is not None for x in (*pictures, *shapes)) or any(by_camera) else ""
            raise ValueError(f"{names[0]}: expected pictures or masks to compare with, got neither{which}")
        sure = None
        if image is not None and mask is not None:
            image, sure = over_black(image, mask)
        views.append(Observation(camera, image, mask, weight, sure, _counted(by_camera[i], mask, weight)))
    for name, values in ((names[1], shapes), ("weights", counts)):
        given = [value for value in values if value is not None]
        if given and not any(bool((value > 0).any()) for value in given):
            raise ValueError(
                f"{name}: expected numbers above 0 somewhere, got zero in every pixel; there is nothing to fit"
            )
    warn_of_faint(names[1], [mask for mask in shapes if mask is not None])
    return region_views(views) if by_region else views


def region_views(views: Sequence[Observation]) -> list[Observation]:
    """Return the views for the loss "region". Raises ValueError if there is something else to compare than pictures."""
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
    return [replace(view, by_region=True) for view in views]


def _counted(measured: dict[str, Measurement], mask: Tensor | None, weight: Tensor | None) -> dict[str, Measurement]:
    """Multiply measurements by the weights of the view's pixels, and drop those where the mask is not full: a depth there may
    be the object's, that of what lies behind, or between."""
    count = torch.ones((), dtype=torch.float32) if weight is None else weight
    count = count if mask is None else count * (mask > PICTURES.full)
    return {name: replace(one, weight=one.weight * count) for name, one in measured.items()}


def cameras_of(cameras: object) -> list[Camera]:
    """Return cameras one by one, as copies on the CPU. Raises TypeError."""
    given = [cameras] if isinstance(cameras, Camera) else cameras
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise TypeError(f"cameras: expected a Camera or a sequence of them, got {type(cameras).__name__}")
    if not given:
        raise ValueError("cameras: expected one for each picture, got an empty list; give at least one")
    split: list[Camera] = []
    for i, camera in enumerate(given):
        if not isinstance(camera, Camera):
            raise TypeError(f"cameras[{i}]: expected a Camera, got {type(camera).__name__}")
        # Autograd keeps no tensors that were made in torch.inference_mode(), so they are copied.
        camera = map_tensors(camera, lambda tensor: tensor.detach().cpu().clone())
        split += [camera] if camera.batch is None else list(camera)
    return split


def check_image(name: str, value: object, size: tuple[int, int]) -> Tensor:
    """Return (H, W, C) float32 on the CPU. Raises TypeError or ValueError."""
    if value is None or isinstance(value, (str, OsPath)):
        got = "None" if value is None else f"the path {str(value)!r}"
        read = "read_mask" if name.startswith("mask") else "read_image"
        raise TypeError(f"{name}: expected an image (H, W, C) of numbers, got {got}; read one with {read}(path)")
    image = as_tensor(name, value).detach().cpu()
    image = image.float() if image.dtype == torch.bool else image
    if name.startswith(("mask", "weight")):
        if not image.is_floating_point():
            raise TypeError(
                f"{name}: expected floating-point numbers, got {image.dtype}; of 8-bit numbers take x / 255, of 0 "
                "and 1 x.float()"
            )
        check_shape(name, image, size, (*size, 1), fix=SIZE_FIX)
    else:
        check_float(name, image)
    image = image[..., None] if image.dim() == 2 else image
    check_shape(name, image, (*size, "C"), fix=SIZE_FIX)
    check_finite(name, image)
    rounding = 1e-3
    if name.startswith("mask") and bool((image < -rounding).any() | (image > 1.0 + rounding).any()):
        raise ValueError(
            f"{name}: expected numbers from 0 to 1, got {float(image.min()):g} to {float(image.max()):g}; of 8-bit numbers take "
            "x / 255"
        )
    if name.startswith("weight") and bool((image < 0).any()):
        raise ValueError(f"{name}: expected numbers from 0 up, got {float(image.min()):g}")
    if not name.startswith("weight") and _is_of_bytes(image):
        whole = "whole " if bool((image == image.round()).all()) else ""
        warn(
            f"bytes {name}",
            f"{name}: expected linear radiance, as the scene's colours are, got {whole}numbers up to {float(image.max()):g}, "
            "as of a picture of 8 bits; take srgb_to_linear(x / 255), or read it with read_image",
        )
    return image.float()


def check_without_alpha(name: str, image: Tensor) -> None:
    """Check that a picture (H, W, C) whose colours are all compared has no alpha. Raises ValueError."""
    if (C := image.shape[-1]) in WITH_ALPHA:
        raise ValueError(
            f"{name}: expected grey or colours, got {C} channels, of which the last one would be alpha; read it with "
            f"read_image(path, channels={C - 1}), or, if alpha is 1 on the object alone, give x[..., -1:] as its mask"
        )


def warn_of_faint(name: str, masks: Sequence[Tensor]) -> None:
    """Warn if no pixel of any mask is nearly covered."""
    most = max((float(mask.max()) for mask in masks), default=0.0)
    if 0.0 < most < PICTURES.faint_mask:
        warn(
            f"faint {name}",
            f"{name}: expected 1 where the object covers the pixel, got at most {most:.3g}; divide by that number, or choose the "
            "object's label if the file has labels. read_image() is not for masks, for it undoes an sRGB curve: read_mask() is",
        )


def _is_of_bytes(image: Tensor) -> bool:
    """Whether these are 8-bit numbers converted to floats, or resized after that. Radiance of this range, as of a picture with
    a sun, is hardly whole, and low in most pixels."""
    if not image.numel() or not 100.0 < float(image.max()) <= 255.0 + PICTURES.byte_rounding:
        return False
    return bool((image == image.round()).all()) or float(image.median()) > PICTURES.darkest_byte


def over_black(image: Tensor, mask: Tensor) -> tuple[Tensor, Tensor | None]:
    """Return a picture of the object alone (H, W, C), as rendered over black, and where it is sure (H, W, 1); None: everywhere.
    The picture shows the object where the mask is full. In a pixel covered in part it may hold the object's colour (straight
    alpha), the colour times the mask (premultiplied), or a mixture with the background (a photograph), and does not say
    which. Such a pixel gets the mask times the colour grown from where the mask is full, by up to `fill_reach` pixels; beyond,
    the mask times its own colour. It is not sure."""
    colors, known = image, mask > PICTURES.full
    partial = (mask > 0.0) & ~known
    if not bool(known.any()) or not bool(partial.any()):
        return image * mask, None
    left = partial
    for _ in range(PICTURES.fill_reach):
        share = _around(known.to(image))
        fresh = left & (share > 0.01)  # a ninth, or rounding
        if not bool(fresh.any()):
            break
        colors = torch.where(fresh, _around(colors * known) / share.clamp(min=0.01), colors)
        known, left = known | fresh, left & ~fresh
    return colors * mask, (~partial).to(image)


def _around(image: Tensor) -> Tensor:
    """Return means over 3 × 3 pixels, with zeros beyond the border."""
    return F.avg_pool2d(image.movedim(-1, 0)[None], 3, stride=1, padding=1)[0].movedim(0, -1)


def displayed(image: Tensor) -> Tensor:
    """Return (H, W, 3) sRGB in 0 … 1 of linear radiance; the first channel as grey if there are fewer than three."""
    colors = image[..., :3] if image.shape[-1] >= 3 else image[..., :1].expand(-1, -1, 3)
    return linear_to_srgb(colors.detach().clamp(0.0, 1.0))


def batch_groups(views: Sequence[Observation]) -> list[list[int]]:
    """Return indices of views whose cameras can be rendered as one batch, with the same channels to compare."""
    groups: dict[Any, list[int]] = {}
    for i, view in enumerate(views):
        camera = view.camera
        lens = None if camera.distortion is None else camera.distortion.shape
        shape = None if view.image is None else view.image.shape[-1]
        key = camera.size, camera.projection, lens, camera.K.dtype, shape, view.mask is None
        key = *key, view.weight is None, view.sure is None, tuple(view.measured), view.by_region
        groups.setdefault(key, []).append(i)
    return list(groups.values())


def white_level(pixels: Tensor) -> float:
    """Return the brightness that one pixel in a hundred of (N, C) exceeds; it counts as white, for radiance may have any unit.
    If that is black, the brightest pixel is white; if all are black, 1 is."""
    if not len(pixels):
        return 1.0
    brightest = pixels.amax(1)
    white = float(brightest.kthvalue(max(1, math.ceil((1.0 - PICTURES.highlights) * len(brightest)))).values)
    white = white if white > 0.0 else float(brightest.max())
    return white if white > 0.0 else 1.0


def has_levels(picture: Tensor) -> bool:
    """Whether linear radiance of any shape has the 256 levels of an 8-bit file. White is then 1, also in a dark picture."""
    levels = 255.0 * linear_to_srgb(picture)
    return float(picture.max()) <= 1.0 and bool(((levels - levels.round()).abs() < PICTURES.rounding).all())
