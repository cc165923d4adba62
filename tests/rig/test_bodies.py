"""Rigs of functions, such as body models."""

from __future__ import annotations

import pytest
import torch

import edgegrad as eg

pytestmark = pytest.mark.quick

VERTS = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)
FACES = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def body(lengths: torch.Tensor, lean: torch.Tensor) -> dict[str, torch.Tensor]:
    verts = VERTS * lengths + lean * VERTS[:, 2:] * VERTS.new_tensor([1.0, 0.0, 0.0])
    return {"verts": verts, "joints": torch.stack([verts[0], verts[3]])}


def rig() -> eg.rig.Rig:
    controls = {"lengths": torch.ones(3), "lean": eg.rig.Control(torch.tensor(0.0), low=-1.0, high=1.0)}
    return eg.rig.Rig.from_function(body, FACES, controls, joints=[("foot", -1), ("head", 0)])


def test_a_function_is_a_rig() -> None:
    found = rig()
    mesh = found.posed(lengths=[1.0, 2.0, 3.0], lean=0.5, translation=[1.0, 0.0, 0.0])
    half = 0.5 * torch.ones(3)
    expected = body(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), torch.tensor(0.5))["verts"]
    assert torch.allclose(mesh.verts, expected + torch.tensor([1.0, 0.0, 0.0])) and torch.allclose(
        found.center.float(), half
    )
    many = found.posed(lean=torch.tensor([0.0, 0.5]))
    assert torch.allclose(many[1].verts, found.posed(lean=0.5).verts)
    shape = found.shape({"lean": torch.tensor([0.0, 0.5])}, scale=2.0)
    assert shape.joints.shape == (2, 2, 3)
    leaves = [
        torch.ones(3, dtype=torch.float64, requires_grad=True),
        torch.tensor(0.2, dtype=torch.float64, requires_grad=True),
    ]
    assert torch.autograd.gradcheck(
        lambda a, b: found.posed(lengths=a, lean=b, scale=b).verts, leaves, check_forward_ad=True
    )


def test_a_function_of_a_batch() -> None:
    def batched(lengths: torch.Tensor, lean: torch.Tensor) -> torch.Tensor:
        assert lengths.shape[0] == lean.shape[0]
        return torch.stack([body(a, b)["verts"] for a, b in zip(lengths, lean, strict=True)])

    found = eg.rig.Rig.from_function(batched, FACES, {"lengths": torch.ones(3), "lean": torch.zeros(())}, batched=True)
    other = rig()
    assert torch.allclose(found.posed(lean=0.3).verts, other.posed(lean=0.3).verts.to(found.meshes[0].verts))
    _, b = found.posed(lean=torch.tensor([0.3, 0.4]), lengths=[1.0, 2.0, 1.0])
    assert torch.allclose(b.verts, other.posed(lean=0.4, lengths=[1.0, 2.0, 1.0]).verts.to(b.verts))


def test_bad_functions() -> None:
    for error, message, call in (
        (TypeError, "function: expected a function", lambda: eg.rig.Rig.from_function(3, FACES, {"a": torch.zeros(1)})),
        (TypeError, "controls: expected a mapping", lambda: eg.rig.Rig.from_function(body, FACES, {})),
        (
            TypeError,
            "function: expected vertices",
            lambda: eg.rig.Rig.from_function(lambda a: 1.0, FACES, {"a": torch.zeros(1)}),
        ),
        (
            ValueError,
            r"function: expected vertices \(4, 3\) of mesh 0, got \(3, 3\)",
            lambda: eg.rig.Rig.from_function(lambda a: VERTS[:3] * a, eg.Mesh(VERTS, FACES), {"a": torch.ones(())}),
        ),
        (ValueError, "lean: expected finite", lambda: rig().posed(lean=torch.tensor(float("inf")))),
        (ValueError, r"lean: expected shape \(\)", lambda: rig().posed(lean=torch.zeros(2, 2))),
        (ValueError, "low ≤ high", lambda: rig().with_limits(lean=(1.0, -1.0))),
        (TypeError, "expected values of lengths, lean", lambda: rig().posed(width=1.0)),
    ):
        with pytest.raises(error, match=message):
            call()
    assert rig().clamped(lean=3.0)["lean"] == 1.0


@pytest.mark.slow
def test_anny() -> None:
    """The body model has some 13,700 vertices and 104 bones, and a function of its own."""
    anny = pytest.importorskip("anny")
    roma = pytest.importorskip("roma")
    model = anny.Anny(skinning_method="lbs")
    bones = len(model.bone_labels)

    def function(rotations: torch.Tensor, **phenotype: torch.Tensor) -> torch.Tensor:
        poses = torch.eye(4, dtype=rotations.dtype).repeat(*rotations.shape[:2], 1, 1)
        poses = torch.cat(
            [torch.cat([roma.rotvec_to_rotmat(rotations), poses[..., :3, 3:]], -1), poses[..., 3:, :]], -2
        )
        return model(poses, phenotype)["vertices"]

    controls = {"rotations": eg.rig.Control(torch.zeros(bones, 3), names=tuple(model.bone_labels), rotates=True)}
    controls |= {name: eg.rig.Control(torch.tensor(0.5), 0.0, 1.0) for name in model.phenotype_labels}
    found = eg.rig.Rig.from_function(function, model.get_triangular_faces(), controls, batched=True)
    rest = torch.eye(4, dtype=model.dtype).repeat(1, bones, 1, 1)
    plain = model(rest, {n: torch.tensor([0.5]) for n in model.phenotype_labels})
    assert torch.allclose(found.posed().verts.to(plain["vertices"]), plain["vertices"][0], atol=1e-6)
    bend = torch.tensor([0.0, 0.0, 0.8], dtype=torch.float64, requires_grad=True)
    height = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    moved = found.posed({"lowerarm01.L": bend}, height=height)
    assert float((moved.verts - found.posed().verts).norm(dim=1).max()) > 0.1
    moved.verts.square().sum().backward()
    assert (
        bend.grad is not None
        and height.grad is not None
        and float(bend.grad.norm()) > 0
        and float(height.grad.abs()) > 0
    )
