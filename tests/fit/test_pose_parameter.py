"""Poses among the parameters of fit_scene: coordinates, names, and all that a fit writes."""

from __future__ import annotations

import json
import math

import pytest
import torch
from brackets import BACKGROUND, CENTER, before_sky, bracket, camera, rotation
from brackets import START as START_MATRIX
from messages import T, V, check_message
from quiet_fits import arranged

import edgegrad as eg
from edgegrad.fit import Parameter, PoseParameter, fit_scene
from edgegrad.fit.placement import Coordinates, Pose

F64 = torch.float64
QUIET = {"progress": False, "spp": 4}
START = Pose(START_MATRIX[:3, :3], START_MATRIX[:3, 3])


def target(view):
    return eg.render(before_sky(), view, spp=64, seed=1 << 20)


def fitted(size=24, **options):
    view = camera(size)
    start = before_sky()
    wanted = {"meshes.0.pose": PoseParameter(START, rotation=0.02, shift=0.01)}
    return fit_scene(start, target(view), view, wanted, **arranged(**{**QUIET, **options}))


# -- what it is -------------------------------------------------------------------------------------------------------


def test_steps_are_rotation_vectors_about_the_middle_and_shifts_in_sizes():
    mesh, size = bracket(), math.sqrt(2.0**2 + 1.5**2 + 0.8**2)
    scaled = START._replace(scale=torch.tensor(1.3, dtype=F64))
    placement = PoseParameter(scaled, mesh, scale=0.01).placed("pose")
    at = {name: p.value for name, p in placement.coordinates.items()}
    torch.testing.assert_close(placement.pose(at).matrix, scaled.matrix)
    where = 1.3 * START.R @ CENTER + START.t
    turn = torch.tensor([0.3, -2.0, 0.4], dtype=F64)
    turned = placement.pose({**at, "rotation": turn})
    torch.testing.assert_close(turned.R, rotation(*turn.tolist()) @ START.R)
    torch.testing.assert_close(1.3 * turned.R @ CENTER + turned.t, where)
    moved = placement.pose({**at, "shift": torch.tensor([0.5, 0.0, -1.0], dtype=F64)})
    torch.testing.assert_close(moved.t - scaled.t, 1.3 * size * torch.tensor([0.5, 0.0, -1.0], dtype=F64))
    grown = placement.pose({**at, "scale": torch.tensor(math.log(2.0), dtype=F64)})
    assert float(grown.scale) == pytest.approx(2.6)
    torch.testing.assert_close(2.6 * grown.R @ CENTER + grown.t, where)


def test_a_pose_is_differentiable_in_all_its_steps():
    placement = PoseParameter(START, bracket(), scale=0.01).placed("pose")
    values = [torch.randn(p.value.shape, dtype=F64).requires_grad_() for p in placement.coordinates.values()]

    def pose(*values):
        return placement.pose(dict(zip(placement.coordinates, values, strict=True))).matrix

    assert torch.autograd.gradcheck(pose, values, check_forward_ad=True)


def test_a_function_gets_a_pose_in_the_type_of_the_object():
    mesh, seen = bracket().to(torch.float32), []

    def scene(values):
        seen.append(values["place"])
        return mesh.transformed(values["place"].R, values["place"].t, values["place"].scale)

    fit = fit_scene(
        scene, target(camera(16)), camera(16), {"place": PoseParameter(START, mesh)}, **arranged(steps=2, **QUIET)
    )
    assert all(isinstance(pose, Pose) and pose.R.dtype == pose.t.dtype == torch.float32 for pose in seen)
    assert any(pose.R.requires_grad for pose in seen) and fit.mesh.verts.dtype == torch.float32
    assert fit.values["place"].shape == (4, 4) and fit.values["place"].dtype == F64
    assert torch.equal(fit.poses["place"].matrix, fit.values["place"])


# -- what it finds, and by which names --------------------------------------------------------------------------------


def test_finds_a_pose_by_name():
    fit = fitted(48, steps=200)
    pose = fit.poses["meshes.0.pose"]
    torch.testing.assert_close(fit.history[0].values["meshes.0.pose"], START_MATRIX, rtol=0, atol=1e-12)
    apart = math.degrees(math.asin(float((pose.R - torch.eye(3)).norm()) / 8**0.5) * 2.0)
    assert fit.converged and apart < 0.5
    assert float((pose.R @ CENTER + pose.t - CENTER).norm()) < 0.005 * 2.62
    torch.testing.assert_close(fit.mesh.verts, bracket().transformed(pose.R, pose.t).verts)


def test_rotation_vectors_longer_than_pi_are_rotations():
    """Steps add up in a rotation vector of any length, which still makes a rotation."""
    placement = PoseParameter(START, bracket()).placed("pose")
    for turn in (3.5, 6.0, 20.0):
        at = {"rotation": torch.tensor([0.0, turn, 0.3], dtype=F64), "shift": torch.zeros(3, dtype=F64)}
        R = placement.pose(at).R
        torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=F64))


def test_a_mesh_has_a_pose_and_other_parameters():
    """The mesh's vertices move with its pose. A scene's second mesh moves alone."""
    mesh, view = bracket(), camera(16)
    pose = Pose(START.R, START.t)
    fit = fit_scene(
        mesh, target(view), view, {"pose": PoseParameter(pose), "verts": 1e-3}, **arranged(steps=2, **QUIET)
    )
    found = fit.poses["pose"]
    torch.testing.assert_close(
        fit.mesh.verts, mesh.replace(verts=fit.values["verts"]).transformed(found.R, found.t, found.scale).verts
    )
    two = eg.Scene([mesh, mesh.transformed(t=torch.tensor([1.4, 1.2, 0.5], dtype=F64), scale=0.3)], BACKGROUND)
    fit = fit_scene(two, target(view), view, {"meshes.1.pose": PoseParameter()}, **arranged(steps=9, **QUIET))
    assert torch.equal(fit.scene.meshes[0].verts, mesh.verts)
    assert float((fit.scene.meshes[1].verts - two.meshes[1].verts).abs().max()) > 1e-3


def test_a_camera_moves_the_other_way():
    """A camera moved by M sees what the old one sees moved by M⁻¹."""
    view = camera(16)
    scene = before_sky()
    fit = fit_scene(scene, target(view), view, {"cameras.0.pose": PoseParameter(START)}, **arranged(steps=1, **QUIET))
    expected = view.world_to_camera.double() @ torch.linalg.inv(START_MATRIX)
    started = fit.history[0].values["cameras.0.pose"]
    torch.testing.assert_close(started, START_MATRIX)
    moved = fit.values["cameras.0.pose"]
    torch.testing.assert_close(
        fit.cameras[0].world_to_camera.double(),
        view.world_to_camera.double() @ torch.linalg.inv(moved), rtol=0, atol=1e-5,
    )  # fmt: skip
    assert float((expected - fit.cameras[0].world_to_camera.double()).abs().max()) < 0.2


# -- in what a fit writes ---------------------------------------------------------------------------------------------


def test_histories_files_and_pictures_have_the_pose(tmp_path):
    seen = []
    fit = fitted(steps=4, callback=lambda progress: seen.append((progress, progress.scene.meshes[0].verts)))
    record, verts = seen[-1]
    assert (
        set(record.gradient) == {"meshes.0.pose.rotation", "meshes.0.pose.shift"} and min(record.gradient.values()) > 0
    )
    torch.testing.assert_close(seen[-2][1], bracket().transformed(*_parts(record.values["meshes.0.pose"])).verts)
    assert not torch.equal(verts, seen[-2][1])
    names = fit.save(tmp_path)
    assert {"fit.json", "values.pt", "history.json", "fit.png", "loss.png", "mesh.ply"} <= set(names)
    summary = json.loads((tmp_path / "fit.json").read_text())
    torch.testing.assert_close(torch.tensor(summary["values"]["meshes.0.pose"], dtype=F64), fit.values["meshes.0.pose"])
    assert summary["reason"] == fit.reason
    history = json.loads((tmp_path / "history.json").read_text())
    torch.testing.assert_close(torch.tensor(history[0]["values"]["meshes.0.pose"], dtype=F64), START_MATRIX)
    values = torch.load(tmp_path / "values.pt", weights_only=True)
    assert torch.equal(values["meshes.0.pose"], fit.values["meshes.0.pose"])


def _parts(matrix):
    return matrix[:3, :3], matrix[:3, 3]


def test_coordinates_without_poses_are_the_values():
    coordinates = Coordinates({"x": Parameter(0.1, torch.ones(2))})
    x = torch.ones(2)
    assert coordinates.values({"x": x})["x"] is x and not coordinates.poses({"x": x})


@pytest.mark.parametrize(
    ("name", "parameter", "error", "message"),
    [
        ("meshes.0.pose", 0.1, T, "meshes.0.pose: expected a PoseParameter, got float"),
        ("meshes.1.pose", PoseParameter(), V, "did you mean 'meshes.0.pose'"),
        ("background", PoseParameter(), V, "expected a pose's name among meshes.0.pose, cameras.0.pose"),
        ("cameras.0.pose", PoseParameter(scale=0.1), V, "cameras.0.pose: scale: expected None for a camera"),
        ("pose", PoseParameter(torch.eye(3)), V, "pose: init: expected shape (4, 4)"),
        ("pose", PoseParameter((2.0 * torch.eye(3), torch.zeros(3))), V, "pose: R: expected a rotation"),
        ("pose", PoseParameter((torch.eye(3), torch.zeros(2))), V, "pose: t: expected shape (3,)"),
        ("pose", PoseParameter((*START[:2], -1.0)), V, "pose: scale: expected a number above 0, got -1"),
        ("pose", PoseParameter(rotation=-1.0), V, "pose: rotation: expected"),
        ("pose", PoseParameter(of="bunny"), T, "pose: of: expected the Mesh or Scene"),
    ],
)
def test_errors_name_the_argument(name, parameter, error, message):
    view = camera(16)
    scene = bracket() if name == "pose" else before_sky()
    check_message(lambda: fit_scene(scene, target(view), view, {name: parameter}, **arranged(**QUIET)), error, message)


def test_a_function_needs_the_mesh_that_is_moved():
    view = camera(16)
    with pytest.raises(
        TypeError, match=r"place: of: expected the Mesh or Scene that is moved, got none; give PoseParam"
    ):
        fit_scene(lambda values: bracket(), target(view), view, {"place": PoseParameter()}, **arranged(**QUIET))
