"""What a fit of a rig says of its joints: which the pictures show, and how exactly; and light that is found with a pose."""

from __future__ import annotations

import math

import pytest
import torch
from arms import arm, shown, views
from quiet_fits import arranged, quiet

import edgegrad as eg
from edgegrad.fit import Parameter, fit_rig
from edgegrad.fit.descent.curvature import curvature, derivatives
from edgegrad.fit.descent.objective import Objective
from edgegrad.fit.descent.settings import DescentSettings
from edgegrad.fit.options import Settings
from edgegrad.fit.rig.joint_support import edge_support_by_joint, left_out
from edgegrad.fit.rig.uncertainty import uncertainty_of
from edgegrad.fit.views import views_of

F64 = torch.float64
TRUTH = torch.tensor([[0.0, 0.0, 0.2], [0.2, 0.0, 0.4], [0.0, 0.0, 0.3]], dtype=F64)


def objective(rig: eg.rig.Rig, cameras: list[eg.Camera], **pictures: list[torch.Tensor]) -> Objective:
    def build(values: dict[str, torch.Tensor]) -> tuple[eg.Scene, list[eg.Camera]]:
        return eg.Scene([rig.posed(values["rotations"])]), cameras

    return Objective(build, views_of(cameras, pictures.get("images"), pictures.get("masks"), None), Settings(spp=64))


def test_a_misplaced_hand_has_low_edge_support() -> None:
    rig, cameras = arm(3), views(48, 2)
    judged = objective(rig, cameras, masks=shown(rig.posed(TRUTH), cameras))
    names = {"rotations": rig.joints.names}
    wrong = TRUTH.clone()
    wrong[2, 2] = -1.0
    right, off = (edge_support_by_joint(judged, {"rotations": pose}, names) for pose in (TRUTH, wrong))
    assert min(right.values()) > 0.95
    assert off["bone 2"] < 0.5 < 0.6 < off["bone 0"] and off["bone 2"] < off["bone 1"] < off["bone 0"]


def test_a_hidden_hand_leaves_pixels_uncovered() -> None:
    """A hand that is folded onto its arm has hardly edges of its own, and the masks show what nothing covers."""
    rig, cameras = arm(3), views(48, 2)
    hidden = TRUTH.clone()
    hidden[2, 2] = math.pi
    seen = views_of(cameras, None, shown(rig.posed(TRUTH), cameras), None)
    right, off = (left_out(seen, shown(rig.posed(pose), cameras)) for pose in (TRUTH, hidden))
    assert right == 0.0 and off > 0.1
    assert left_out(seen, shown(rig.posed(TRUTH + 0.02), cameras)) == 0.0


def test_uncertainty_is_that_of_noise() -> None:
    """For noise of a known deviation σ the covariance is σ² (JᵀJ)⁻¹, with J by a derivative of its own."""
    rig, cameras, sigma = arm(2, colored=True), views(32, 2), 0.1
    truth = TRUTH[:2]
    g = torch.Generator().manual_seed(2)
    clean = shown(rig.posed(truth), cameras, "image")
    judged = objective(rig, cameras, images=[p + sigma * torch.randn(p.shape, generator=g) for p in clean])
    found = uncertainty_of(judged, {"rotations": truth}, {"rotations": 0.03}, {"rotations": rig.joints.names})
    JTJ = torch.zeros(6, 6, dtype=F64)
    mesh = rig.posed(truth)
    tangents = (
        torch.autograd.functional.jacobian(lambda x: rig.posed(x).verts, truth).movedim((2, 3), (0, 1)).flatten(0, 1)
    )
    for camera in cameras:
        _, J = eg.jvp(mesh, camera, {mesh.verts: tangents.float()}, 64, 77, aovs=["image"])
        rows = J["image"].reshape(6, -1).double()
        JTJ += rows @ rows.T
    expected = (sigma**2 * torch.linalg.inv(JTJ)).diagonal().sqrt()
    ratio = found.covariance.diagonal().sqrt() / expected
    assert float(ratio.min()) > 0.8 and float(ratio.max()) < 1.25


def test_curvature_of_views_in_one_call(monkeypatch) -> None:
    """It is the sum of the curvatures of each view by itself."""
    rig, cameras = arm(2), views(32, 3)
    judged, values = objective(rig, cameras, masks=shown(rig.posed(TRUTH[:2]), cameras)), {"rotations": 0.9 * TRUTH[:2]}
    ((_, group, images, slopes),) = derivatives(judged, values, 0)
    ((_, of_slope),) = judged.renders(*judged.build(values), group, judged.options.spp, judged.seed(0))
    assert images.shape == of_slope["alpha"].shape and slopes[0].shape == (6, 32, 32, 1)
    assert float((images - of_slope["alpha"]).abs().max()) < 0.3  # the same views in the same order
    together = curvature(judged, values, 0)
    monkeypatch.setattr("edgegrad.fit.descent.curvature.DESCENT", DescentSettings(max_derivatives=0))
    alone = curvature(judged, values, 0)
    off = float((together - alone).norm() / alone.norm())
    assert off < 0.02 < float((1.05 * together - alone).norm() / alone.norm())


def test_what_no_picture_shows_is_unknown() -> None:
    """A joint belongs to a limb that lies out of sight."""
    rig, cameras = arm(2), views(32, 1)
    camera = cameras[0].replace(world_to_camera=cameras[0].world_to_camera.clone())
    camera.world_to_camera[1, 3] += 2.2  # of the upper limb hardly anything is seen
    fit = fit_rig(
        rig, None, camera, masks=shown(rig.posed(), [camera]), seek=["rotations"], search=0,
        options=quiet(coarsest=32, steps=3),
    )  # fmt: skip
    assert fit.uncertainty is not None and fit.uncertainty.degrees["bone 1"] > 5.0
    assert "bone 1 known to ±" in fit.uncertainty.unknown
    assert fit.confidence < 0.1


def test_light_is_found_with_the_pose() -> None:
    rig, cameras = arm(2, colored=True), views(24, 2)

    def lit(posed: eg.Mesh, light: torch.Tensor) -> eg.Scene:
        normals = posed.vertex_normals()
        mesh = posed.replace(colors=None, normals=normals, material=eg.Material(base_color=posed.colors))
        return eg.Scene(mesh, lights=[eg.lights.SphericalHarmonics(light.to(posed.verts))])

    light = torch.zeros(9, 1, dtype=F64)
    light[:4, 0] = torch.tensor([4.0, 0.8, -0.5, 0.6])
    truth = TRUTH[:2]
    pictures = [eg.render(lit(rig.posed(truth), light), camera, 64, 9) for camera in cameras]
    start = torch.zeros_like(light)
    start[0] = 2.0
    options = {"seek": ["rotations"], "search": 0, "coarsest": 24, "steps": 9}
    sought = {"light": Parameter(0.2, start)}
    found = fit_rig(rig, pictures, cameras, appearance=(lit, sought), **arranged(**options))
    assert math.degrees(float((found.values["rotations"] - truth).norm(dim=1).max())) < 5.0
    assert torch.allclose(found.fit.values["light"][:4], light[:4], atol=0.3) and "light" not in found.values
    with pytest.raises(ValueError, match="parameters: expected names that the rig does not have, got 'rotations'"):
        sought = {"rotations": Parameter(0.2, start)}
        fit_rig(rig, pictures, cameras, appearance=(lit, sought), **arranged(**options))
    with pytest.raises(TypeError, match=r"parameters\['light'\]: expected a Parameter, got float"):
        fit_rig(rig, pictures, cameras, appearance=(lit, {"light": 0.2}), **arranged(**options))
