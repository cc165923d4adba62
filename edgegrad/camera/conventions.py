"""Cameras as other libraries describe them.

They differ in the directions of a camera's axes, the place of pixel centres, the side of a matrix on which a vector stands, and
the unit of focal lengths. Here: +X right, +Y down, +Z forward; centres at +0.5; `q = R p + t`; pixels.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..check import as_real, as_tensor, check_finite, check_float, check_shape, values_visible
from .fields import CameraFields, CameraT
from .poses import (  # fmt: skip
    Vector,
    check_last_row,
    check_rotation,
    constant,
    image_size,
    intrinsics,
    intrinsics_of_view,
    rigid,
    rotation,
)

# COLMAP's models (src/colmap/sensor/models.h) by projection and numbers of focal lengths and of further coefficients.
COLMAP_MODELS = {
    "SIMPLE_PINHOLE": ("perspective", 1, 0),
    "PINHOLE": ("perspective", 2, 0),
    "SIMPLE_RADIAL": ("perspective", 1, 1),
    "RADIAL": ("perspective", 1, 2),
    "OPENCV": ("perspective", 2, 4),
    "FULL_OPENCV": ("perspective", 2, 8),
    "SIMPLE_FISHEYE": ("fisheye", 1, 0),
    "FISHEYE": ("fisheye", 2, 0),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", 1, 1),
    "RADIAL_FISHEYE": ("fisheye", 1, 2),
    "OPENCV_FISHEYE": ("fisheye", 2, 4),
}
MIRRORED = (
    "expected y up and w above zero in front, got a mirrored image; negate the second row of a matrix whose y runs down (Vulkan, "
    "or images from the bottom up), and the whole of one whose w is negative in front"
)


class Conventions(CameraFields):
    """Constructors of Camera from other libraries' conventions."""

    @classmethod
    def from_opencv(
        cls: type[CameraT], R: Vector, t: Vector, K: Vector, size: tuple[int, int], distortion: Vector | None = None
    ) -> CameraT:
        """Return a camera from OpenCV's extrinsics and intrinsics, as cv2.calibrateCamera returns them.

        OpenCV puts the centre of the first pixel at 0, edgegrad at 0.5: K's principal point is shifted by half a pixel.

        Parameters
        ----------
        R : (3, 3), or a rotation vector (3,) in radians
        t : (3,)
            With `q = R p + t`.
        K : (3, 3) in pixels
        size : (H, W) in pixels
        distortion : k1, k2, p1, p2[, k3[, k4, k5, k6]], default none

        Examples
        --------
        >>> import torch, edgegrad as eg
        >>> K = [[80.0, 0.0, 31.5], [0.0, 80.0, 23.5], [0.0, 0.0, 1.0]]
        >>> camera = eg.Camera.from_opencv(torch.eye(3), (0, 0, 4), K, size=(48, 64))
        >>> camera.project(torch.zeros(3))
        tensor([32., 24.])
        """
        return _from_opencv(cls, R, t, K, size, "perspective", distortion)

    @classmethod
    def fisheye(
        cls: type[CameraT], R: Vector, t: Vector, K: Vector, size: tuple[int, int], distortion: Vector | None = None
    ) -> CameraT:
        """Return a fisheye from what cv2.fisheye.calibrate returns.

        It may show more than a half space, up to 180° from the axis.

        Parameters
        ----------
        R, t, K, size
            As of from_opencv().
        distortion : k1, k2, k3, k4, default none
        """
        return _from_opencv(cls, R, t, K, size, "fisheye", distortion)

    @classmethod
    def from_opengl(
        cls: type[CameraT],
        camera_to_world: Vector,
        size: tuple[int, int],
        fov_y: float | Tensor | None = None,
        K: Vector | None = None,
        fov_x: float | Tensor | None = None,
    ) -> CameraT:
        """Return a camera from a pose of OpenGL or Blender. Raises TypeError or ValueError.

        Parameters
        ----------
        camera_to_world : (4, 4) or (B, 4, 4)
            +X right, +Y up, looking along −Z.
        size : (H, W) in pixels
        fov_y, fov_x : float
            Full field of view of square pixels, centred, in degrees. Give one of these or K.
        K : (3, 3) or (B, 3, 3) in pixels, pixel centres at +0.5
        """
        pose = as_real("camera_to_world", camera_to_world, (4, 4), ("B", 4, 4))
        given = [name for name, value in (("fov_y", fov_y), ("fov_x", fov_x), ("K", K)) if value is not None]
        if len(given) != 1:
            raise TypeError(
                f"from_opengl: expected one of fov_y, fov_x and K, got {' and '.join(given) or 'none'}; give one of them"
            )
        check_last_row("camera_to_world", pose, [0.0, 0.0, 0.0, 1.0])
        check_rotation("camera_to_world", pose[..., :3, :3])
        flip = torch.tensor([1.0, -1.0, -1.0], dtype=pose.dtype, device=pose.device)
        R = (pose[..., :3, :3] * flip).mT
        t = -(R * pose[..., None, :3, 3]).sum(-1)
        if K is None:
            K = intrinsics_of_view(fov_y, fov_x, image_size(size), pose)
        return cls(rigid(R, t), as_tensor("K", K, like=pose), size)

    @classmethod
    def from_pytorch3d(
        cls: type[CameraT],
        R: Vector,
        T: Vector,
        size: tuple[int, int],
        focal_length: Vector | float = 1.0,
        principal_point: Vector = (0.0, 0.0),
        in_ndc: bool = True,
    ) -> CameraT:
        """Return a camera from PyTorch3D's PerspectiveCameras: points are rows, `p R + T`, +X left, +Y up, +Z forward.

        Other types and values raise TypeError or ValueError.

        Parameters
        ----------
        R, T : (3, 3) or (N, 3, 3), and (3,) or (N, 3)
            As its cameras hold them.
        size : (H, W) in pixels
        focal_length : float, (2,), (N,) or (N, 2), default 1
            Of x and y. In normalised coordinates, where the shorter side of the image is from −1 to 1; with in_ndc=False in
            pixels. Of FoVPerspectiveCameras it is 1 / tan(fov / 2).
        principal_point : (2,) or (N, 2), default zeros
            Likewise; in normalised coordinates x runs to the left and y up.
        in_ndc : bool, default True
            Whether focal length and principal point are in normalised coordinates.
        """
        rotation = as_real("R", R, (3, 3), ("N", 3, 3))
        check_rotation("R", rotation)
        shift = as_tensor("T", T, like=rotation)
        check_shape("T", shift, rotation.shape[:-1])
        focal = as_tensor("focal_length", focal_length, like=rotation).to(rotation)
        middle = as_tensor("principal_point", principal_point, like=rotation).to(rotation)
        batched = rotation.dim() == 3
        focal = (
            focal[..., None] if focal.dim() == 0 or (focal.dim() == 1 and batched and focal.shape != (2,)) else focal
        )
        check_shape("focal_length", focal, (1,), (2,), *([(len(rotation), 1), (len(rotation), 2)] if batched else []))
        check_shape("principal_point", middle, (2,), *([(len(rotation), 2)] if batched else []))
        H, W = image_size(size)
        if in_ndc:
            half = 0.5 * min(H, W)
            focal, middle = half * focal, constant([0.5 * W, 0.5 * H], focal) - half * middle
        focal, middle = torch.broadcast_tensors(focal, middle)
        flip = constant([-1.0, -1.0, 1.0], rotation)  # to +X right, +Y down
        pose = rigid(flip[:, None] * rotation.mT, flip * shift.to(rotation))
        return cls(pose, intrinsics(*focal.unbind(-1), *middle.unbind(-1)), (H, W))

    @classmethod
    def from_colmap(
        cls: type[CameraT], rotation: Vector, translation: Vector, model: str, params: Vector, size: tuple[int, int]
    ) -> CameraT:
        """Return a camera from an image's pose and its camera in COLMAP; load_cameras() reads whole reconstructions.

        Other types and values raise TypeError or ValueError.

        Parameters
        ----------
        rotation : (4,) quaternion w, x, y, z, as in images.txt, or (3, 3)
            World to camera, +X right, +Y down, +Z forward.
        translation : (3,) in world units
        model : str
            SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV, SIMPLE_FISHEYE, FISHEYE,
            SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE or OPENCV_FISHEYE.
        params : (n,)
            Its parameters, in COLMAP's order; pixel centres at +0.5, as here.
        size : (H, W) in pixels
        """
        pose = as_real("rotation", rotation, (4,), (3, 3))
        if pose.dim() == 1:
            if values_visible(pose) and not bool(pose.detach().any()):
                raise ValueError(
                    "rotation: expected a quaternion w, x, y, z, got zeros; take (1, 0, 0, 0) for no rotation"
                )
            pose = _rotation_of(pose)
        check_rotation("rotation", pose)
        shift = as_tensor("translation", translation, like=pose)
        check_shape("translation", shift, (3,))
        if model not in COLMAP_MODELS:
            raise ValueError(
                f"model: expected one of {', '.join(COLMAP_MODELS)}, got {model!r}; undistort the images with "
                "`colmap image_undistorter`, or estimate one of these models"
            )
        projection, focals, count = COLMAP_MODELS[model]
        values = as_tensor("params", params, like=pose).to(pose)
        check_shape("params", values, (focals + 2 + count,), fix=f"these are what {model} has")
        fx, fy, cx, cy = values[0], values[focals - 1], values[focals], values[focals + 1]
        distortion = values[focals + 2 :]
        if 0 < count < 4:  # radial alone
            distortion = torch.nn.functional.pad(distortion, (0, 4 - count))
        K = intrinsics(fx, fy, cx, cy)
        return cls(rigid(pose, shift), K, size, projection, distortion if count else None)

    @classmethod
    def from_projection(
        cls: type[CameraT], projection: Vector, size: tuple[int, int], view: Vector | None = None
    ) -> CameraT:
        """Return a camera from OpenGL's matrices, perspective or orthographic; differentiable.

        `clip = projection · view · p`, with x/w to the right and y/w up, from −1 to 1 over the image. How depth is mapped does
        not matter. Other types and values raise TypeError or ValueError.

        Parameters
        ----------
        projection : (4, 4)
            To clip space, as glFrustum, glm or nvdiffrast's examples make it; or already times the view.
        size : (H, W)
            Of the image, whose first row here is the upper one: that of nvdiffrast is `image.flip(0)`.
        view : (4, 4), default the identity
            World to view, +X right, +Y up, looking along −Z.
        """
        matrix = as_real("projection", projection, (4, 4))
        eye, ahead = matrix.new_zeros(3), matrix[2, :3]
        if view is not None:
            to_view = as_tensor("view", view, like=matrix).to(matrix)
            check_shape("view", to_view, (4, 4))
            check_last_row("view", to_view, [0.0, 0.0, 0.0, 1.0])
            check_rotation("view", to_view[:3, :3])
            eye, ahead = -(to_view[:3, :3] * to_view[:3, 3:]).sum(0), -to_view[2, :3]
            matrix = matrix @ to_view
        H, W = image_size(size)
        x, y, _, w = matrix.unbind()
        # Homogeneous pixel positions.
        rows = torch.stack([0.5 * W * (x + w), 0.5 * H * (w - y), w])
        if not values_visible(w) or bool(w[:3].detach().any()):
            K, R, b = _triangular(rows / w[:3].norm())
            return cls(rigid(R, torch.linalg.solve(K, b)), K, (H, W))
        if float(w[3].detach()) == 0.0:
            raise ValueError("projection: expected a last row that is not zero, got zeros; give all four rows")
        # Orthographic: (x, y) = A p + b, and the third direction is square to both rows of A.
        rows = rows / w[3]
        forward = torch.nn.functional.normalize(torch.linalg.cross(rows[0, :3], rows[1, :3]), dim=0)
        if float((forward * ahead).sum().detach()) < 0.0:
            raise ValueError(f"projection: {MIRRORED}")
        K, R, b = _triangular(torch.cat([rows[:2], torch.cat([forward, forward.new_zeros(1)])[None]]))
        t = -(R * eye).sum(-1)
        center = b[:2] - (K[:2, :2] * t[:2]).sum(-1)
        K = torch.cat([torch.cat([K[:2, :2], center[:, None]], 1), K[2:]])
        return cls(rigid(R, t), K, (H, W), "orthographic")


def _from_opencv(
    cls: type[CameraT],
    R: Vector,
    t: Vector,
    K: Vector,
    size: tuple[int, int],
    projection: str,
    distortion: Vector | None,
) -> CameraT:
    R = as_tensor("R", R, floating=True)
    check_float("R", R)
    t = as_tensor("t", t, like=R)
    K = as_tensor("K", K, like=R)
    if R.numel() == 3:
        check_finite("R", R)
        R = rotation(R.reshape(3))
    check_shape("R", R, (3, 3), fix="or a rotation vector (3,)")
    check_shape("K", K, (3, 3))
    check_float("t", t)
    if t.numel() != 3:
        raise ValueError(f"t: expected 3 numbers, got shape {tuple(t.shape)}")
    check_finite("t", t)
    check_rotation("R", R)
    if distortion is not None:
        distortion = as_tensor("distortion", distortion, like=R)
        if distortion.dim() == 2 and 1 in distortion.shape:  # as OpenCV returns it
            distortion = distortion.reshape(-1)
    half = torch.zeros_like(K)
    half[:2, 2] = 0.5
    return cls(rigid(R, t.reshape(3)), K + half, size, projection, distortion)


def _triangular(rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return K (3, 3), R (3, 3) and b (3,) with rows (3, 4) = [K R | b], the last of K (0, 0, 1). Gram and Schmidt's
    orthogonalisation goes from the last row up. Raises ValueError."""
    A, b = rows[:, :3], rows[:, 3]
    forward = A[2]
    center = (A[:2] * forward).sum(-1)
    x, y = A[:2] - center[:, None] * forward
    fy = y.norm()
    down = y / fy
    skew = (x * down).sum()
    x = x - skew * down
    fx = x.norm()
    R = torch.stack([x / fx, down, forward])
    if values_visible(R) and not bool(torch.isfinite(R.detach()).all()):
        raise ValueError("projection: expected an invertible one, got a singular matrix; give all four rows")
    if values_visible(R) and float(torch.linalg.det(R.detach())) < 0.0:
        raise ValueError(f"projection: {MIRRORED}")
    return intrinsics(fx, fy, center[0], center[1]) + torch.nn.functional.pad(skew[None, None], (1, 1, 0, 2)), R, b


def _rotation_of(quaternion: Tensor) -> Tensor:
    """Return the matrix (3, 3) of a quaternion (4,) w, x, y, z of any length but zero."""
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=0).unbind()
    rows = (
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    )
    return torch.stack([torch.stack(row) for row in rows])
