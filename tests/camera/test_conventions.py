"""Cameras of other libraries: where the same points land, by those libraries or by the formulas of their documentation."""

from __future__ import annotations

import math
import warnings

import cv2
import numpy as np
import pytest
import torch
from finite_differences import rotation
from torch import Tensor

import edgegrad as eg
from edgegrad.camera.conventions import COLMAP_MODELS

F64 = torch.float64
SIZE = (48, 64)
R = rotation((0.36, 0.48, 0.8), torch.tensor(0.7, dtype=F64))
SHIFT = torch.tensor([0.3, -0.2, 4.0], dtype=F64)
POINTS = torch.randn(40, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=F64))  # between OpenGL's and OpenCV's axes of a camera


def pose(R: Tensor = R, t: Tensor = SHIFT) -> Tensor:
    return torch.cat([torch.cat([R, t[:, None]], 1), torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=F64)])


def agree(a: Tensor, b: Tensor, error: float = 1e-9) -> None:
    assert a.shape == b.shape and float((a - b).abs().max()) < error


# -- a camera, and many ---------------------------------------------------------------------------------------------------


def test_eye_and_fields_of_view() -> None:
    camera = eg.Camera.look_at((1.0, 2.0, 3.0), (0, 0, 0), fov_x=50.0, size=SIZE).to(F64)
    agree(camera.eye, torch.tensor([1.0, 2.0, 3.0], dtype=F64), 1e-5)
    assert float(camera.fov_x) == pytest.approx(50.0, abs=1e-4)
    assert math.tan(math.radians(float(camera.fov_y)) / 2) == pytest.approx(
        0.75 * math.tan(math.radians(25.0)), abs=1e-6
    )
    aside = camera.crop(0, 32, 48, 32)  # the right half
    assert float(aside.fov_x) == pytest.approx(25.0, abs=1e-4)
    around = eg.Camera.panorama(torch.eye(4), (32, 64))
    assert float(around.fov_x) == pytest.approx(360.0) and float(around.fov_y) == pytest.approx(180.0)
    with pytest.raises(ValueError, match="orthographic"):
        _ = eg.Camera.orthographic((0, 0, 1), (0, 0, 0)).fov_x
    with pytest.raises(TypeError, match="one of fov_y and fov_x, got both"):
        eg.Camera.look_at((1.0, 2.0, 3.0), (0, 0, 0), fov_y=40.0, fov_x=50.0)


def test_a_batch_is_a_sequence() -> None:
    distortion = torch.tensor([0.1, 0.0, 0.0, 0.0], dtype=F64)
    singles = [
        eg.Camera.from_opencv(R, SHIFT * k, torch.diag(SHIFT.new_tensor([k, k, 1.0])), SIZE, k * distortion)
        for k in (1, 2, 3)
    ]
    batch = eg.Camera.stack(singles)
    assert len(batch) == 3 and [c.batch for c in batch] == [None] * 3
    for a, b in zip(batch, singles, strict=True):
        agree(a.project(POINTS), b.project(POINTS))
    agree(batch.project(POINTS), torch.stack([c.project(POINTS) for c in singles]))
    agree(batch.eye, torch.stack([c.eye for c in singles]))
    agree(batch[-1].K, singles[2].K)
    assert len(batch[1:]) == 2
    shared = eg.Camera(batch.world_to_camera, singles[0].K, SIZE)  # one K for all
    agree(shared[1].K, singles[0].K)
    for index in (3, -4):
        with pytest.raises(IndexError):
            batch[index]
    with pytest.raises(IndexError, match="got none"):
        batch[3:]
    assert bool(singles[0])
    with pytest.raises(TypeError, match="single"):
        len(singles[0])


# -- OpenGL -------------------------------------------------------------------------------------------------------------


def frustum(near: float, far: float, left: float, right: float, bottom: float, top: float) -> Tensor:
    """Return the matrix that glFrustum documents."""
    w, h, d = right - left, top - bottom, far - near
    return torch.tensor(
        [
            [2 * near / w, 0, (right + left) / w, 0], [0, 2 * near / h, (top + bottom) / h, 0],
            [0, 0, -(far + near) / d, -2 * far * near / d], [0, 0, -1, 0],
        ],
        dtype=F64,
    )  # fmt: skip


def ortho(near: float, far: float, left: float, right: float, bottom: float, top: float) -> Tensor:
    """Return the matrix that glOrtho documents."""
    w, h, d = right - left, top - bottom, far - near
    return torch.tensor(
        [
            [2 / w, 0, 0, -(right + left) / w], [0, 2 / h, 0, -(top + bottom) / h],
            [0, 0, -2 / d, -(far + near) / d], [0, 0, 0, 1],
        ],
        dtype=F64,
    )  # fmt: skip


@pytest.mark.parametrize("make", [frustum, ortho])
def test_from_projection(make) -> None:
    projection, view = make(1.0, 9.0, -0.6, 0.5, -0.3, 0.4), FLIP @ pose()
    clip = torch.cat([POINTS, torch.ones(40, 1, dtype=F64)], 1) @ (projection @ view).mT
    x, y = (clip[:, :2] / clip[:, 3:]).unbind(-1)
    pixels = torch.stack([(x + 1) / 2 * SIZE[1], (1 - y) / 2 * SIZE[0]], -1)
    camera = eg.Camera.from_projection(projection, SIZE, view)
    agree(camera.project(POINTS), pixels)
    agree(eg.Camera.from_projection(projection @ view, SIZE).project(POINTS), pixels)
    agree(camera.world_to_camera, pose())
    assert camera.projection == ("perspective" if make is frustum else "orthographic")
    down = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0], dtype=F64))
    with pytest.raises(ValueError, match="mirrored image"):
        eg.Camera.from_projection(down @ projection, SIZE, view)

    def project(rows: Tensor) -> Tensor:  # the last row says which kind it is
        return eg.Camera.from_projection(torch.cat([rows, projection[2:]]), SIZE, view).project(POINTS[:3])

    assert torch.autograd.gradcheck(project, projection[:2].clone().requires_grad_())


def test_from_opengl_of_many() -> None:
    poses = torch.stack([torch.linalg.inv(FLIP @ pose(t=k * SHIFT)) for k in (1, 2)])
    batch = eg.Camera.from_opengl(poses, SIZE, fov_x=60.0)
    for k, camera in enumerate(batch):
        agree(camera.world_to_camera, pose(t=(k + 1) * SHIFT))
        agree(camera.K, eg.Camera.from_opengl(poses[k], SIZE, fov_x=60.0).K)
    K = batch.K.expand(2, 3, 3) * torch.tensor([1.0, 1.0, 1.0], dtype=F64)
    agree(eg.Camera.from_opengl(poses, SIZE, K=K).project(POINTS), batch.project(POINTS))


# -- PyTorch3D ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("in_ndc", [True, False])
def test_from_pytorch3d(in_ndc: bool) -> None:
    """Its documentation: points are rows; +X left, +Y up; the shorter side of the image is from −1 to 1."""
    rotations, shifts = torch.stack([R.mT, R]), torch.stack([SHIFT, 2 * SHIFT])
    focal, middle = (
        torch.tensor([[1.5, 1.4], [2.0, 1.0]], dtype=F64),
        torch.tensor([[0.1, -0.2], [0.0, 0.3]], dtype=F64),
    )
    H, W = SIZE
    if not in_ndc:
        focal, middle = 24.0 * focal, torch.tensor([W / 2, H / 2], dtype=F64) - 24.0 * middle
    camera = eg.Camera.from_pytorch3d(rotations, shifts, SIZE, focal, middle, in_ndc)
    for k in range(2):
        q = POINTS @ rotations[k] + shifts[k]
        to_ndc = focal[k] if in_ndc else focal[k] / 24.0
        center = middle[k] if in_ndc else (torch.tensor([W / 2, H / 2], dtype=F64) - middle[k]) / 24.0
        ndc = to_ndc * q[:, :2] / q[:, 2:] + center
        agree(camera[k].project(POINTS), torch.stack([W / 2 - 24.0 * ndc[:, 0], H / 2 - 24.0 * ndc[:, 1]], -1))
    single = eg.Camera.from_pytorch3d(R.mT, SHIFT, SIZE, 1.5)
    agree(single.K[:2, :2], torch.eye(2, dtype=F64) * 36.0)
    with pytest.raises(ValueError, match=r"T: expected shape \(3,\)"):
        eg.Camera.from_pytorch3d(R.mT, SHIFT[None], SIZE)


# -- COLMAP ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", COLMAP_MODELS)
def test_from_colmap(model: str) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="COLMAP itself is what is compared with")
    _, focals, count = COLMAP_MODELS[model]
    params = [*[60.0, 55.0][:focals], 30.0, 25.0, *[0.05, -0.02, 0.01, -0.015, 0.02, 0.03, 0.01, 0.02][:count]]
    theirs = pycolmap.Camera(model=model, width=SIZE[1], height=SIZE[0], params=params)
    pose3 = pycolmap.Rigid3d(pycolmap.Rotation3d(R.numpy()), SHIFT.numpy())
    expected = theirs.img_from_cam(POINTS.numpy() @ pose3.rotation.matrix().T + pose3.translation)
    w = pose3.rotation.quat[[3, 0, 1, 2]]  # pycolmap's last is w; in images.txt it is the first
    for turn in (w, R):
        camera = eg.Camera.from_colmap(turn, SHIFT, model, params, SIZE)
        agree(camera.project(POINTS), torch.from_numpy(expected), 1e-8)


def test_bad_colmap_parameters() -> None:
    with pytest.raises(ValueError, match=r"model: expected one of SIMPLE_PINHOLE, .* got 'FOV'; undistort"):
        eg.Camera.from_colmap(R, SHIFT, "FOV", [1.0] * 5, SIZE)
    with pytest.raises(ValueError, match=r"params: expected shape \(4,\), got \(3,\); these are what PINHOLE has"):
        eg.Camera.from_colmap(R, SHIFT, "PINHOLE", [1.0] * 3, SIZE)


def test_opencv_pixel_centres() -> None:
    K = np.array([[60.0, 0, 30], [0, 55, 25], [0, 0, 1]])
    theirs, _ = cv2.projectPoints(POINTS.numpy(), cv2.Rodrigues(R.numpy())[0], SHIFT.numpy(), K, None)
    agree(eg.Camera.from_opencv(R, SHIFT, K, SIZE).project(POINTS) - 0.5, torch.from_numpy(theirs[:, 0]))


def test_opencv_rotation_vectors() -> None:
    """Rotations of any shape are those of cv2.Rodrigues, and so is the derivative of the matrix."""
    K = np.array([[60.0, 0, 30], [0, 55, 25], [0, 0, 1]])
    rvec = np.array([0.3, -0.2, 2.9])
    wanted, by_vector = cv2.Rodrigues(rvec)  # (3, 9): of the rows' numbers
    for vector in (rvec, rvec[:, None], rvec.tolist()):
        found = eg.Camera.from_opencv(vector, SHIFT, K, SIZE).world_to_camera
        assert np.abs(found[:3, :3].double().numpy() - wanted).max() < (1e-6 if found.dtype == torch.float32 else 1e-12)
    leaf = torch.from_numpy(rvec).requires_grad_()
    weights = torch.arange(9.0, dtype=F64).reshape(3, 3)
    turned = eg.Camera.fisheye(leaf, SHIFT, K, SIZE).world_to_camera[:3, :3]
    (gradient,) = torch.autograd.grad((turned * weights).sum(), leaf)
    assert torch.allclose(gradient, torch.from_numpy(by_vector) @ weights.reshape(9), atol=1e-9)


# -- mistakes -------------------------------------------------------------------------------------------------------------


def test_mistakes_of_conventions_are_named() -> None:
    projection = frustum(1.0, 9.0, -0.6, 0.5, -0.3, 0.4)
    for wrong in (projection, projection[:3, :3]):
        with pytest.raises(ValueError, match=r"K: expected .* Camera\.from_projection"):
            eg.Camera(torch.eye(4, dtype=F64), wrong, SIZE)
    with pytest.raises(ValueError, match=r"reflection .* Camera\.from_opengl"):
        eg.Camera(torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0])), torch.eye(3), SIZE)
    with pytest.warns(UserWarning, match=r"fov_y: expected degrees, got 0\.6981; .* math\.degrees"):
        eg.Camera.look_at((0, 0, 3), (0, 0, 0), fov_y=math.radians(40.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        eg.Camera.look_at((0, 0, 3), (0, 0, 0), fov_y=3.0)
        eg.Camera.look_at((0, 0, 3), (0, 0, 0), fov_y=0.1)


def test_what_lies_behind_the_camera_is_told() -> None:
    mesh = eg.Mesh(POINTS[:3], torch.tensor([[0, 1, 2]]))
    camera = eg.Camera.look_at((0, 0, 9), (0, 0, 0), size=(8, 8))
    with pytest.warns(UserWarning, match=r"all vertices lie behind the camera .* Camera\.from_opengl"):
        eg.render(mesh, camera.replace(world_to_camera=FLIP.float() @ camera.world_to_camera), spp=1, seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        eg.render(
            mesh,
            eg.Camera.stack([camera, camera.replace(world_to_camera=FLIP.float() @ camera.world_to_camera)]),
            1,
            seed=0,
        )


def test_bytes_for_radiance_are_told(tmp_path) -> None:
    image = torch.arange(192.0).reshape(8, 8, 3)
    with pytest.warns(
        UserWarning, match=r"img: expected linear radiance, .* up to 191; .* srgb_to_linear\(image / 255\)"
    ):
        eg.write_image(tmp_path / "a.png", image)
    corners = torch.tensor([[0, 1, 2]])
    with pytest.raises(TypeError, match=r"texture: expected float32 .*uint8; .*srgb_to_linear"):
        eg.Mesh(POINTS[:3], corners, texture=image.byte(), uvs=POINTS[:3, :2], uv_faces=corners)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        eg.write_image(tmp_path / "a.exr", image / 2)
        eg.write_image(tmp_path / "b.png", (image > 9).float())
    upside_down = np.zeros((8, 8, 3), np.float32)[::-1]
    eg.write_image(tmp_path / "c.png", upside_down)


def test_a_quaternion_of_zeros_is_no_rotation() -> None:
    with pytest.raises(ValueError, match="rotation: expected a quaternion w, x, y, z, got zeros"):
        eg.Camera.from_colmap([0.0] * 4, [0.0, 0.0, 3.0], "PINHOLE", [100.0, 100.0, 32.0, 32.0], (64, 64))


def test_cameras_of_a_class_of_ones_own_stay_of_it() -> None:
    class Rig(eg.Camera):
        pass

    one = Rig.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, (8, 8))
    batch = Rig.stack([one, one])
    assert type(one) is type(one.resized((4, 4))) is type(batch) is type(batch[0]) is Rig
