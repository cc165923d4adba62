"""Cameras from a place and a direction."""

from __future__ import annotations

import math

from torch import Tensor

from ..check import as_scalar, as_tensor, check_float, values_visible
from .fields import CameraFields, CameraT
from .poses import Vector, constant, image_size, intrinsics, intrinsics_of_view, looking_at


class Viewpoints(CameraFields):
    """Constructors of Camera from a place and a direction."""

    @classmethod
    def look_at(
        cls: type[CameraT],
        eye: Vector,
        target: Vector,
        up: Vector = (0.0, 1.0, 0.0),
        fov_y: float | Tensor | None = None,
        size: tuple[int, int] = (256, 256),
        fov_x: float | Tensor | None = None,
    ) -> CameraT:
        """Return a perspective camera at `eye` aimed at `target`, with `up` upwards in the image.

        Pixels are square, with the principal point in the middle.

        Parameters
        ----------
        eye, target : (3,)
            World units.
        up : (3,), default +Y
        fov_y, fov_x : float, degrees in (0, 180)
            Full vertical or horizontal field of view; fov_y is 40 when neither is given.
        size : (H, W) in pixels, default (256, 256)

        Raises
        ------
        TypeError, ValueError
            An argument has another type or shape, or is out of range.

        Examples
        --------
        >>> import edgegrad as eg
        >>> eg.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=40, size=(48, 64))
        Camera(perspective, 48 × 64 pixels, torch.float32)
        """
        if fov_x is not None and fov_y is not None:
            raise TypeError("look_at: expected one of fov_y and fov_x, got both; leave one out")
        world_to_camera = looking_at(eye, target, up)
        size = image_size(size)
        fov_y = 40.0 if fov_y is None and fov_x is None else fov_y
        return cls(world_to_camera, intrinsics_of_view(fov_y, fov_x, size, world_to_camera), size)

    @classmethod
    def orthographic(
        cls: type[CameraT],
        eye: Vector,
        target: Vector,
        up: Vector = (0.0, 1.0, 0.0),
        height: float | Tensor = 2.0,
        size: tuple[int, int] = (256, 256),
    ) -> CameraT:
        """Return an orthographic camera from `eye` towards `target`.

        Parameters
        ----------
        eye, target, up, size
            As of look_at().
        height : float, default 2
            World units that are seen from top to bottom.
        """
        world_to_camera = looking_at(eye, target, up)
        height = as_scalar("height", height, like=world_to_camera)
        if values_visible(height) and not 0.0 < float(height.detach()) < math.inf:
            raise ValueError(f"height: expected world units above 0, got {float(height):g}")
        H, W = image_size(size)
        scale = H / height
        return cls(world_to_camera, intrinsics(scale, scale, 0.5 * W, 0.5 * H), (H, W), "orthographic")

    @classmethod
    def panorama(
        cls: type[CameraT], world_to_camera: Vector, size: tuple[int, int], K: Vector | None = None
    ) -> CameraT:
        """Return a camera that sees all around (equirectangular): longitude to the right, latitude downwards, +Z in the middle.

        It continues beyond ±180°, and over the poles along the opposite meridian, so an object that crosses the image's border
        comes back at the other. Raises TypeError or ValueError.

        Parameters
        ----------
        world_to_camera : (4, 4)
            Rigid, +X right, +Y down, +Z forward.
        size : (H, W) in pixels
        K : (3, 3), default 360° from left to right, 180° from top to bottom
            Pixels a radian and the pixel where +Z is seen, for a part of it or for several turns.
        """
        pose = as_tensor("world_to_camera", world_to_camera, floating=True)
        check_float("world_to_camera", pose)
        H, W = image_size(size)
        if K is None:
            K = constant([[W / math.tau, 0.0, 0.5 * W], [0.0, H / math.pi, 0.5 * H], [0.0, 0.0, 1.0]], pose)
        return cls(pose, as_tensor("K", K, like=pose), (H, W), "panorama")
