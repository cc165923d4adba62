"""Cameras: where a point lands in the image.

A point p in world units goes to camera coordinates `q = R p + t` (+X right, +Y down, +Z forward, as in OpenCV) and
from there to the pixel position (x, y), x to the right and y down, the corner of the image at (0, 0), pixel centres at +0.5:

    perspective   (x, y) = K[:2] (X/Z, Y/Z, 1)    or through a lens that distorts: K[:2] (m, 1), with m a function of (X/Z, Y/Z)
    fisheye       (x, y) = K[:2] (m, 1)           the distance from the middle is a polynomial of the angle to the axis
    panorama      (x, y) = K[:2] (λ, φ, 1)        longitude λ = atan2(X, Z), latitude φ = atan2(Y, √(X² + Z²)): all around
    orthographic  (x, y) = K[:2] (X, Y, 1)        everything on the line is seen, also behind the camera's position
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ._check import (
    LARGEST,
    as_scalar,
    as_tensor,
    check_fields,
    check_finite,
    check_float,
    check_int,
    check_positive_int,
    check_shape,
    values_visible,
)
from ._lens import COUNTS, TURNS, bend, longitude_latitude

Vector = Tensor | Sequence[float]


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera, or a batch of B that look at one scene.

    world_to_camera  (4, 4) or (B, 4, 4) float   rigid: a rotation and a translation, last row (0, 0, 0, 1)
    K                (3, 3) or (B, 3, 3) float   pixels (orthographic: pixels a world unit; panorama: pixels a radian), last row
                                                 (0, 0, 1); skew allowed
    size             (H, W)                      image size in pixels
    projection       "perspective", "fisheye", "panorama" or "orthographic"
    distortion       (4,), (5,), (8,) or (B, ·)  of a perspective lens, Brown–Conrady: k1, k2, p1, p2, k3, k4, k5, k6, as OpenCV
                     has them (12 or 14 if zeros follow); of a fisheye (4,): k1, k2, k3, k4; None: a pinhole, or a fisheye without

    A fisheye shows up to all around, 180° from its axis, a perspective lens what lies less than 88° from it. Where the distortion
    folds the image over, it ends: beyond there is background, and a render warns with the radius. How that rim moves with the
    distortion and with K has its gradient.

    All tensors are differentiable. Numbers reach up to 3.4e38, the range of float32, also in float64, and so do those of
    the inverse of K. Raises TypeError for a wrong type, ValueError for a wrong shape or value.
    """

    world_to_camera: Tensor
    K: Tensor
    size: tuple[int, int]
    projection: str = "perspective"
    distortion: Tensor | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "world_to_camera", as_tensor("world_to_camera", self.world_to_camera, floating=True))
        object.__setattr__(self, "K", as_tensor("K", self.K, like=self.world_to_camera))
        for name in ("world_to_camera", "K"):
            check_float(name, getattr(self, name))
        check_shape("world_to_camera", self.world_to_camera, (4, 4), ("B", 4, 4))
        check_shape("K", self.K, (3, 3), ("B", 3, 3))
        if self.K.dim() == self.world_to_camera.dim() == 3 and self.K.shape[0] != self.world_to_camera.shape[0]:
            raise ValueError(
                f"K: expected a batch of {self.world_to_camera.shape[0]} like world_to_camera, got {self.K.shape[0]}; "
                "give one K (3, 3) for all or as many as cameras"
            )
        object.__setattr__(self, "size", _size(self.size))
        if self.projection not in COUNTS:
            raise ValueError(f"projection: expected one of {', '.join(map(repr, COUNTS))}, got {self.projection!r}")
        if self.distortion is not None:
            distortion = as_tensor("distortion", self.distortion, like=self.K)
            if self.projection == "perspective" and distortion.dim() > 0:
                distortion = _without_zeros(distortion)
            object.__setattr__(self, "distortion", distortion)
            self._check_distortion(self.distortion)
        self._check_values()

    def _check_distortion(self, distortion: Tensor) -> None:
        counts = COUNTS[self.projection]
        if not counts:
            article = "an" if self.projection == "orthographic" else "a"
            raise ValueError(
                f"distortion: expected None for {article} {self.projection} camera, got {tuple(distortion.shape)}"
            )
        check_float("distortion", distortion)
        check_shape("distortion", distortion, *((n,) for n in counts), *(("B", n) for n in counts))
        check_finite("distortion", distortion)
        for name, other in (("world_to_camera", self.world_to_camera), ("K", self.K)):
            if distortion.dim() == 2 and other.dim() == 3 and len(other) != len(distortion):
                raise ValueError(
                    f"distortion: expected a batch of {len(other)} like {name}, got {len(distortion)}; "
                    "give one for all or as many as cameras"
                )

    def _check_values(self) -> None:
        for name, matrix, last in (
            ("world_to_camera", self.world_to_camera, [0.0, 0.0, 0.0, 1.0]),
            ("K", self.K, [0.0, 0.0, 1.0]),
        ):
            _check_last_row(name, matrix, last)
        _check_rotation("world_to_camera", self.world_to_camera[..., :3, :3])
        if not values_visible(self.K):
            return
        A = self.K.detach().double()[..., :2, :2]
        # The inverse of [[a, b], [c, d]] has the same numbers, over the determinant.
        inverse = A.abs().amax((-2, -1)) / torch.linalg.det(A).abs()
        if not bool((inverse <= LARGEST).all()):
            raise ValueError(
                "K: expected focal lengths that are not zero, got a singular matrix"
                + (f" (its inverse reaches {float(inverse.max()):.3g})" if bool(torch.isfinite(inverse).all()) else "")
                + "; give a focal length in pixels to each axis"
            )
        if self.projection == "panorama":
            self._check_turns()

    def _check_turns(self) -> None:
        """What the kernel draws of a panorama, it draws once for each turn."""
        H, W = self.size
        K = self.K.detach().double().reshape(-1, 3, 3)
        corners = K.new_tensor([[x, y] for x in (-1.0, W + 1.0) for y in (-1.0, H + 1.0)])
        angles = torch.linalg.solve(K[:, None, :2, :2], (corners - K[:, None, :2, 2])[..., None])
        turns = float(angles.abs().max()) / math.tau
        if not turns <= TURNS:
            raise ValueError(
                f"K: expected a panorama that reaches no more than {TURNS} turns from its axis, got {turns:.4g}; "
                "K is in pixels a radian: width / 2π for all around, height / π from pole to pole"
            )

    # -- how to make one ------------------------------------------------------------------------------------------

    @staticmethod
    def look_at(
        eye: Vector,
        target: Vector,
        up: Vector = (0.0, 1.0, 0.0),
        fov_y: float | Tensor = 40.0,
        size: tuple[int, int] = (256, 256),
    ) -> Camera:
        """Perspective camera at `eye` (3,) looking at `target` (3,), with `up` (3,) upwards in the image.

        fov_y: full vertical field of view in degrees, in (0, 180); square pixels, principal point in the middle.
        """
        world_to_camera = _look_at(eye, target, up)
        H, W = _size(size)
        focal = _focal(fov_y, H, like=world_to_camera)
        return Camera(world_to_camera, _intrinsics(focal, focal, 0.5 * W, 0.5 * H), (H, W))

    @staticmethod
    def orthographic(
        eye: Vector,
        target: Vector,
        up: Vector = (0.0, 1.0, 0.0),
        height: float | Tensor = 2.0,
        size: tuple[int, int] = (256, 256),
    ) -> Camera:
        """Orthographic camera that looks from `eye` towards `target` and shows `height` world units from top to bottom."""
        world_to_camera = _look_at(eye, target, up)
        height = as_scalar("height", height, like=world_to_camera)
        if values_visible(height) and not 0.0 < float(height.detach()) < math.inf:
            raise ValueError(f"height: expected world units above 0, got {float(height):g}")
        H, W = _size(size)
        scale = H / height
        return Camera(world_to_camera, _intrinsics(scale, scale, 0.5 * W, 0.5 * H), (H, W), "orthographic")

    @staticmethod
    def from_opencv(R: Vector, t: Vector, K: Vector, size: tuple[int, int], distortion: Vector | None = None) -> Camera:
        """From OpenCV's extrinsics: R (3, 3) and t (3,) with `q = R p + t`, K (3, 3) in pixels, and, of a lens that distorts,
        k1, k2, p1, p2[, k3[, k4, k5, k6]], as cv2.calibrateCamera returns them.

        OpenCV puts the centre of the first pixel at 0, edgegrad at 0.5: K's principal point is shifted by half a pixel.
        """
        return _from_opencv(R, t, K, size, "perspective", distortion)

    @staticmethod
    def fisheye(R: Vector, t: Vector, K: Vector, size: tuple[int, int], distortion: Vector | None = None) -> Camera:
        """A fisheye from OpenCV's R (3, 3), t (3,), K (3, 3) in pixels and k1, k2, k3, k4, as cv2.fisheye.calibrate returns
        them; see from_opencv. It may show more than a half space, up to 180° from the axis."""
        return _from_opencv(R, t, K, size, "fisheye", distortion)

    @staticmethod
    def panorama(world_to_camera: Vector, size: tuple[int, int], K: Vector | None = None) -> Camera:
        """All around the camera (equirectangular): longitude to the right, latitude downwards, +Z in the middle.

        world_to_camera  (4, 4)   rigid, +X right, +Y down, +Z forward
        size             (H, W)   pixels
        K                (3, 3)   pixels a radian and the pixel where +Z is seen, for a part of it or for several turns; None:
                                  360° from left to right, 180° from top to bottom

        It goes on beyond ±180°, and over the poles along the opposite meridian, so what crosses the image's border comes back at
        the other. Raises TypeError or ValueError.
        """
        pose = as_tensor("world_to_camera", world_to_camera, floating=True)
        check_float("world_to_camera", pose)
        H, W = _size(size)
        if K is None:
            K = pose.new_tensor([[W / math.tau, 0.0, 0.5 * W], [0.0, H / math.pi, 0.5 * H], [0.0, 0.0, 1.0]])
        return Camera(pose, as_tensor("K", K, like=pose), (H, W), "panorama")

    @staticmethod
    def from_opengl(
        camera_to_world: Vector, size: tuple[int, int], fov_y: float | Tensor | None = None, K: Vector | None = None
    ) -> Camera:
        """From an OpenGL or Blender pose: camera_to_world (4, 4), +X right, +Y up, looking along −Z.

        Give fov_y (degrees, square pixels, centred) or K (3, 3) in pixels with pixel centres at +0.5.
        """
        pose = as_tensor("camera_to_world", camera_to_world, floating=True)
        check_float("camera_to_world", pose)
        check_shape("camera_to_world", pose, (4, 4))
        if (fov_y is None) == (K is None):
            raise TypeError("from_opengl: expected one of fov_y and K, got " + ("both" if K is not None else "none"))
        _check_last_row("camera_to_world", pose, [0.0, 0.0, 0.0, 1.0])
        _check_rotation("camera_to_world", pose[:3, :3])
        flip = torch.tensor([1.0, -1.0, -1.0], dtype=pose.dtype, device=pose.device)
        R = (pose[:3, :3] * flip).mT
        t = -(R * pose[:3, 3]).sum(-1)
        if K is None:
            assert fov_y is not None
            H, W = _size(size)
            focal = _focal(fov_y, H, like=pose)
            K = _intrinsics(focal, focal, 0.5 * W, 0.5 * H)
        return Camera(_rigid(R, t), as_tensor("K", K, like=pose), size)

    @staticmethod
    def stack(cameras: Sequence[Camera]) -> Camera:
        """One batch from cameras of the same size and projection."""
        if isinstance(cameras, Camera):
            raise TypeError("cameras: expected a sequence of cameras, got one Camera; put it in a list")
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
        return Camera(
            torch.stack([c.world_to_camera for c in cameras]),
            torch.stack([c.K for c in cameras]),
            first.size,
            first.projection,
            None if first.distortion is None else torch.stack([c.coefficients for c in cameras]),
        )

    # -- what one can do with it ----------------------------------------------------------------------------------

    @property
    def batch(self) -> int | None:
        """B, or None for a single camera."""
        for tensor, single in ((self.world_to_camera, 2), (self.K, 2), (self.distortion, 1)):
            if tensor is not None and tensor.dim() > single:
                return tensor.shape[0]
        return None

    @property
    def lens(self) -> str:
        """What bends straight lines: "brown-conrady", "fisheye", "panorama" or, where nothing does, "pinhole"."""
        if self.projection in ("fisheye", "panorama"):
            return self.projection
        return "pinhole" if self.distortion is None else "brown-conrady"

    @property
    def coefficients(self) -> Tensor:
        """The distortion; zeros (4,) where there is none."""
        return self.K.new_zeros(4) if self.distortion is None else self.distortion

    def crop(self, top: int, left: int, height: int, width: int) -> Camera:
        """The camera of a part of the image, in pixels; it may reach beyond the image. Raises TypeError or ValueError."""
        shift = torch.zeros_like(self.K)
        shift[..., 0, 2] = check_int("left", left, -(2**31), 2**31)
        shift[..., 1, 2] = check_int("top", top, -(2**31), 2**31)
        return self.replace(K=self.K - shift, size=(height, width))

    def resized(self, size: tuple[int, int]) -> Camera:
        """The same view with another number of pixels (H, W)."""
        H, W = _size(size)
        factor = self.K.new_tensor([[W / self.size[1]], [H / self.size[0]], [1.0]])
        return self.replace(K=self.K * factor, size=(H, W))

    def replace(self, **fields: Any) -> Camera:
        """This camera with some fields replaced."""
        check_fields(self, fields)
        return dataclasses.replace(self, **fields)

    def project(self, points: Tensor) -> Tensor:
        """Pixel positions (…, 2) of world points (…, 3), differentiable; a single camera only.

        Not finite in the plane of a perspective camera, nor right behind a fisheye. What a lens does not show, beyond a fold or
        behind it, may have a position too. Of all positions in a panorama, the one within ±180°. Raises TypeError or ValueError.
        """
        points = as_tensor("points", points, like=self.K)
        check_float("points", points)
        if points.dim() == 0 or points.shape[-1] != 3:
            raise ValueError(f"points: expected shape (…, 3), got {tuple(points.shape)}")
        check_finite("points", points)
        if self.batch is not None:
            raise ValueError(f"project: expected a single camera, got a batch of {self.batch}; call once for each")
        M, K = self.world_to_camera, self.K
        q = (M[:3, :3] * points[..., None, :]).sum(-1) + M[:3, 3]
        if self.projection == "panorama":
            uv = longitude_latitude(q)
        elif self.projection == "orthographic":
            uv = q[..., :2]
        elif self.lens != "pinhole":
            uv = bend(self.projection, q, self.coefficients)
        else:
            uv = q[..., :2] / q[..., 2:]
        return (K[:2, :2] * uv[..., None, :]).sum(-1) + K[:2, 2]

    def to(self, *args: Any, **kwargs: Any) -> Camera:
        """Tensors moved to a device or dtype, as `torch.Tensor.to`."""
        return self._map(lambda tensor: tensor.to(*args, **kwargs))

    def detach(self) -> Camera:
        """The same camera, cut from the autograd graph."""
        return self._map(Tensor.detach)

    def _map(self, f: Callable[[Tensor], Tensor]) -> Camera:
        distortion = None if self.distortion is None else f(self.distortion)
        return self.replace(world_to_camera=f(self.world_to_camera), K=f(self.K), distortion=distortion)

    def __repr__(self) -> str:
        many = "" if self.batch is None else f"{self.batch} × "
        kind = self.projection + (" with distortion" if self.lens == "brown-conrady" else "")
        return f"Camera({many}{kind}, {self.size[0]} × {self.size[1]} pixels, {self.world_to_camera.dtype})"


def _from_opencv(
    R: Vector, t: Vector, K: Vector, size: tuple[int, int], projection: str, distortion: Vector | None
) -> Camera:
    R = as_tensor("R", R, floating=True)
    check_float("R", R)
    t = as_tensor("t", t, like=R)
    K = as_tensor("K", K, like=R)
    check_shape("R", R, (3, 3))
    check_shape("K", K, (3, 3))
    check_float("t", t)
    if t.numel() != 3:
        raise ValueError(f"t: expected 3 numbers, got shape {tuple(t.shape)}")
    check_finite("t", t)
    _check_rotation("R", R)
    if distortion is not None:
        distortion = as_tensor("distortion", distortion, like=R)
        if distortion.dim() == 2 and 1 in distortion.shape:  # as OpenCV returns it
            distortion = distortion.reshape(-1)
    half = torch.zeros_like(K)
    half[:2, 2] = 0.5
    return Camera(_rigid(R, t.reshape(3)), K + half, size, projection, distortion)


def _without_zeros(distortion: Tensor) -> Tensor:
    """The first eight of OpenCV's 12 or 14 coefficients, where the others are zero. Raises ValueError where they are not."""
    count, most = distortion.shape[-1], max(COUNTS["perspective"])
    if count not in (12, 14):
        return distortion
    if not values_visible(distortion):
        raise ValueError(
            f"distortion: expected 4, 5 or 8 coefficients in a transform of torch, got {count}; leave out the zeros"
        )
    thin_prism, tilt = distortion.detach()[..., most:12], distortion.detach()[..., 12:]
    if not bool(thin_prism.any() or tilt.any()):
        return distortion[..., :most]
    which = "a thin prism (s1 to s4)" if bool(thin_prism.any()) else "a tilt of the sensor (τx, τy)"
    raise ValueError(
        f"distortion: expected OpenCV's 4, 5 or 8 coefficients, or zeros after them, got {count} with {which}; calibrate "
        "without cv2.CALIB_THIN_PRISM_MODEL and cv2.CALIB_TILTED_MODEL, or undistort the images with cv2.undistort and leave "
        "the distortion out"
    )


def _count(camera: Camera) -> int:
    return 0 if camera.distortion is None else camera.distortion.shape[-1]


def _size(size: tuple[int, int]) -> tuple[int, int]:
    try:
        H, W = size
    except (TypeError, ValueError):
        raise TypeError(f"size: expected (height, width), got {size!r}") from None
    return check_positive_int("size", H, most=65536), check_positive_int("size", W, most=65536)


def _check_last_row(name: str, matrix: Tensor, expected: list[float]) -> None:
    """`matrix` (…, n, n) is finite and ends with the row `expected`. Raises ValueError."""
    check_finite(name, matrix)
    if not values_visible(matrix):
        return
    last = matrix.detach()[..., -1, :]
    if not torch.equal(last, last.new_tensor(expected).expand_as(last)):
        got = last.reshape(-1, len(expected))[0].tolist()
        raise ValueError(f"{name}: expected the last row {expected}, got {got}; is it transposed?")


def _check_rotation(name: str, matrix: Tensor) -> None:
    """`matrix` (…, 3, 3) is a rotation. Raises ValueError."""
    check_finite(name, matrix)
    if not values_visible(matrix):
        return
    R = matrix.detach().double()
    # 1e-3: far above what float32 rounding leaves of a product of rotations (1e-6), far below a scale in the matrix.
    error = (R @ R.mT - torch.eye(3, dtype=R.dtype, device=R.device)).abs().max().item()
    if error > 1e-3:
        raise ValueError(
            f"{name}: expected a rotation in the upper 3 × 3, got one with |R Rᵀ − 1| up to {error:.3g}; "
            "keep it orthogonal (for example optimise a rotation vector and use torch.linalg.matrix_exp)"
        )
    if bool((torch.linalg.det(R) < 0).any()):
        raise ValueError(f"{name}: expected a rotation, got a reflection (determinant −1); flip one axis")


def _vector(name: str, value: Vector, like: Tensor | None = None) -> Tensor:
    tensor = as_tensor(name, value, like=like)
    if not tensor.is_floating_point():
        tensor = tensor.to(torch.get_default_dtype())
    check_float(name, tensor)
    check_shape(name, tensor, (3,))
    check_finite(name, tensor)
    return tensor


def _direction(vector: Tensor) -> Tensor:
    """A vector (3,) that is not zero, at length one. Scaled first, so that squares neither overflow nor vanish."""
    vector = vector / vector.detach().abs().max()
    return vector / vector.norm()


def _rigid(R: Tensor, t: Tensor) -> Tensor:
    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=R.dtype, device=R.device)
    return torch.cat([torch.cat([R, t.to(R)[:, None]], 1), last])


def _look_at(eye: Vector, target: Vector, up: Vector) -> Tensor:
    given = [v for v in (eye, target, up) if isinstance(v, Tensor) and v.dtype in (torch.float32, torch.float64)]
    like = max(given, key=lambda v: v.element_size()) if given else None
    vectors = _vector("eye", eye, like), _vector("target", target, like), _vector("up", up, like)
    like = max(vectors, key=lambda v: v.element_size()) if like is None else like
    # In double: in float32, distances of 1e±30 have no square, and a distant eye would round the directions.
    e, g, u = (v.to(like).double() for v in vectors)
    if values_visible(e, g, u):
        if torch.equal(e, g):
            raise ValueError(f"target: expected a point apart from eye, got both at {e.tolist()}")
        # 1e-6 of the sine of the angle: below it float32 rounding alone decides where right is.
        if not bool(u.any()) or float(torch.linalg.cross(_direction(g - e), _direction(u)).detach().norm()) <= 1e-6:
            raise ValueError(
                f"up: expected a direction apart from the line of sight, got {u.tolist()}; try another axis"
            )
    forward = _direction(g - e)
    right = _direction(torch.linalg.cross(forward, _direction(u)))
    R = torch.stack([right, torch.linalg.cross(forward, right), forward])
    return _rigid(R, -(R * e).sum(-1)).to(like)


def _intrinsics(fx: Tensor, fy: Tensor, cx: float, cy: float) -> Tensor:
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    return torch.stack(
        [torch.stack([fx, zero, cx * one]), torch.stack([zero, fy, cy * one]), torch.stack([zero, zero, one])]
    )


def _focal(fov_y: float | Tensor, height: int, like: Tensor) -> Tensor:
    """Focal length in pixels, differentiable, from the full vertical field of view in degrees."""
    degrees = as_scalar("fov_y", fov_y, like=like)
    if values_visible(degrees) and not 0.0 < float(degrees.detach()) < 180.0:
        raise ValueError(f"fov_y: expected degrees between 0 and 180, got {float(degrees):g}")
    return 0.5 * height / torch.tan(torch.deg2rad(degrees) * 0.5)
