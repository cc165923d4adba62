"""A bad part of a glTF file is named, and the rest of the file is read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lit_gltf import CAMERAS, file
from rig_checks import check, malformed, primitive
from rig_files import Sample, quaternion_matrix, simple_morph, simple_skin
from scipy.spatial.transform import Rotation, Slerp

import edgegrad as eg
from edgegrad.rig.animation import Channel


def load(sample: Sample, folder: Path, message: str) -> eg.rig.Rig:
    with pytest.warns(UserWarning, match=message):
        return eg.rig.load(sample.write(folder))


# -- rotations --------------------------------------------------------------------------------------------------------

KEYS = np.array([[0.3, -0.5, 0.2, 0.79], [-0.6, 0.1, 0.7, 0.38], [0.1, 0.1, -0.9, 0.2]])
KEYS /= np.linalg.norm(KEYS, axis=1, keepdims=True)


def turning(rows: np.ndarray, interpolation: str, dtype: str) -> Sample:
    """Return a triangle at the axes whose node rotates at 0, 1 and 2 s."""
    sample = Sample()
    attributes = {"POSITION": sample.add(np.eye(3))}
    sample.tree |= {"scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, "name": "n"}]}
    sample.tree["meshes"] = [{"primitives": [{"attributes": attributes}]}]
    samplers = [
        {
            "input": sample.add([0.0, 1.0, 2.0]),
            "output": sample.add(rows, dtype, normalized=dtype != "<f4"),
            "interpolation": interpolation,
        }
    ]
    channels = [{"sampler": 0, "target": {"node": 0, "path": "rotation"}}]
    sample.tree["animations"] = [{"name": "A", "samplers": samplers, "channels": channels}]
    return sample


def matrix_at(rig: eg.rig.Rig, t: float) -> np.ndarray:
    return rig.posed(**rig.animation("A").at(t)).verts.double().numpy().T


def degrees(A: np.ndarray, B: np.ndarray) -> float:
    assert np.abs(A @ A.T - np.eye(3)).max() < 1e-6
    return float(np.degrees(Rotation.from_matrix(A.T @ B).magnitude()))


@pytest.mark.parametrize("dtype", ["<i1", "<i2"])
def test_rotations_in_bytes_and_shorts_are_slerps_of_unit_quaternions(dtype: str, tmp_path) -> None:
    sample = turning(KEYS, "LINEAR", dtype)
    stored = sample.numbers[2]
    rig = eg.rig.load(sample.write(tmp_path))
    slerp = Slerp([0.0, 1.0, 2.0], Rotation.from_quat(stored))
    for t in (0.0, 0.3, 1.0, 1.5, 2.0):
        assert degrees(matrix_at(rig, t), slerp(t).as_matrix()) < 1e-4
    rig = eg.rig.load(turning(KEYS, "STEP", dtype).write(tmp_path))
    assert degrees(matrix_at(rig, 0.9), quaternion_matrix(stored[0])) < 1e-4
    # Of a spline the keys, and the speed at which it leaves them.
    tangents = 0.3 * np.random.default_rng(0).standard_normal((3, 2, 4)).clip(-1, 1)
    sample = turning(np.stack([tangents[:, 0], KEYS, tangents[:, 1]], 1).reshape(-1, 4), "CUBICSPLINE", dtype)
    rows, h = sample.numbers[2].reshape(3, 3, 4), 1e-4
    rig = eg.rig.load(sample.write(tmp_path), dtype=torch.float64)
    assert degrees(matrix_at(rig, 1.0), quaternion_matrix(rows[1, 1])) < 1e-4
    ahead = quaternion_matrix(rows[0, 1] + h * rows[0, 2])
    assert degrees(matrix_at(rig, h), ahead) < 0.01 * degrees(matrix_at(rig, 0.0), ahead)


def test_rotations_of_other_lengths_are_named(tmp_path) -> None:
    rig = load(turning(1.5 * KEYS, "LINEAR", "<f4"), tmp_path, "rotation of node 'n' in animation 'A'.* of length 1.5")
    assert degrees(matrix_at(rig, 1.0), quaternion_matrix(KEYS[1])) < 1e-4
    rows = KEYS.copy()
    rows[1] = 0.0
    rig = load(turning(rows, "LINEAR", "<f4"), tmp_path, r"animation 'A' \(left out: .*zeros at key 1")
    assert rig.animation("A").channels == ()
    sample = turning(KEYS, "LINEAR", "<f4")
    sample.tree["nodes"][0]["rotation"] = (2.0 * KEYS[0]).tolist()
    rig = load(sample, tmp_path, r"rotation of node 'n' of length 2 \(divided by it\)")
    assert degrees(rig.posed().verts.double().numpy().T, quaternion_matrix(KEYS[0])) < 1e-4
    sample.tree["nodes"][0]["rotation"] = [0.0] * 4
    assert degrees(load(sample, tmp_path, "of length 0").posed().verts.double().numpy().T, np.eye(3)) < 1e-4


def test_channels_take_unit_quaternions_alone() -> None:
    times, keys = torch.tensor([0.0, 1.0]), torch.tensor(KEYS[:2])
    with pytest.raises(ValueError, match=r"values: expected unit quaternions x, y, z, w, got one of length 2 at key 1"):
        Channel("rotation", 0, times, keys * torch.tensor([[1.0], [2.0]]))
    assert torch.allclose(Channel("rotation", 0, times, 1.009 * keys).values, keys)
    assert torch.allclose(Channel("scale", 0, times, 2.0 * keys[:, :3]).values, 2.0 * keys[:, :3])


# -- skins ------------------------------------------------------------------------------------------------------------


def test_vertices_without_weights_hang_on_the_first_joint(tmp_path) -> None:
    sample = simple_skin()
    attributes = primitive(sample)["attributes"]
    weights = sample.numbers[attributes["WEIGHTS_0"]].copy()
    weights[9] = 0.0
    attributes["WEIGHTS_0"] = sample.add(weights)
    rig = load(
        sample, tmp_path, r"1 of 10 vertices of 'mesh 0' whose weights are all 0, as vertex 9 \(bound to the first"
    )
    weights[9, 0] = 1.0
    attributes["WEIGHTS_0"] = sample.add(weights)
    check(sample, rig, rig.posed(**rig.animation("bend").at(0.7)), 0, 0.7)


def test_a_primitive_without_joints_is_rigid_with_its_node(tmp_path) -> None:
    """Both loaders read it, next to another that the skin moves."""
    sample = simple_skin()
    there = primitive(sample)["attributes"]
    sample.tree["meshes"][0]["primitives"].append({"attributes": {"POSITION": there["POSITION"]}, "indices": 2})
    sample.tree["meshes"][0]["primitives"][1]["indices"] = primitive(sample)["indices"]
    rig = load(
        sample, tmp_path, r"the skin of 'mesh 0, primitive 1', which has no JOINTS_0 \(rigid with node 'node 0'\)"
    )
    before, after = rig.posed(), rig.posed(**rig.animation("bend").at(1.0))
    assert torch.equal(before.meshes[1].verts, after.meshes[1].verts)
    assert not torch.allclose(before.meshes[0].verts, after.meshes[0].verts)
    with pytest.warns(UserWarning, match="skins"):
        scene = eg.load_scene(tmp_path / "a.gltf")
    assert torch.allclose(scene.meshes[1].verts, before.meshes[1].verts)
    assert before.meshes[1].verts.amin(0).tolist() == [7.0, 8.0, 9.0]


# -- animations and morphs --------------------------------------------------------------------------------------------

CHANNELS: dict[str, tuple[Callable[[Sample], Any], str]] = {
    "two keys at one time": (
        lambda s: s.animation("b", (2, "translation", [0.0, 0.5, 0.5], np.zeros((3, 3)), "LINEAR")), "ascending times"
    ),
    "times go back": (
        lambda s: s.animation("b", (2, "translation", [1.0, 0.5], np.zeros((2, 3)), "LINEAR")), "ascending times"
    ),
    "values of another length": (
        lambda s: s.animation("b", (2, "translation", [0.0, 0.5], np.zeros((3, 3)), "LINEAR")), "expected 2 × 1 × 3"
    ),
    "unknown interpolation": (
        lambda s: s.animation("b", (2, "translation", [0.0, 0.5], np.zeros((2, 3)), "CUBIC")), "interpolation among"
    ),
    "no such sampler": (
        lambda s: (s.animation("b"), s.tree["animations"][-1]["channels"].append({"sampler": 4, "target": {
            "node": 2, "path": "translation"}})), "one of its 0 samplers by number, got 4"
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CHANNELS)
def test_channels_that_cannot_be_read_are_left_out(case: str, tmp_path) -> None:
    change, message = CHANNELS[case]
    sample = malformed(change)
    rig = load(sample, tmp_path, rf"translation of node 'upper' in animation 'b' \(left out: .*{message}")
    assert list(rig.animations) == ["bend", "b"] and rig.animation("b").channels == ()
    check(sample, rig, rig.posed(**rig.animation("bend").at(0.7)), 0, 0.7)


def test_a_channel_of_a_node_that_is_not_there_is_named(tmp_path) -> None:
    def change(s: Sample) -> None:
        s.animation("b", (2, "translation", [0.0, 0.5], np.zeros((2, 3)), "LINEAR"))
        s.tree["animations"][-1]["channels"][0]["target"]["node"] = 99

    rig = load(
        malformed(change), tmp_path, r"translation of node 99 in animation 'b' \(left out: there is no such node"
    )
    assert rig.animation("b").channels == ()


def test_names_differ(tmp_path) -> None:
    """Nodes, morph targets and animations differ, also where one has the name that another would get."""
    sample = simple_morph()
    sample.tree["meshes"][0]["extras"]["targetNames"] = ["smile", "smile"]
    sample.tree["nodes"] = [{"mesh": 0, "name": "a"}, {"name": "a (2)"}, {"name": "a"}, {"name": ""}]
    sample.tree["scenes"][0]["nodes"] = [0, 1, 2, 3]
    for name in ("morph (2)", "morph"):
        sample.animation(name, (0, "weights", [0, 1], [[0, 0], [0, 1]], "LINEAR"))
    rig = eg.rig.load(sample.write(tmp_path))
    assert rig.controls["morphs"].names == ("smile", "a: smile")
    assert rig.controls["rotations"].names == ("a", "a (2)", "a (2) (2)", "node 3")
    assert list(rig.animations) == ["morph", "morph (2)", "morph (2) (2)"]
    for given, names in ((["", ""], ("target 0", "target 1")), ([], ("target 0", "target 1"))):
        sample.tree["meshes"][0]["extras"]["targetNames"] = given
        assert eg.rig.load(sample.write(tmp_path)).controls["morphs"].names == names
    sample.tree["meshes"].append({**sample.tree["meshes"][0], "extras": {"targetNames": ["x", "x"]}})
    sample.tree["nodes"] += [{"mesh": 1, "name": "x"}, {"mesh": 1, "name": "x"}]
    sample.tree["scenes"][0]["nodes"] += [4, 5]
    names = eg.rig.load(sample.write(tmp_path)).controls["morphs"].names
    assert len(set(names)) == len(names) == 6


def test_morphs_that_do_not_fit(tmp_path) -> None:
    sample = malformed(lambda s: s.tree["meshes"][0].update(weights=[1]), simple_morph)
    rig = load(sample, tmp_path, r"weights of 'mesh 0', 1 for 2 morph targets \(0 for each")
    sample.tree["meshes"][0]["weights"] = [0, 0]
    check(sample, rig, rig.posed(), None, 0.0)
    sample = malformed(lambda s: primitive(s)["targets"][1].update(POSITION=s.add([[0, 0, 1]] * 4)), simple_morph)
    rig = load(
        sample, tmp_path, r"morph targets of 'mesh 0' \(left out: expected POSITION of shape \(3, 3\) in morph target 1"
    )
    assert "morphs" not in rig.controls and rig.posed().verts.shape == (3, 3)
    # A primitive with fewer targets than another is not moved by those that it lacks.
    sample = simple_morph()
    sample.tree["meshes"][0]["primitives"].append({k: v for k, v in primitive(sample).items() if k != "targets"})
    first, second = eg.rig.load(sample.write(tmp_path)).posed(morphs=[0.0, 1.0]).meshes
    assert not torch.allclose(first.verts, second.verts) and second.verts.amax(0).tolist() == [1.0, 0.5, 0.0]


# -- cameras ----------------------------------------------------------------------------------------------------------


def test_a_camera_that_cannot_be_read_is_left_out(tmp_path) -> None:
    nodes = [
        {"mesh": 0},
        {"scale": [-1, 1, 1], "children": [2]},
        {"camera": 0, "name": "m"},
        {"camera": 1, "name": "n"},
    ]
    path = file(tmp_path, nodes=nodes, roots=[0, 1, 3], cameras=CAMERAS)
    with pytest.warns(UserWarning, match=r"camera 'm' \(left out: expected a camera that .* below a node that mirrors"):
        views = eg.load_cameras(path, size=(20, 30))
    assert list(views) == ["n"] and views["n"].camera.projection == "orthographic"
    assert eg.load_camera(path, size=(20, 30), index=1).projection == "orthographic"  # counted with the other
    with pytest.raises(ValueError, match=r"a\.glb: expected a camera that .* below a node that mirrors"):
        eg.load_camera(path, size=(20, 30))
    path = file(tmp_path, nodes=nodes[:3], roots=[0, 1], cameras=CAMERAS)
    with pytest.raises(ValueError, match=r"a\.glb: expected a camera that .* below a node that mirrors"):
        eg.load_cameras(path, size=(20, 30))
