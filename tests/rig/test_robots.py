"""Links of robots from URDF files are in their places, and errors name what is wrong with a file."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

import edgegrad as eg
from edgegrad.fit import fit_rig

yourdfpy = pytest.importorskip("yourdfpy")
pytest.importorskip("pytorch_kinematics")
import arm  # noqa: E402
from quiet_fits import arranged  # noqa: E402

GRIPPER = """<?xml version="1.0"?>
<robot name="gripper">
  <material name="red"><color rgba="1 0 0 1"/></material>
  <link name="hand"><visual><geometry><box size="0.2 0.1 0.1"/></geometry><material name="red"/></visual></link>
  <link name="left"><visual><origin xyz="0 0 0.1" rpy="0.1 0.2 0.3"/><geometry>
    <mesh filename="finger.ply" scale="0.5 1 2"/></geometry></visual></link>
  <link name="right"><visual><geometry><sphere radius="0.05"/></geometry></visual></link>
  <link name="spin"/>
  <joint name="slide" type="prismatic"><parent link="hand"/><child link="left"/><origin xyz="0.1 0 0.2" rpy="0.3 -0.2 0.1"/>
    <axis xyz="1 0 0"/><limit lower="0.01" upper="0.1" effort="1" velocity="1"/></joint>
  <joint name="follow" type="prismatic"><parent link="hand"/><child link="right"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/><mimic joint="slide" multiplier="-2" offset="0.03"/></joint>
  <joint name="turn" type="continuous"><parent link="right"/><child link="spin"/><origin xyz="0 0.1 0"/>
    <axis xyz="0 1 1"/></joint>
</robot>
"""  # fmt: skip


def gripper(folder: Path, text: str = GRIPPER) -> Path:
    finger = eg.Mesh(
        torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]),
        torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3]]),
    )
    eg.save_mesh(folder / "finger.ply", finger)
    path = folder / "gripper.urdf"
    path.write_text(text)
    return path


def check_links(path: Path, robot: eg.rig.Rig, seed: int) -> None:
    """Check links against yourdfpy's own kinematics."""
    control = robot.controls["angles"]
    random = torch.rand(len(control.rest), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    low, high = control.low.clamp(min=-3.0), control.high.clamp(max=3.0)
    angles = low + random * (high - low)
    other = yourdfpy.URDF.load(str(path), load_meshes=False)
    other.update_cfg({name: float(a) for name, a in zip(control.names, angles, strict=True)})
    shape = robot.shape({"angles": angles})
    for name, place in zip(robot.deformer.names, shape.joints, strict=True):
        assert np.abs(other.get_transform(name, other.base_link)[:3, 3] - place.numpy()).max() < 1e-6
    for mesh, link, verts in zip(robot.meshes, robot.deformer.carries, shape.verts, strict=True):
        matrix = other.get_transform(robot.deformer.names[link], other.base_link)
        expected = mesh.verts.double().numpy() @ matrix[:3, :3].T + matrix[:3, 3]
        assert np.abs(expected - verts.double().numpy()).max() < 1e-6


def test_links_are_where_another_library_has_them(tmp_path) -> None:
    for path in (arm.write(tmp_path / "arm.urdf"), gripper(tmp_path)):
        robot = eg.rig.load(path)
        for seed in range(3):
            check_links(path, robot, seed)


def test_a_robot_of_a_package() -> None:
    """The robot has joints that mimic others, colours, and meshes of OBJ files."""
    models = pytest.importorskip("airo_models")
    path = Path(models.get_urdf_path("robotiq_2f_85"))
    robot = eg.rig.load(path)
    assert robot.controls["angles"].names == ("finger_joint",) and len(robot.meshes) == 11
    check_links(path, robot, 0)


def test_parts_limits_and_colours(tmp_path) -> None:
    robot = eg.rig.load(gripper(tmp_path))
    control = robot.controls["angles"]
    assert control.names == ("slide", "turn")
    assert control.rest.tolist() == [0.01, 0.0] and control.low.tolist() == [0.01, -math.inf]
    assert robot.clamped(angles=[1.0, 9.0])["angles"].tolist() == [0.1, 9.0]
    hand, finger, ball = robot.meshes
    assert hand.face_colors[0].tolist() == [1.0, 0.0, 0.0]
    assert finger.verts.shape == (4, 3) and float(ball.verts.norm(dim=1).max()) == pytest.approx(0.05, rel=1e-5)
    moved = robot.posed(angles={"slide": 0.05})
    assert isinstance(moved, eg.Scene) and len(moved.meshes) == 3
    assert len(robot.posed(angles=torch.zeros(4, 2))) == 4


def test_gradients_by_angles(tmp_path) -> None:
    robot = eg.rig.load(arm.write(tmp_path / "arm.urdf"))
    angles = (0.3 * torch.arange(7, dtype=torch.float64)).requires_grad_()
    where = lambda a: robot.shape({"angles": a}).joints  # noqa: E731
    assert torch.autograd.gradcheck(where, (angles,), check_forward_ad=True)


def test_only_the_joints_that_are_named_turn(tmp_path) -> None:
    robot = eg.rig.load(arm.write(tmp_path / "arm.urdf"))
    names = robot.controls["angles"].names
    middle, size = robot.center.tolist(), 2.0 * robot.size
    camera = eg.Camera.look_at((middle[0], middle[1] - size, middle[2]), middle, up=(0, 0, 1), fov_y=40, size=(24, 24))
    truth = 0.2 * torch.ones(7, dtype=torch.float64)
    with torch.no_grad():
        mask = eg.render_aovs(robot.posed(angles=truth), camera, ["alpha"], spp=16, seed=0)["alpha"]
    options = {"masks": [mask], "search": 0, "steps": 2, "coarsest": 24, "progress": False}
    found = fit_rig(robot, None, [camera], seek=[names[1]], **arranged(**options)).values["angles"]
    assert float(found[1]) != 0.0 and float(found.abs().sum()) == float(found[1].abs())
    with pytest.raises(ValueError, match="seek: expected names among"):
        fit_rig(robot, None, [camera], seek=["nope"], **arranged(**options))


BAD = {
    "missing mesh": (
        GRIPPER.replace("finger.ply", "package://hand/gone.ply"), FileNotFoundError, r"link 'left': names the mesh .*gone"
    ),
    "no XML": ("robot", ValueError, "expected a URDF"),
    "no such link": (
        GRIPPER.replace('<child link="spin"/>', '<child link="wheel"/>'), ValueError, "links of the file, got 'wheel'"
    ),
    "cycle": (
        GRIPPER.replace('<parent link="hand"/><child link="right"/>', '<parent link="spin"/><child link="right"/>'), ValueError,
        "cycle: right → spin → right",
    ),
    "two parents": (GRIPPER.replace('<child link="spin"/>', '<child link="left"/>'), ValueError, "link 'left': .*got two"),
    "another joint": (GRIPPER.replace('"continuous"', '"floating"'), ValueError, "joint 'turn': expected a type among"),
    "limits the wrong way": (GRIPPER.replace('lower="0.01"', 'lower="0.5"'), ValueError, "joint 'slide': .*lower ≤ upper"),
    "mimics nothing": (GRIPPER.replace('mimic joint="slide"', 'mimic joint="gone"'), ValueError, "to mimic, got 'gone'"),
    "damaged mesh": (GRIPPER.replace("finger.ply", "broken.stl"), ValueError, "link 'left': "),
    "nothing to see": ('<robot name="a"><link name="a"/></robot>', ValueError, "links with visuals, got none"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_files(case: str, tmp_path) -> None:
    text, error, message = BAD[case]
    (tmp_path / "broken.stl").write_text("no mesh")
    path = gripper(tmp_path, text)
    with pytest.raises(error, match=message) as caught:
        eg.rig.load(path)
    assert "gripper.urdf" in str(caught.value)
