"""Measured depths, normals and positions, from sensors or other renderers, and the loss that compares a render with them.

A render's channel c is multiplied by its alpha a, and so is the measurement m: r = c − a m. At a silhouette r then jumps by the
difference of two depths, not by the depth itself, so the origin of depths does not matter. Where the render shows nothing, r is
zero; the mask says that measured pixels are covered, or, without a mask, a term of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ..camera.camera import Camera
from ..check import as_tensor, check_float, check_positive, check_shape
from .by_camera import numbered, one_for_each

# Arguments stand for these channels of render_aovs(), of so many numbers.
CHANNELS = {"depths": ("depth", 1), "normals": ("shading_normal", 3), "positions": ("position", 3)}
NORMAL_SCALE = 0.1  # about 6°
SIZE_FIX = "the camera must have the picture's size: camera.resized((H, W))"
MAD = 1.4826  # standard deviation of Gaussian noise over the median of its sizes


@dataclass(frozen=True, eq=False)
class Measured:
    """Measured depths, normals, positions or keypoints, and how far to trust them.

    Parameters
    ----------
    values : Tensor or sequence
        For each camera (H, W), (H, W, 1) or (H, W, 3), or None where it has none. A pixel that is not finite, or 0 (of normals
        and positions in all three), is not measured. Of keypoints pixels by the joints' names.
    weights : Tensor or sequence, optional
        For each camera (H, W) or (H, W, 1), ≥ 0: how much a pixel counts, as a sensor's confidence says; by default 1.
    factor : float, default 1.0
        Weight of all of them relative to their usual one.
    scale : float, optional
        Residuals up to about this are noise, in the units of `values`; much larger ones count as outliers once most are below.
        By default the width of a pixel at the object, and 0.1 for normals.

    Raises
    ------
    TypeError, ValueError
        A number is none, or out of range.
    """

    values: Any
    weights: Any = None
    factor: float = 1.0
    scale: float | None = None

    def __post_init__(self) -> None:
        check_positive("factor", self.factor, least=0.0, most=1e9)
        if self.scale is not None:
            check_positive("scale", self.scale, least=1e-30, most=1e30)


@dataclass(frozen=True, eq=False)
class Measurement:
    """A measured channel of one view. `factor` and `scale` are the same in all views."""

    value: Tensor  # (H, W, c), zero where nothing was measured
    weight: Tensor  # (H, W, 1), zero there too
    factor: float
    scale: float
    metric: bool  # whether the scale is a pixel's width, which grows with pixels

    def resized(self, size: tuple[int, int]) -> Measurement:
        """Average over larger pixels; a pixel is measured if at least half of it is."""
        H, W = self.value.shape[:2]
        weight = area_mean(self.weight, size)
        value = area_mean(self.value * self.weight, size) / weight.clamp(min=1e-30)
        known = (area_mean((self.weight > 0).float(), size) >= 0.5).float()
        scale = self.scale * (H * W / (size[0] * size[1])) ** 0.5 if self.metric else self.scale
        return replace(self, value=value * known, weight=weight * known, scale=scale)

    def displayed(self, value: Tensor) -> Tensor:
        """Map (H, W, c) to 0 … 1, the range of the measured values."""
        seen = self.value[self.weight[..., 0] > 0]
        low, high = (seen.amin(0), seen.amax(0)) if len(seen) else (value.amin(), value.amax())
        return ((value - low) / (high - low).clamp(min=1e-30)).clamp(0.0, 1.0)


def measurements(given: Mapping[str, Any], cameras: Sequence[Camera]) -> list[dict[str, Measurement]]:
    """Return for each camera its measurements by the channel of render_aovs(). `given` has a Measured, or its values, by the
    argument's name. Raises TypeError or ValueError that names the argument."""
    found: list[dict[str, Measurement]] = [{} for _ in cameras]
    for name, value in given.items():
        if value is None:
            continue
        trust, (channel, width) = value if isinstance(value, Measured) else Measured(value), CHANNELS[name]
        pictures = one_for_each(name, trust.values, len(cameras), 2 if width == 1 else 3)
        weights = one_for_each(f"weights of {name}", trust.weights, len(cameras), 2)
        checked: dict[int, tuple[Tensor, Tensor]] = {}
        for i, (picture, weight, camera) in enumerate(zip(pictures, weights, cameras, strict=True)):
            where = numbered(name, i, len(cameras))
            if picture is not None:
                checked[i] = _checked(where, picture, weight, width, camera.size)
            elif weight is not None:
                raise ValueError(f"{where}: expected a picture with its weights, got None")
        if not any(bool((weight > 0).any()) for _, weight in checked.values()):
            raise ValueError(
                f"{name}: expected a pixel that was measured, got none: all are 0, not finite, or have the weight 0"
            )
        longest = max(float(picture.norm(dim=-1).max()) for picture, _ in checked.values())
        if name == "normals" and not 0.5 < longest < 1.01:
            raise ValueError(
                f"normals: expected vectors of length 1 in world axes, got lengths up to {longest:g}; of 8-bit numbers take "
                "x / 127.5 − 1"
            )
        metric = trust.scale is None and name != "normals"
        scale = _pixel_width(name, checked, cameras) if metric else trust.scale or NORMAL_SCALE
        for i, measured in checked.items():
            found[i][channel] = Measurement(*measured, trust.factor, scale, metric)
    return found


def depth_images(depths: Any, cameras: Sequence[Camera]) -> list[Tensor | None]:
    """Return the measured depth (H, W) of each camera, NaN where there is none. Raises TypeError or ValueError."""
    found = [given.get("depth") for given in measurements({"depths": depths}, cameras)]
    return [None if one is None else torch.where(one.weight > 0, one.value, torch.nan)[..., 0] for one in found]


def measured_image(name: str, given: Any, size: tuple[int, int], width: int = 1) -> Tensor:
    """Return measured values (H, W, width), NaN where nothing was measured. Raises TypeError or ValueError."""
    value = as_tensor(name, given).detach().cpu()
    if not value.is_floating_point():
        raise TypeError(
            f"{name}: expected floating-point numbers, got {value.dtype}; of a sensor's integers take x.float() times its unit"
        )
    check_float(name, value)
    shapes = [(*size, 1), size] if width == 1 else [(*size, width)]
    check_shape(name, value, *shapes, fix=SIZE_FIX)
    value = value.reshape(*size, width).float()
    known = value.isfinite().all(-1, keepdim=True) & (value != 0).any(-1, keepdim=True)
    if width == 1 and bool((value[known] < 0).any()):
        raise ValueError(
            f"{name}: expected depths along the optical axis, +Z, from 0 up, got {float(value[known].min()):g}; OpenGL's look "
            "along −Z: take −z"
        )
    return torch.where(known, value, torch.nan)


def _checked(name: str, picture: Any, weight: Any, width: int, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return values (H, W, width) and weights (H, W, 1), both zero where nothing was measured. Raises TypeError or
    ValueError."""
    value = measured_image(name, picture, size, width)
    known, value = value.isfinite().all(-1, keepdim=True), value.nan_to_num()
    if weight is None:
        return value, known.float()
    count = as_tensor(f"weights of {name}", weight).detach().cpu().float()
    check_shape(f"weights of {name}", count, (*size, 1), size, fix=SIZE_FIX)
    if not bool((count >= 0).all()) or not bool(count.isfinite().all()):
        raise ValueError(f"weights of {name}: expected finite numbers from 0 up, got {float(count.min()):g}")
    known = known & (count.reshape(*size, 1) > 0)
    return value * known, count.reshape(*size, 1) * known


def _pixel_width(name: str, pictures: Mapping[int, tuple[Tensor, Tensor]], cameras: Sequence[Camera]) -> float:
    """Return the median over views of what a pixel covers at the measured surface."""
    widths = []
    for i, (value, weight) in pictures.items():
        camera, seen = cameras[i], value[weight[..., 0] > 0]
        if not len(seen):
            continue
        away = torch.ones(1, dtype=torch.float32)
        if camera.projection != "orthographic":
            if name == "positions":
                pose = camera.world_to_camera.float()
                away = (seen @ pose[:3, :3].T + pose[:3, 3]).norm(dim=1)
            else:
                away = seen[:, 0]
        widths.append(float(away.median()) / float(camera.K[0, 0].abs()))
    return max(sorted(widths)[len(widths) // 2], 1e-30)


def comparable(render: Tensor, alpha: Tensor, given: Measurement) -> tuple[Tensor, Tensor]:
    """Return a target for a render (H, W, c) with alpha (H, W, 1), which is the render itself where nothing was measured, and
    weights."""
    known = given.weight > 0
    return torch.where(known, alpha * given.value, render), given.weight


def measured_loss(render: Tensor, alpha: Tensor, given: Sequence[Measurement], covers: bool) -> Tensor:
    """Return the loss of renders (B, H, W, c) with alpha (B, H, W, 1), a mean over all pixels.

    With x = |r| / s it is Geman and McClure's 2x² / (x² + 4), which levels off for outliers, times s / scale. s is the
    residuals' median size, and the scale at least, so that a shape that is far away does not count as an outlier.

    covers  whether the render must be opaque at pixels that are measured with all their neighbours, for there is no mask
    """
    value, weight = torch.stack([m.value for m in given]), torch.stack([m.weight for m in given])
    square = (render - alpha * value).square().sum(-1, keepdim=True)
    scale, typical = given[0].scale, 0.0
    with torch.no_grad():
        seen = (weight > 0) & (alpha > 0.5)
        if bool(seen.any()):
            typical = MAD * float(square[seen].median().sqrt())
    s = max(scale, typical)
    x2 = square / s**2
    total = (s / scale) * (weight * 2.0 * x2 / (x2 + 4.0)).mean()
    if covers:
        inner = -F.max_pool2d(-(weight > 0).float().movedim(-1, 1), 3, 1, 1).movedim(1, -1)
        total = total + (weight * inner * (1.0 - alpha).square()).mean()
    return given[0].factor * total


def area_mean(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize by means over the new pixels' areas, which a render of that size with the box filter estimates."""
    return F.interpolate(image.movedim(-1, 0)[None], size=size, mode="area")[0].movedim(0, -1)
