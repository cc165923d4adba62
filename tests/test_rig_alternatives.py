"""Poses that outlines hardly tell from another one: two limbs exchanged, a twist shared in another way."""

import sys
from pathlib import Path

import pytest
import torch

import edgegrad as eg
from edgegrad.fit.rig.alternatives import Alternatives, exchanged
from edgegrad.fit.rig.limbs import limbs
from edgegrad.fit.rig.sought import Sought

roma = pytest.importorskip("roma")
sys.path.append(str(Path(__file__).parents[1] / "examples"))
import body  # noqa: E402
import figure  # noqa: E402

LEGS = [f"{side} {part}" for side in ("left", "right") for part in ("hip", "knee", "foot")]
F64 = torch.float64


def legs(apart: float) -> eg.Joints:
    """Two of three joints, whose own axes at rest are not alike."""
    one = torch.tensor([[0.5 * apart, 0.0, 0.0], [0.0, -0.4, 0.0], [0.0, -0.3, 0.1]], dtype=F64)
    turns = torch.tensor([[0.3, 0.0, 0.2], [0.0, 0.5, 0.0], [0.1, 0.0, 0.0]], dtype=F64)
    mirror = torch.tensor([-1.0, 1.0, 1.0], dtype=F64)
    places = torch.cat([torch.zeros(1, 3, dtype=F64), one, one * mirror])
    return eg.Joints(
        ["hips", *LEGS], [-1, 0, 1, 2, 0, 4, 5], places, torch.cat([torch.zeros(1, 3), turns, -turns * mirror])
    )


def random_turns(count: int, seed: int, size: float = 0.6) -> torch.Tensor:
    return roma.rotvec_to_rotmat(size * torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=F64))


@pytest.mark.parametrize("seed", range(3))
def test_limbs_that_hang_on_one_point_change_places(seed: int) -> None:
    joints, turns = legs(0.0), random_turns(7, seed)
    found = exchanged(joints, turns, [1, 2, 3], [4, 5, 6])
    before, after = joints.world(turns)[:, :3, 3], joints.world(found)[:, :3, 3]
    torch.testing.assert_close(after[[1, 2, 3, 4, 5, 6]], before[[4, 5, 6, 1, 2, 3]], atol=1e-9, rtol=0.0)
    torch.testing.assert_close(found @ found.mT, torch.eye(3, dtype=F64).expand(7, 3, 3))
    assert torch.equal(found[0], turns[0])
    torch.testing.assert_close(exchanged(joints, found, [1, 2, 3], [4, 5, 6]), turns, atol=1e-9, rtol=0.0)


def test_limbs_that_hang_apart_point_to_where_the_other_one_was() -> None:
    joints, turns = legs(0.2), random_turns(7, 5)
    found = exchanged(joints, turns, [1, 2, 3], [4, 5, 6])
    before, after = joints.world(turns)[:, :3, 3], joints.world(found)[:, :3, 3]
    for own, twin in ((1, 4), (2, 5), (4, 1), (5, 2)):
        wanted = torch.nn.functional.normalize(before[twin + 1] - after[own], dim=0)
        along = torch.nn.functional.normalize(after[own + 1] - after[own], dim=0)
        torch.testing.assert_close(along, wanted)


def test_what_is_exchanged_hangs_alike() -> None:
    """Arms and legs of a figure; not a leg with the spine, nor a limb with one that branches."""
    rig = figure.figure(fine=3)
    pairs = [limb.twins for limb in limbs(rig, range(20)) if limb.twins is not None]
    names = [[rig.joints.names[k].removeprefix("left ") for k in one] for one, _ in pairs]
    assert sorted(names) == [["hip", "knee", "foot"], ["shoulder", "arm", "elbow", "hand"]]


@pytest.mark.slow
def test_crossed_legs_are_found() -> None:
    """A descent from rest, and limbs drawn anew by themselves, end with each leg in the outline of the other one."""
    rig, truth, _, fit = body.trial(6, size=96, progress=False)
    legs = [rig.joints.names.index(name) for name in LEGS]
    assert fit.converged and float(body.Errors.of(rig, fit.values["rotations"], truth).direction[legs].max()) < 2.0


@pytest.mark.slow
def test_a_shared_twist_is_found() -> None:
    """Descents end with an arm and its elbow 20° to 45° twisted against each other, and the outlines less than a pixel off."""
    _, truth, _, fit = body.trial(7, progress=False)
    assert fit.converged and float(body.Errors.of(fit.rig, fit.values["rotations"], truth).rotation.max()) < 3.0


def test_a_twist_keeps_what_hangs_below_in_place() -> None:
    rig = figure.figure(fine=3)
    sought, turns = Sought.of(rig, ["rotations"], None, {}, {}), figure.pose(7, 40.0)
    alternatives = Alternatives(rig, sought, "rotations")
    arm, elbow = (rig.joints.names.index(name) for name in ("left arm", "left elbow"))
    assert (arm, elbow) in alternatives.links({"rotations": turns}, range(20))
    found = alternatives.twisted({"rotations": turns}, arm, elbow, 0.7)
    before, after = (rig.joints.world(roma.rotvec_to_rotmat(one)) for one in (turns, found))
    others = [k for k in range(20) if k != arm]
    torch.testing.assert_close(after[others], before[others])
    torch.testing.assert_close(after[arm, :3, 3], before[arm, :3, 3])
    turned = roma.rotmat_geodesic_distance(after[arm, :3, :3], before[arm, :3, :3])
    assert float(turned) == pytest.approx(0.7, abs=1e-6)
