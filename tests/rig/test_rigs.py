"""Rigs from glTF files agree with a reference in float64, have right gradients, and say what is wrong."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import roma
import torch
from rig_checks import check, malformed, primitive
from rig_files import SAMPLES, Sample, rigged_simple, simple_morph, simple_skin, walk

import edgegrad as eg
from edgegrad.rig.skin import Skin


@pytest.mark.parametrize("name", SAMPLES)
def test_samples_agree_with_a_reference(name: str, tmp_path) -> None:
    sample = SAMPLES[name]()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rig = eg.rig.load(sample.write(tmp_path), lit=True)
    check(sample, rig, rig.posed(), None, 0.0)
    for number, animation in enumerate(rig.animations.values()):
        times = np.linspace(-0.1, animation.duration + 0.1, 10)
        batch = rig.posed(**animation.at(torch.tensor(times))) if animation.channels else [rig.posed()] * 10
        for t, posed in zip(times, batch, strict=True):
            check(sample, rig, posed, number, float(t))
        t = 0.37 * animation.duration
        check(sample, rig, rig.posed(**rig.animation(animation.name).at(t)), number, t)


def test_the_check_rejects_what_is_off(tmp_path) -> None:
    sample = simple_skin()
    rig = eg.rig.load(sample.write(tmp_path))
    with pytest.raises(AssertionError):
        check(sample, rig, rig.posed(**rig.animation("bend").at(0.7001)), 0, 0.7)
    with pytest.raises(AssertionError):
        check(sample, rig, rig.posed(**rig.animation("bend").at(0.7), skinning="dual quaternion"), 0, 0.7)


def test_plain_loaders_name_load_rig(tmp_path) -> None:
    with pytest.warns(
        UserWarning, match=r"animations \(shown at rest; eg.rig.load\(\) has them\).*skins .*eg.rig.load"
    ):
        eg.load_scene(simple_skin().write(tmp_path))
    with pytest.warns(UserWarning, match=r"morph targets \(shown without; eg.rig.load"):
        eg.load_scene(simple_morph().write(tmp_path, "b.gltf"))


# -- gradients --------------------------------------------------------------------------------------------------------


def small(dtype: torch.dtype = torch.float64) -> eg.rig.Rig:
    """Return three joints in a chain, one morph target, and normals."""
    g = torch.Generator().manual_seed(0)
    verts = torch.rand(7, 3, generator=g, dtype=dtype) * 3.0
    faces = torch.tensor([[0, 1, 2], [2, 3, 4], [4, 5, 6]])
    normals = torch.randn(7, 3, generator=g, dtype=dtype)
    joints = eg.rig.Joints(
        ["a", "b", "c"], [-1, 0, 1], torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0, 0]]), torch.zeros(3, 3)
    )
    skin = Skin(
        torch.arange(3), torch.linalg.inv(joints.world()), torch.rand(7, 3, generator=g) + 0.1, 0,
        torch.randn(2, 7, 3, generator=g), torch.randn(2, 7, 3, generator=g),
    )  # fmt: skip
    return eg.rig.Rig.from_arrays(eg.Mesh(verts, faces, normals=normals), joints, skin, morphs=("wide", "long"))


@pytest.mark.parametrize("skinning", ["linear", "dual quaternion"])
def test_gradients_by_all_that_moves_it(skinning: str) -> None:
    rig, g = small(), torch.Generator().manual_seed(1)
    given = {
        "rotations": 0.5 * torch.randn(3, 3, generator=g), "joint_translations": torch.randn(3, 3, generator=g),
        "morphs": torch.randn(2, generator=g), "translation": torch.randn(3, generator=g),
        "scale": torch.tensor(1.3), "orientation": torch.randn(3, generator=g),
    }  # fmt: skip
    if skinning == "linear":
        given["joint_scales"] = 1.0 + 0.2 * torch.randn(3, 3, generator=g)
    leaves = {name: value.double().requires_grad_() for name, value in given.items()}

    def bent(*values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mesh = rig.posed(**dict(zip(leaves, values, strict=True)), skinning=skinning)
        return mesh.verts, mesh.normals

    assert torch.autograd.gradcheck(bent, tuple(leaves.values()), check_forward_ad=skinning == "linear")


def test_gradients_at_rest_are_finite() -> None:
    rig = small()
    rotations, orientation = (torch.zeros(*s, dtype=torch.float64, requires_grad=True) for s in ((3, 3), (3,)))
    assert torch.autograd.gradcheck(
        lambda r, o: rig.posed(r, orientation=o).verts, (rotations, orientation), check_forward_ad=True
    )


def test_gradients_by_time(tmp_path) -> None:
    rig = eg.rig.load(rigged_simple().write(tmp_path), dtype=torch.float64)
    t = torch.tensor(0.6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda t: rig.posed(**rig.animation().at(t)).verts, (t,))


# -- what posed() takes -----------------------------------------------------------------------------------------------


def test_rotations_in_all_forms() -> None:
    rig, g = small(), torch.Generator().manual_seed(2)
    vectors = torch.randn(4, 3, 3, generator=g, dtype=torch.float64)
    forms = [vectors, roma.rotvec_to_unitquat(vectors), roma.rotvec_to_rotmat(vectors)]
    first, *others = ([mesh.verts for mesh in rig.posed(form)] for form in forms)
    for other in others:
        for a, b in zip(first, other, strict=True):
            assert torch.allclose(a, b, atol=1e-12)
    single = rig.posed(vectors[2]).verts
    assert torch.allclose(single, first[2], atol=1e-12)
    named = rig.posed({"b": vectors[2, 1], "a": roma.rotvec_to_rotmat(vectors[2, 0])}).verts
    both = vectors[2].clone()
    both[2] = 0.0
    assert torch.allclose(named, rig.posed(both).verts, atol=1e-12)


def test_a_batch_of_one_value_and_the_rest_for_all() -> None:
    rig = small()
    shifts = torch.randn(5, 3, dtype=torch.float64)
    many = rig.posed({"b": [0.0, 0.3, 0.0]}, translation=shifts, morphs=[0.5, -1.0])
    for mesh, shift in zip(many, shifts, strict=True):
        one = rig.posed({"b": [0.0, 0.3, 0.0]}, translation=shift, morphs={"wide": 0.5, "long": -1.0})
        assert torch.allclose(mesh.verts, one.verts, atol=1e-12) and torch.allclose(mesh.normals, one.normals)


def test_a_batch_of_named_joints() -> None:
    rig, g = small(), torch.Generator().manual_seed(3)
    vectors = torch.randn(5, 3, generator=g, dtype=torch.float64)
    whole = torch.zeros(5, 3, 3, dtype=torch.float64)
    whole[:, 0], whole[:, 1] = vectors, torch.tensor([0.0, 0.3, 0.0], dtype=torch.float64)
    longs = torch.linspace(0.0, 1.0, 5, dtype=torch.float64)
    morphs = torch.stack([torch.zeros_like(longs), longs], 1)
    expected = rig.posed(whole, morphs=morphs)
    for form in (vectors, roma.rotvec_to_rotmat(vectors)):
        for one, other in zip(
            rig.posed({"a": form, "b": [0.0, 0.3, 0.0]}, morphs={"long": longs}), expected, strict=True
        ):
            assert torch.allclose(one.verts, other.verts, atol=1e-12)


def test_the_whole_is_placed_about_its_middle() -> None:
    rig = small()
    R = roma.rotvec_to_rotmat(torch.tensor([0.1, -0.4, 0.9], dtype=torch.float64))
    moved = rig.posed(orientation=R, scale=2.0, translation=torch.tensor([1.0, 2.0, 3.0]))
    expected = 2.0 * (rig.posed().verts - rig.center) @ R.T + rig.center + torch.tensor([1.0, 2.0, 3.0])
    assert torch.allclose(moved.verts, expected, atol=1e-12)
    assert torch.allclose(moved.normals, rig.posed().normals @ R.T, atol=1e-12)


def test_dual_quaternions_keep_the_volume_of_a_twist() -> None:
    """A vertex half on a joint that twists by 170° turns by 85° and keeps its distance; linear blending takes it to cos 85°."""
    verts = torch.tensor([[1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
    joints = eg.rig.Joints(["a", "b"], [-1, 0], torch.zeros(2, 3), torch.zeros(2, 3))
    rig = eg.rig.Rig.from_arrays(eg.Mesh(verts, torch.tensor([[0, 1, 2]])), joints, torch.full((3, 2), 0.5))
    angle = math.radians(170)
    kept = rig.posed({"b": [angle, 0.0, 0.0]}, skinning="dual quaternion").verts[0]
    lost = rig.posed({"b": [angle, 0.0, 0.0]}).verts[0]
    half = angle / 2
    assert torch.allclose(kept, kept.new_tensor([1.0, math.cos(half), math.sin(half)]), atol=1e-9)
    assert math.isclose(float(lost[1:].norm()), math.cos(half), rel_tol=1e-9)
    with pytest.raises(ValueError, match=r'skinning: .*"linear"'):
        rig.posed(joint_scales={"b": [1.0, 2.0, 1.0]}, skinning="dual quaternion")
    scaled = rig.posed(joint_scales={"a": [2.0, 2.0, 2.0]}, skinning="dual quaternion").verts
    assert torch.allclose(scaled, 2.0 * verts, atol=1e-9)


def test_limits() -> None:
    rig = small().with_limits(rotations={"b": ([-0.1] * 3, [0.2] * 3)}, morphs=(0.0, 1.0))
    found = rig.clamped(rotations=torch.full((3, 3), 0.5), morphs=torch.tensor([2.0, -1.0]))
    assert torch.allclose(found["rotations"][1], torch.full((3,), 0.2, dtype=torch.float64))
    assert torch.allclose(found["rotations"][0], torch.full((3,), 0.5, dtype=torch.float64))
    assert found["morphs"].tolist() == [1.0, 0.0]
    with pytest.raises(ValueError, match="low ≤ high"):
        rig.with_limits(morphs=(1.0, 0.0))


def test_a_posed_mesh_is_saved(tmp_path) -> None:
    rig = eg.rig.load(walk().write(tmp_path))
    posed = rig.posed(**rig.animation("Walk").at(0.7))
    eg.save_scene(tmp_path / "posed.glb", posed)
    again = eg.load_scene(tmp_path / "posed.glb")
    for a, b in zip(posed.meshes, again.meshes, strict=True):
        assert torch.allclose(a.verts[a.faces], b.verts[b.faces], atol=1e-6)
    eg.save_mesh(tmp_path / "posed.ply", posed.meshes[0])


def test_what_a_rig_hides_and_welds(tmp_path) -> None:
    """Equal positions with other weights stay apart; a mirrored node keeps the fronts of its faces."""
    sample = simple_skin()
    sample.tree["nodes"][1]["scale"] = [-1, 1, 1]
    mesh = eg.rig.load(sample.write(tmp_path)).posed()
    a, b, c = mesh.verts[mesh.faces].unbind(1)
    assert bool((torch.linalg.cross(b - a, c - a)[:, 2] > 0).all())
    sample.tree["nodes"][0]["extensions"] = {"KHR_node_visibility": {"visible": False}}
    sample.tree["extensionsUsed"] = ["KHR_node_visibility"]
    with pytest.raises(ValueError, match="expected triangles, got none"):
        eg.rig.load(sample.write(tmp_path))


# -- bad input --------------------------------------------------------------------------------------------------------


BAD: dict[str, tuple[Sample, str]] = {
    "joint not in the scene": (
        malformed(lambda s: s.tree["scenes"].__setitem__(0, {"nodes": [0]})), r"skin 0: expected joints in the scene, got node 1"
    ),
    "cycle": (malformed(lambda s: s.tree["nodes"][2].update(children=[1])), "expected a tree of nodes, got node 1"),
    "negative weights": (
        malformed(lambda s: primitive(s)["attributes"].update(WEIGHTS_0=s.add(np.full((10, 4), -1.0)))), "WEIGHTS_0 from 0 up"
    ),
    "joint beyond the skin": (
        malformed(lambda s: primitive(s)["attributes"].update(JOINTS_0=s.add(np.full((10, 4), 2), "<u1"))),
        "JOINTS_0 from 0 to 1, got 2",
    ),
    "no weights": (malformed(lambda s: primitive(s)["attributes"].pop("WEIGHTS_0")), "JOINTS_0 and WEIGHTS_0 of shape"),
    "few inverse binds": (
        malformed(lambda s: s.tree["skins"][0].update(inverseBindMatrices=s.add(np.eye(4)[None]))), "2 inverse bind matrices"
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_files(case: str, tmp_path) -> None:
    sample, message = BAD[case]
    with pytest.raises(ValueError, match=message) as caught:
        eg.rig.load(sample.write(tmp_path))
    assert "a.gltf" in str(caught.value)


def test_weights_are_normalised_with_a_warning(tmp_path) -> None:
    sample = simple_skin()
    primitive(sample)["attributes"]["WEIGHTS_0"] = sample.add(
        3.0 * sample.numbers[primitive(sample)["attributes"]["WEIGHTS_0"]]
    )
    with pytest.warns(UserWarning, match="weights of 'mesh 0' that add up to 1 only within 2"):
        rig = eg.rig.load(sample.write(tmp_path))
    check(sample, rig, rig.posed(**rig.animation().at(0.8)), 0, 0.8)


def test_bad_arguments() -> None:
    rig = small()
    skin = Skin(torch.tensor([0]), torch.eye(4)[None], torch.ones(7, 1), 0, torch.zeros(1, 6, 3))
    for error, message, call in (
        (ValueError, "rotations: expected shape", lambda: rig.posed(torch.zeros(4, 3))),
        (ValueError, "rotations: expected rotations, got matrices", lambda: rig.posed(torch.ones(3, 3, 3))),
        (ValueError, "unit quaternions", lambda: rig.posed(torch.ones(3, 4))),
        (ValueError, "rotations: expected names among a, b, c", lambda: rig.posed({"elbow": [0.0, 0, 0]})),
        (ValueError, "rotations: expected finite", lambda: rig.posed(torch.full((3, 3), math.nan))),
        (TypeError, "expected values of rotations, .*got 'angles'", lambda: rig.posed(angles=torch.zeros(3))),
        (ValueError, "as many poses", lambda: rig.posed(torch.zeros(2, 3, 3), translation=torch.zeros(4, 3))),
        (ValueError, r"rotations\['a'\]: expected shape \(3,\).*got \(2,\)", lambda: rig.posed({"a": [0.0, 0.0]})),
        (ValueError, r"rotations\['a'\]: expected finite.*\[2\]", lambda: rig.posed({"a": [0.0, 0.0, math.nan]})),
        (ValueError, r"orientation: expected shape \(3,\)", lambda: rig.posed(orientation=[0.0, 0.0])),
        (ValueError, "low: expected numbers, .*got nan", lambda: rig.with_limits(rotations=(math.nan, 1.0))),
        (TypeError, "clamped: expected values of rotations", lambda: rig.clamped(translation=torch.zeros(3))),
        (ValueError, "controls: expected names other than .*got 'scale'", lambda: eg.rig.Rig.from_function(
            lambda scale: rig.scene.verts * scale, rig.scene.faces, {"scale": torch.ones(())})),
        (ValueError, "skinning: expected one of", lambda: rig.posed(skinning="smooth")),
        (ValueError, "expected an animation among none", lambda: rig.animation("Walk")),
        (ValueError, "cycle: a → b → a", lambda: eg.rig.Joints(["a", "b"], [1, 0], torch.zeros(2, 3), torch.zeros(2, 3))),
        (ValueError, "each joint once", lambda: eg.rig.Joints(["a", "a"], [-1, 0], torch.zeros(2, 3), torch.zeros(2, 3))),
        (
            ValueError,
            r"targets: expected shape \(M, 7, 3\)",
            lambda: eg.rig.Rig.from_arrays(rig.scene, rig.joints, skin),
        ),
    ):  # fmt: skip
        with pytest.raises(error, match=message):
            call()


# -- several bodies ---------------------------------------------------------------------------------------------------


def two_bars() -> eg.rig.Rig:
    """Return one rig of two coloured bars on joints of their own, the second across the first."""
    from arms import arm

    one, skin = arm(), arm().deformer.skins[0]
    meshes = [
        one.scene.replace(colors=torch.tensor(c).expand(len(one.scene.verts), 3))
        for c in ([0.9, 0.2, 0.1], [0.1, 0.6, 0.9])
    ]
    joints = eg.rig.Joints(
        ["a0", "a1", "b0", "b1"], [-1, 0, -1, 2],
        torch.tensor([[0.0, 0, 0], [0, 1, 0], [0.75, 0.3, 0.35], [0, 1, 0]]),
        torch.tensor([[0.0, 0, 0], [0, 0, 0], [0, 0, 0.9], [0, 0, 0]]),
    )  # fmt: skip
    inverse = torch.linalg.inv(one.joints.world())
    skins = [Skin(torch.tensor(rows), inverse, skin.weights) for rows in ([0, 1], [2, 3])]
    return eg.rig.Rig.from_arrays(eg.Scene(meshes), joints, skins)


@pytest.mark.parametrize("depth", [0.0, -0.35], ids=["in front", "through"])
def test_gradients_of_bodies_that_occlude_each_other(depth: float) -> None:
    """Finite differences give the derivatives of an image's loss by the joints of both. At depth 0 one is before the
    other, at −0.35 within it."""
    rig = two_bars()
    camera = eg.Camera.look_at((0.8, 1.0, 5.0), (0, 1, 0), up=(0, 1, 0), fov_y=30, size=(32, 32))
    at = rig.joints.translations.clone()
    at[2, 2] += depth
    coarse = torch.rand(1, 3, 4, 4, generator=torch.Generator().manual_seed(4))
    # Smooth, so that differences over part of a pixel are derivatives.
    weight = torch.nn.functional.interpolate(coarse, size=(32, 32), mode="bicubic")[0].movedim(0, -1)

    def loss(angles: torch.Tensor, spp: int, seed: int, **samples: int) -> torch.Tensor:
        rotations = torch.nn.functional.pad(angles[:, None], (2, 0)) + torch.nn.functional.pad(
            0.4 * angles[:, None], (0, 2)
        )
        scene = rig.posed(rotations, joint_translations=at)
        return (eg.render(scene, camera, spp=spp, seed=seed, **samples) * weight).sum().double()

    angles = torch.tensor([0.1, -0.3, 0.15, 0.2], dtype=torch.float64, requires_grad=True)
    samples = {"sampling": eg.Sampling(surface=400_000, edges=400_000)}
    (found,) = torch.autograd.grad(loss(angles, 4, 1, **samples), angles)
    h = 0.02
    with torch.no_grad():
        steps = torch.eye(4, dtype=torch.float64) * h
        expected = torch.stack([(loss(angles + s, 2048, 2) - loss(angles - s, 2048, 2)) / (2 * h) for s in steps])
    assert (found - expected).norm() < 0.02 * expected.norm()
    assert not (1.05 * found - expected).norm() < 0.02 * expected.norm()


def test_options_for_files_of_the_other_kind_are_refused() -> None:
    with pytest.raises(ValueError, match="package_dirs: expected none with a glTF file"):
        eg.rig.load("a.glb", package_dirs=["."])
    with pytest.raises(ValueError, match="lit: expected the default with a URDF file"):
        eg.rig.load("a.urdf", lit=True)
    with pytest.raises(TypeError, match="path: expected a str or Path, got int"):
        eg.rig.load(3)  # type: ignore[arg-type]
