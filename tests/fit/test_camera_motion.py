"""Batches of cameras that move with steps of poses, against each pose by itself and against differences of moved poses."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import scipy.spatial
import torch
from brackets import BACKGROUND, CENTER, bracket, camera, rotation
from torch import Tensor

import edgegrad as eg
from edgegrad.fit.placement import Pose
from edgegrad.fit.pose.camera_motion import moved_poses, moving_cameras
from edgegrad.fit.pose.inputs import ArgumentNames
from edgegrad.fit.pose.likelihood.picture import Box, RenderedPoses
from edgegrad.fit.pose.task import DISTORTION, FOCAL_LENGTH, STEP_SIZE, PoseTask, Unknowns, focal_of

F64 = torch.float64
SIZE = 48
ALL = Unknowns(True, True, True, 4)
LENSES = {
    "pinhole": ("perspective", None), "brown-conrady": ("perspective", [0.1, -0.05, 2e-3, -1e-3]),
    "orthographic": ("orthographic", None), "fisheye": ("fisheye", [0.05, -0.02, 0.01, -0.004]),
    "panorama": ("panorama", None),
}  # fmt: skip
CASES = [
    ("pinhole", Unknowns()), ("pinhole", Unknowns(focal=True)), ("pinhole", ALL), ("brown-conrady", ALL),
    ("brown-conrady", Unknowns(focal=True, principal=True)), ("orthographic", Unknowns(scale=True, principal=True)),
    ("orthographic", Unknowns(focal=True)), ("fisheye", ALL), ("fisheye", Unknowns(scale=True)), ("panorama", Unknowns()),
]  # fmt: skip


def viewed(lens: str, view: eg.Camera) -> eg.Camera:
    """Return a camera of a kind at the same place, not square, with a principal point off the centre."""
    projection, coefficients = LENSES[lens]
    K = view.K.double() * torch.tensor([[1.05], [0.95], [1.0]]) + torch.tensor([[0, 0, 1.5], [0, 0, -1.0], [0, 0, 0]])
    if projection == "orthographic":
        K[:2, :2] *= 0.15
    distortion = None if coefficients is None else torch.tensor(coefficients, dtype=F64)
    return eg.Camera(view.world_to_camera.double(), K, (SIZE, SIZE + 8), projection, distortion)


def task_seen(lens: str, unknowns: Unknowns, mesh: eg.Mesh | None = None) -> PoseTask:
    """Return the task of two views."""
    aside = eg.Camera.look_at(CENTER + torch.tensor([-2.5, 1.0, 3.5]), CENTER, fov_y=45.0, size=(SIZE, SIZE))
    views = [viewed(lens, camera(SIZE, 6.5)), viewed(lens, aside)]
    picture = torch.rand(*views[0].size, 3, generator=torch.Generator().manual_seed(0))
    scene = eg.Scene([mesh or bracket()], BACKGROUND)
    return PoseTask.from_arguments(scene, [picture] * 2, views, None, None, unknowns, 1.3, ArgumentNames())


def poses_of(task: PoseTask) -> list[Pose]:
    """Return poses of other scales than 1, and of other lenses where these are sought."""
    found = []
    for turn, scale, focal in (((0.1, -0.2, 0.15), 1.3, 1.1), ((-0.3, 0.05, -0.4), 0.8, 0.93)):
        R = rotation(*turn)
        t = CENTER + torch.tensor([0.1, -0.15, 0.2]).double() * scale - scale * R @ CENTER
        pose = Pose(R, t, torch.tensor(scale, dtype=F64))
        if FOCAL_LENGTH in task.dofs:
            pose = pose._replace(focal=torch.tensor(focal, dtype=F64))
        if DISTORTION in task.dofs:
            change = 0.02 * torch.tensor([1.0, -0.5, 0.1, -0.1, 0, 0, 0, 0], dtype=F64)
            pose = pose._replace(principal=torch.tensor([0.02, -0.01], dtype=F64), distortion=change)
        found.append(pose)
    return found


def projected(task: PoseTask, view: eg.Camera, pose: Pose, points: Tensor) -> Tensor:
    """Return where the given camera sees points (n, 3) of the mesh at a pose."""
    return task.lens(view, pose).project(pose.scale * points @ pose.R.T + pose.t)


def differences(task: PoseTask, poses: list[Pose], value: Callable[[Pose], Tensor]) -> Tensor:
    """Return central differences (D, N, …) of a value by the entries of a step."""
    found, h = [], 1e-5
    for e in torch.eye(len(task.dofs), dtype=F64).split(1):
        ends = [moved_poses(task, poses, task.dofs, s * h * e.expand(len(poses), -1)) for s in (1.0, -1.0)]
        found.append(torch.stack([(value(a) - value(b)) / (2 * h) for a, b in zip(*ends, strict=True)]))
    return torch.stack(found)


def moved(task: PoseTask, pose: Pose, dofs: list[int], p: torch.Tensor) -> Pose:
    """Return the pose after a step, from where the object's centre goes in the first camera's axes."""
    step = p.new_zeros(STEP_SIZE).index_put((torch.tensor(dofs),), p)
    camera = task.shots[0].camera
    V, v = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    R = eg.camera.poses.rotation(V.T @ step[:3]) @ pose.R
    center = V @ task.center_at(pose) + v + task.size * step[3:6]
    scale, zoom = pose.scale * step[6].exp(), step[7].exp()
    if camera.projection != "orthographic":
        if 8 in dofs:  # The shift of the principal point is made up for.
            aside = step[8:10] * camera.size[1] / focal_of(camera) / pose.focal
            center = torch.cat([center[:2] - aside * center[2:], center[2:]])
        if 7 in dofs and 6 in dofs:  # So is the enlargement by a longer lens, by scale or distance.
            scale = scale / zoom
        elif 7 in dofs:
            center = torch.cat([center[:2], center[2:] * zoom])
    t = V.T @ (center - v) - scale * (R @ task.center)
    return Pose(R, t, scale, pose.focal * zoom, pose.principal + step[8:10], pose.distortion + step[10:])


@pytest.mark.quick
@pytest.mark.parametrize(("lens", "unknowns"), CASES)
def test_poses_move_in_a_batch_as_one_by_one(lens: str, unknowns: Unknowns) -> None:
    task = task_seen(lens, unknowns)
    poses = poses_of(task)
    without_lens = [entry for entry in task.dofs if entry < FOCAL_LENGTH]
    for dofs in (task.dofs, without_lens):
        steps = 0.1 * torch.randn(2, len(dofs), generator=torch.Generator().manual_seed(4), dtype=F64)
        for pose, step, found in zip(poses, steps, moved_poses(task, poses, dofs, steps), strict=True):
            for part, expected in zip(found, moved(task, pose, dofs, step), strict=True):
                torch.testing.assert_close(part, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.quick
@pytest.mark.parametrize("view", [0, 1])
@pytest.mark.parametrize(("lens", "unknowns"), CASES)
def test_cameras_see_the_mesh_at_rest_as_the_given_one_sees_it_at_the_poses(
    lens: str, unknowns: Unknowns, view: int
) -> None:
    """The flow, and the tangents that it is made of, are central differences of poses that moved."""
    task = task_seen(lens, unknowns)
    poses, given = poses_of(task), task.shots[view].camera
    verts = task.scene.meshes[0].verts
    moving = moving_cameras(task, given, poses, task.dofs)
    for k, pose in enumerate(poses):
        torch.testing.assert_close(
            moving.cameras[k].project(verts), projected(task, given, pose, verts), rtol=0, atol=1e-9
        )
    flow = moving.flow(verts.T.reshape(1, 3, -1, 1).expand(len(poses), -1, -1, -1))
    expected = differences(task, poses, lambda pose: projected(task, given, pose, verts).T)
    off, size = ((x.double().norm(dim=(2, 3))) for x in (flow[..., 0] - expected, expected))
    assert bool((off < 1e-5 * size + 1e-5).all()), (off, size)


@pytest.mark.parametrize(
    ("lens", "unknowns"), [("pinhole", ALL._replace(distortion=0)), ("orthographic", Unknowns(scale=True))]
)
def test_a_silhouettes_area_changes_with_each_entry_of_a_step(lens: str, unknowns: Unknowns) -> None:
    """The exact area of a convex mesh is that of the convex hull of its projected vertices."""
    corners = torch.cartesian_prod(*torch.tensor([[-0.7, 0.7], [-0.5, 0.5], [-0.6, 0.4]]).double()) + CENTER
    faces = torch.from_numpy(scipy.spatial.ConvexHull(corners.numpy()).simplices.copy()).long()
    task = task_seen(lens, unknowns, eg.Mesh(corners, faces))
    poses, given = poses_of(task), task.shots[0].camera

    def area(pose: Pose) -> Tensor:
        return torch.tensor(scipy.spatial.ConvexHull(projected(task, given, pose, corners).numpy()).volume)

    moving = moving_cameras(task, given, poses, task.dofs)
    seen = RenderedPoses.from_cameras(task, moving, False, False, 1024, 3)
    found = seen.tangents.double().sum((2, 3))
    for alpha, pose in zip(seen.alpha, poses, strict=True):
        assert float(alpha.double().sum()) == pytest.approx(float(area(pose)), rel=1e-3)
    expected = differences(task, poses, area)
    # A shift across the picture changes the area by what perspective does alone: the scale of an error is the largest entry.
    noise = 0.01 * expected.abs().amax(0)
    assert bool(((found - expected).abs() < 0.02 * expected.abs() + noise).all()), (found, expected)


@pytest.mark.parametrize("lens", ["pinhole", "orthographic", "fisheye"])
def test_a_batch_of_renders_is_each_pose_rendered_in_the_whole_picture(lens: str) -> None:
    task = task_seen(lens, Unknowns())
    given, spp = task.shots[0].camera, 256
    poses = poses_of(task)
    moving = moving_cameras(task, given, poses, task.dofs)
    seen = RenderedPoses.from_cameras(task, moving, True, True, spp, 1)
    H, W = given.size
    whole = Box(slice(0, H), slice(0, W))
    assert (Box.around(task, moving.cameras) == whole) == (lens == "fisheye")
    for k, pose in enumerate(poses):
        moved = task.scene.transformed(pose.R, pose.t, pose.scale)
        with torch.no_grad():
            alone = eg.render_aovs(moved, given, ["alpha", "image", "depth"], spp, seed=9)
        alone = {name: x.double().movedim(-1, 0) for name, x in alone.items()}
        for name, found in (("alpha", seen.alpha[k][None]), ("image", seen.color[k])):
            off = seen.box.pasted(found, whole).double() - alone[name]
            # The variance of a share of spp samples, which a lattice covers more evenly, for both renders.
            assert float(off.square().mean().sqrt()) < 0.5 / spp**0.5, name
            assert abs(float(off.sum())) < 0.003 * float(alone["alpha"].sum()), name
        points = (seen.position[k] / seen.alpha[k].clamp(min=1e-6)).double().movedim(0, -1)
        place = pose.scale * points @ pose.R.T + pose.t
        z = place @ given.world_to_camera[2, :3] + given.world_to_camera[2, 3]
        inside = (seen.alpha[k] > 0.999) & (seen.box.cut(alone["alpha"])[0] > 0.999)
        depth = seen.box.cut(alone["depth"] / alone["alpha"].clamp(min=1e-6))[0]
        assert float((z - depth)[inside].abs().median()) < 1e-3 and int(inside.sum()) > 40


@pytest.mark.quick
def test_what_a_box_cuts_and_pastes() -> None:
    image, size = torch.rand(2, 3, 20, 30), (20, 30)
    inner = Box(slice(4, 9), slice(0, 12))
    whole = Box(slice(0, 20), slice(0, 30))
    pasted = inner.pasted(inner.cut(image), whole)
    assert pasted.shape == image.shape and torch.equal(inner.cut(pasted), inner.cut(image))
    assert float(pasted.sum()) == pytest.approx(float(inner.cut(image).sum()), rel=1e-5)
    assert inner.grown(3, size) == Box(slice(1, 12), slice(0, 15)) and inner.grown(99, size) == whole
    larger = inner.grown(3, size)
    assert torch.equal(larger.cut(pasted), inner.pasted(inner.cut(image), larger))
