"""Cameras: where a point lands in the image.

A point p in world units goes to camera coordinates `q = R p + t` (+X right, +Y down, +Z forward, as in OpenCV) and from there
to the pixel position (x, y), x to the right and y down, the corner of the image at (0, 0), pixel centres at +0.5:

    perspective   (x, y) = K[:2] (X/Z, Y/Z, 1)    or through a lens that distorts: K[:2] (m, 1), with m a function of (X/Z, Y/Z)
    fisheye       (x, y) = K[:2] (m, 1)           the distance from the middle is a polynomial of the angle to the axis
    panorama      (x, y) = K[:2] (λ, φ, 1)        longitude λ = atan2(X, Z), latitude φ = atan2(Y, √(X² + Z²)): all around
    orthographic  (x, y) = K[:2] (X, Y, 1)        everything on the line is seen, also behind the camera's position
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..check import as_int, as_tensor, check_fields, check_finite, check_float, check_int
from ..scene.state import from_state, to_state
from .conventions import Conventions
from .lens import distort, longitude_latitude
from .poses import constant, image_size
from .viewpoints import Viewpoints


@dataclass(frozen=True, eq=False)
class Camera(Viewpoints, Conventions):
    """One camera, or a batch of B that look at one scene.

    A fisheye shows up to all around, 180° from its axis, a perspective lens what lies less than 88° from it. Where the
    distortion folds the image over, it ends: beyond there is background, and a render warns with the radius. The motion of that
    lens boundary with the distortion and with K has its gradient. All tensors are differentiable. Numbers reach up to 3.4e38,
    the range of float32, also in float64, and so do those of the inverse of K. Raises TypeError for a wrong type, ValueError
    for a wrong shape or value.

    Parameters
    ----------
    world_to_camera : (4, 4) or (B, 4, 4) float
        Rigid: a rotation and a translation, last row (0, 0, 0, 1).
    K : (3, 3) or (B, 3, 3) float
        Pixels (orthographic: pixels a world unit; panorama: pixels a radian), last row (0, 0, 1); skew is allowed.
    size : (H, W)
        Image size in pixels.
    projection : "perspective", "fisheye", "panorama" or "orthographic", default "perspective"
    distortion : (4,), (5,), (8,) or (B, ·)
        Of a perspective lens, Brown–Conrady: k1, k2, p1, p2, k3, k4, k5, k6, as OpenCV has them (12 or 14 if zeros follow). Of
        a fisheye (4,): k1, k2, k3, k4. None is a pinhole, or a fisheye without.
    """

    @classmethod
    def stack(cls, cameras: Sequence[Camera]) -> Camera:
        """Return one batch of cameras of the same size and projection."""
        if isinstance(cameras, Camera) or not isinstance(cameras, Iterable):
            got = "one Camera; put it in a list" if isinstance(cameras, Camera) else type(cameras).__name__
            raise TypeError(f"cameras: expected a sequence of cameras, got {got}")
        cameras = list(cameras)
        if not cameras:
            raise ValueError("cameras: expected at least one camera, got none")
        first = cameras[0]
        for i, camera in enumerate(cameras):
            if not isinstance(camera, Camera):
                raise TypeError(f"cameras[{i}]: expected a Camera, got {type(camera).__name__}")
            same = (camera.size, camera.projection, _count(camera)) == (first.size, first.projection, _count(first))
            if not same or camera.batch is not None:
                raise ValueError(
                    f"cameras[{i}]: expected a single {first.projection} camera of size {first.size}"
                    + (f" with {_count(first)} coefficients of distortion" if _count(first) else "")
                    + f", got {camera!r}"
                )
        return cls(
            torch.stack([c.world_to_camera for c in cameras]),
            torch.stack([c.K for c in cameras]),
            first.size,
            first.projection,
            None if first.distortion is None else torch.stack([c.coefficients for c in cameras]),
        )

    # -- what one can do with it ----------------------------------------------------------------------------------

    @property
    def batch(self) -> int | None:
        """Return B, or None for a single camera."""
        for tensor, single in ((self.world_to_camera, 2), (self.K, 2), (self.distortion, 1)):
            if tensor is not None and tensor.dim() > single:
                return tensor.shape[0]
        return None

    def __len__(self) -> int:
        """Return B. Raises TypeError for a single camera."""
        if self.batch is None:
            raise TypeError("camera: expected a batch of cameras, got a single one, which has no length")
        return self.batch

    def __bool__(self) -> bool:
        return True  # also a single camera, which has no length

    def __getitem__(self, index: int | slice) -> Camera:
        """Return a camera of a batch, or with a slice a batch of some. Raises TypeError for a single camera, IndexError."""
        count = len(self)
        if not isinstance(index, slice):
            index = as_int("index", index)
            if not -count <= index < count:
                raise IndexError(f"index: expected one from {-count} to {count - 1}, got {index}")
        elif not range(count)[index]:
            raise IndexError(f"index: expected some of {count} cameras, got none by {index}")
        single = {"world_to_camera": 2, "K": 2, "distortion": 1}
        fields = {name: getattr(self, name) for name in single}
        own = {n: t[index] for n, t in fields.items() if t is not None and t.dim() > single[n]}
        return self.replace(**own)

    def __iter__(self) -> Iterator[Camera]:
        """Yield the cameras of a batch, one by one. Raises TypeError for a single camera."""
        return (self[i] for i in range(len(self)))

    @property
    def eye(self) -> Tensor:
        """Return the camera's position, (3,) or (B, 3), in world units; differentiable."""
        R, t = self.world_to_camera[..., :3, :3], self.world_to_camera[..., :3, 3]
        return -(R * t[..., None]).sum(-2)

    @property
    def fov_x(self) -> Tensor:
        """Return the full horizontal field of view in degrees, () or (B,), differentiable. See fov_y."""
        return self._fov(0)

    @property
    def fov_y(self) -> Tensor:
        """Return the full vertical field of view in degrees, () or (B,), differentiable.

        It goes through the principal point and ignores distortion. Raises ValueError for an orthographic camera, which has
        none.
        """
        return self._fov(1)

    def _fov(self, axis: int) -> Tensor:
        if self.projection == "orthographic":
            raise ValueError("fov: expected a camera with a field of view, got an orthographic one; it has size and K")
        focal, center, pixels = self.K[..., axis, axis], self.K[..., axis, 2], self.size[1 - axis]
        if self.projection != "perspective":  # the angle from the axis grows evenly
            return torch.rad2deg(pixels / focal)
        return torch.rad2deg(torch.atan(center / focal) + torch.atan((pixels - center) / focal))

    @property
    def lens(self) -> str:
        """Return the kind of distortion: "brown-conrady", "fisheye", "panorama" or, without any, "pinhole"."""
        if self.projection in ("fisheye", "panorama"):
            return self.projection
        return "pinhole" if self.distortion is None else "brown-conrady"

    @property
    def coefficients(self) -> Tensor:
        """Return the distortion; zeros (4,) where there is none."""
        return self.K.new_zeros(4) if self.distortion is None else self.distortion

    def crop(self, top: int, left: int, height: int, width: int) -> Camera:
        """Return the camera of a part of the image, in pixels; it may reach beyond the image. Raises TypeError or
        ValueError."""
        shift = torch.zeros_like(self.K)
        shift[..., 0, 2] = check_int("left", left, -(2**31), 2**31)
        shift[..., 1, 2] = check_int("top", top, -(2**31), 2**31)
        height, width = check_int("height", height, 1, 1 << 16), check_int("width", width, 1, 1 << 16)
        return self.replace(K=self.K - shift, size=(height, width))

    def resized(self, size: tuple[int, int]) -> Camera:
        """Return the same view with another number of pixels (H, W)."""
        H, W = image_size(size)
        factor = constant([[W / self.size[1]], [H / self.size[0]], [1.0]], self.K)
        return self.replace(K=self.K * factor, size=(H, W))

    def replace(self, **fields: Any) -> Camera:
        """Return this camera with some fields replaced."""
        check_fields(self, fields)
        return dataclasses.replace(self, **fields)

    def project(self, points: Tensor) -> Tensor:
        """Return pixel positions (…, 2) of world points (…, 3), differentiable; of a batch (B, …, 2), all points in each
        camera.

        Positions are not finite in the plane of a perspective camera, nor right behind a fisheye. Points that a lens does not
        show, beyond a fold or behind it, may have a position, too. Of all positions in a panorama, the one within ±180° is
        returned. Raises TypeError or ValueError.
        """
        points = as_tensor("points", points, like=self.K)
        check_float("points", points)
        if points.dim() == 0 or points.shape[-1] != 3:
            raise ValueError(f"points: expected shape (…, 3), got {tuple(points.shape)}")
        check_finite("points", points)
        if self.batch is not None:
            return torch.stack([camera.project(points) for camera in self])
        M, K = self.world_to_camera, self.K
        q = (M[:3, :3] * points[..., None, :]).sum(-1) + M[:3, 3]
        if self.projection == "panorama":
            uv = longitude_latitude(q)
        elif self.projection == "orthographic":
            uv = q[..., :2]
        elif self.lens != "pinhole":
            uv = distort(self.projection, q, self.coefficients)
        else:
            uv = q[..., :2] / q[..., 2:]
        return (K[:2, :2] * uv[..., None, :]).sum(-1) + K[:2, 2]

    def to(self, *args: Any, **kwargs: Any) -> Camera:
        """Return the camera on a device or of a dtype, as `torch.Tensor.to`."""
        return self._map(lambda tensor: tensor.to(*args, **kwargs))

    def detach(self) -> Camera:
        """Return the camera cut from the autograd graph."""
        return self._map(Tensor.detach)

    def state_dict(self) -> dict[str, Any]:
        """The camera, or batch, as a dictionary of tensors, strings and numbers; see Scene.state_dict()."""
        return to_state(self, (Camera,))

    @staticmethod
    def from_state_dict(state: dict[str, Any]) -> Camera:
        """The camera of a state_dict(), with the same tensors. Raises TypeError or ValueError."""
        return from_state(state, Camera, (Camera,))

    def _map(self, f: Callable[[Tensor], Tensor]) -> Camera:
        distortion = None if self.distortion is None else f(self.distortion)
        return self.replace(world_to_camera=f(self.world_to_camera), K=f(self.K), distortion=distortion)

    def __repr__(self) -> str:
        many = "" if self.batch is None else f"{self.batch} × "
        kind = self.projection + (" with distortion" if self.lens == "brown-conrady" else "")
        return f"Camera({many}{kind}, {self.size[0]} × {self.size[1]} pixels, {self.world_to_camera.dtype})"


def _count(camera: Camera) -> int:
    return 0 if camera.distortion is None else camera.distortion.shape[-1]
