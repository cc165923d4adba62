"""Poses that outlines hardly separate from another one: two exchanged limbs, or a rotation that two bones share
differently."""

import pytest
import torch

import edgegrad as eg
from edgegrad.fit.descent.objective import Objective
from edgegrad.fit.options import Settings
from edgegrad.fit.rig.free_parameters import FreeParameters
from edgegrad.fit.rig.proposals import Proposals, exchanged, limbs
from edgegrad.fit.rig.search import HypothesisSearch
from edgegrad.fit.views import views_of

roma = pytest.importorskip("roma")
import body  # noqa: E402
import figure  # noqa: E402

LEGS = [f"{side} {part}" for side in ("left", "right") for part in ("hip", "knee", "foot")]
ARM = ["left arm", "left elbow", "left hand"]
F64 = torch.float64


def legs(apart: float) -> eg.rig.Joints:
    """Return two legs of three joints, whose own axes at rest are not alike."""
    one = torch.tensor([[0.5 * apart, 0.0, 0.0], [0.0, -0.4, 0.0], [0.0, -0.3, 0.1]], dtype=F64)
    turns = torch.tensor([[0.3, 0.0, 0.2], [0.0, 0.5, 0.0], [0.1, 0.0, 0.0]], dtype=F64)
    mirror = torch.tensor([-1.0, 1.0, 1.0], dtype=F64)
    places = torch.cat([torch.zeros(1, 3, dtype=F64), one, one * mirror])
    return eg.rig.Joints(
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


def test_exchanged_limbs_hang_on_joints_alike() -> None:
    """A figure's arms and legs are exchanged, but no leg with the spine, nor a limb with one that branches."""
    rig = figure.figure(fine=3)
    pairs = [limb.twins for limb in limbs(rig, range(20)) if limb.twins is not None]
    names = [[rig.joints.names[k].removeprefix("left ") for k in one] for one, _ in pairs]
    assert sorted(names) == [["hip", "knee", "foot"], ["shoulder", "arm", "elbow", "hand"]]


@pytest.mark.slow
def test_crossed_legs_are_found() -> None:
    """A descent from rest and a search of single limbs end with each leg in the outline of the other."""
    rig, truth, _, fit = body.trial(6, size=96, progress=False)
    legs = [rig.joints.names.index(name) for name in LEGS]
    assert fit.converged and float(body.Errors.of(rig, fit.values["rotations"], truth).direction[legs].max()) < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", (4, 7))
def test_axial_rotations_are_found(seed: int) -> None:
    """In pose 7, descents end with an arm and its elbow rotated by 20° to 45° against each other, with outlines less
    than a pixel off. In pose 4, a hand ends 86° across its place, and a shoulder and its arm are rotated by 15°."""
    _, truth, _, fit = body.trial(seed, progress=False)
    assert fit.converged and float(body.Errors.of(fit.rig, fit.values["rotations"], truth).rotation.quantile(0.9)) < 3.0


def arm_of(rig: eg.rig.Rig) -> tuple[FreeParameters, Proposals]:
    """Return the rotations of one arm of a figure as free parameters, and their proposals."""
    free = FreeParameters.from_arguments(rig, ARM, {"rotations": figure.pose(7, 40.0)}, {})
    return free, Proposals(rig, free, "rotations")


def test_an_axial_rotation_keeps_what_hangs_below_in_place() -> None:
    rig = figure.figure(fine=3)
    free, proposals = arm_of(rig)
    values = {"rotations": figure.pose(7, 40.0)[[rig.joints.names.index(name) for name in ARM]]}
    rotations = {(ARM[t.row], None if t.child is None else ARM[t.child]): t for t in proposals.axial_rotations(values)}
    assert list(rotations) == [("left arm", "left elbow"), ("left elbow", "left hand"), ("left hand", None)]
    # The hand's own axis points to the middle of its ellipsoid.
    along = torch.tensor(figure.BONES_ALONG[8], dtype=F64)
    assert float(rotations["left hand", None].axis @ along / along.norm()) > 0.99
    before = rig.joints.world(roma.rotvec_to_rotmat(free.all(values)["rotations"]))
    for (name, _), rotation in rotations.items():
        found = free.all({"rotations": proposals.with_rotation(values, rotation, 0.7)})["rotations"]
        after = rig.joints.world(roma.rotvec_to_rotmat(found))
        at = rig.joints.names.index(name)
        others = [k for k in range(20) if k != at]
        torch.testing.assert_close(after[others], before[others])
        torch.testing.assert_close(after[at, :3, 3], before[at, :3, 3])
        turned = roma.rotmat_geodesic_distance(after[at, :3, :3], before[at, :3, :3])
        assert float(turned) == pytest.approx(0.7, abs=1e-6)


def test_axial_rotations_are_found_by_the_loss_along_them() -> None:
    """A hand is rotated across its true place, and an arm against its elbow. What is right stays."""
    rig, cameras = figure.figure(fine=4), figure.cameras(64)[:3]
    free, proposals = arm_of(rig)
    parameter = free.parameters["rotations"]
    assert parameter.value is not None
    truth = {"rotations": parameter.value}
    masks = [eg.render_aovs(rig.posed(free.fixed["rotations"]), c, ["alpha"], spp=64, seed=5)["alpha"] for c in cameras]
    views = views_of(cameras, None, masks, None)
    build = lambda values: (eg.Scene([rig.posed(**free.all(values))]), cameras)  # noqa: E731
    objective = Objective(build, views, Settings(spp=32))
    shared, _, across = proposals.axial_rotations(truth)
    wrong = {"rotations": proposals.with_rotation(truth, shared, 0.35)}
    wrong = {"rotations": proposals.with_rotation(wrong, across, 1.5)}
    for start, most in ((wrong, 0.1), (truth, 0.06)):
        search = HypothesisSearch(objective, proposals, lambda *_: truth, torch.Generator())
        found = search.rotate_about_bones(start)["rotations"]
        R, S = (roma.rotvec_to_rotmat(one) for one in (found, truth["rotations"]))
        assert float(roma.rotmat_geodesic_distance(R, S).max()) < most
