"""Gauss-Newton steps of fit_scene: curvature, damping, bounds, and errors."""

from __future__ import annotations

import pytest
import torch
from brackets import BACKGROUND, bracket, camera, rotation
from messages import T, V, check_message
from quiet_fits import arranged

import edgegrad as eg
from edgegrad.fit import Parameter, PoseParameter, fit_scene, losses
from edgegrad.fit.descent.curvature import curvature, weights_of
from edgegrad.fit.descent.objective import Objective
from edgegrad.fit.descent.scene_builder import builder
from edgegrad.fit.options import Settings
from edgegrad.fit.placement import Coordinates, Pose
from edgegrad.fit.views import views_of

F64 = torch.float64
QUIET = {"progress": False, "spp": 4}


def views(sizes=(32, 32, 24)):
    """Return views of which two are rendered as one batch."""
    return [camera(size, distance) for size, distance in zip(sizes, (4.5, 5.5, 4.0), strict=True)]


def objective_of(scene, cameras, targets, parameters, regularizer=None, weights=None, **options):
    seen = views_of(cameras, targets, None, weights)
    build, _ = builder(scene, [view.camera for view in seen], False)
    coordinates = Coordinates(parameters)
    tensors = {name: p.value for name, p in coordinates.parameters.items()}
    given = Settings(**{"spp": 16, **options})
    return Objective(lambda values: build(coordinates.values(values)), seen, given, regularizer), tensors


# -- the curvature ----------------------------------------------------------------------------------------------------


def test_curvature_of_a_background_is_that_of_its_square():
    """The image is … + (1 − α) b, so the second derivative of the mean square by b is 2 Σ(1 − α)², weighted."""
    cameras = views()
    weights = [torch.linspace(0.2, 1.8, view.size[0])[:, None].expand(view.size) for view in cameras]
    scene = eg.Scene([bracket()], BACKGROUND)
    targets = [torch.rand(*view.size, 3) for view in cameras]
    objective, tensors = objective_of(
        scene, cameras, targets, {"background": Parameter(0.1, BACKGROUND.clone())}, weights=weights
    )
    H = curvature(objective, tensors, 0)
    # The loss of a batch is one mean over all that it weighs, and counts as often as it has views.
    total = 0.0
    for group in ([0, 1], [2]):
        open_ = torch.stack([1 - eg.render_aovs(scene, cameras[i], ["alpha"], spp=64, seed=0)["alpha"] for i in group])
        w = torch.stack([weights[i][..., None] for i in group])
        total += len(group) / 3 * float((w * open_**2).sum() / w.sum()) * 2 / 3
    torch.testing.assert_close(H, total * torch.eye(3, dtype=F64), rtol=0.02, atol=0.02 * total)


def test_curvature_of_a_pose_is_that_of_its_loss():
    """At the answer the loss is ½ δᵀ H δ, here by differences of renders with many samples."""
    view = camera(32)
    scene = eg.Scene([bracket()], BACKGROUND)
    target = eg.render(scene, view, spp=1024, seed=5)
    placement = PoseParameter(Pose(torch.eye(3), torch.zeros(3)), bracket()).placed("pose")

    def moved(values):
        return eg.Scene([bracket().transformed(values["pose"].R, values["pose"].t)], BACKGROUND)

    objective, tensors = objective_of(moved, [view], [target], {"pose": placement}, spp=64)
    H = torch.stack([curvature(objective, tensors, step) for step in range(4)]).mean(0)
    for direction in ([1, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0], [0, 1, 0, 0.2, -0.3, 0], [0, 0, 0, 0, 0, 1]):
        d = 0.02 * torch.tensor(direction, dtype=F64)
        there = {"pose.rotation": d[:3], "pose.shift": d[3:]}
        with torch.no_grad():
            image = eg.render(objective.build(there)[0], view, spp=1024, seed=6)
        assert float(0.5 * d @ H @ d) == pytest.approx(float((image - target).square().mean()), rel=0.25)


@pytest.mark.parametrize("name", ["l1", "l2", "huber", "robust"])
def test_weights_equal_the_slope_over_the_residual(name):
    """They are ρ′(r) / r, divided by the count of numbers."""
    view, target = camera(8), torch.zeros(8, 8, 3)
    objective, _ = objective_of(
        bracket(), [view], [target + 0.5], {"verts": Parameter(0.1, bracket().verts)}, loss=name
    )
    r = torch.linspace(-0.5, 0.5, 8 * 8 * 3).reshape(8, 8, 3)
    w = weights_of(objective, "image", [0], (target + 0.5 + r)[None])[0] * r.numel()
    x = (r / 0.1).square()
    expected = {
        "l1": 1 / r.abs(), "l2": torch.full_like(r, 2.0), "huber": (0.1 / r.abs()).clamp(max=1.0),
        "robust": 100.0 * (x / 4 + 1) ** -2,
    }[name]  # fmt: skip
    torch.testing.assert_close(w.float(), expected, rtol=1e-3, atol=1e-4)


def test_curvature_of_a_regularizer():
    """The regularizers are (b − 1)⁴, one that b does not influence, and a saddle, whose negative curvature is left
    out."""
    scene, view = eg.Scene([bracket()], BACKGROUND), camera(16)
    target = torch.zeros(16, 16, 3)
    parameters = {"background": Parameter(0.1, torch.tensor([0.0, 2.0, 1.5]))}

    def curved(regularizer):
        objective, tensors = objective_of(scene, [view], [target], parameters, regularizer)
        bare, _ = objective_of(scene, [view], [target], parameters)
        return curvature(objective, tensors, 0) - curvature(bare, tensors, 0)

    H = curved(lambda made: (made.background - 1.0).pow(4).sum())
    torch.testing.assert_close(H, torch.diag(torch.tensor([12.0, 12.0, 3.0], dtype=F64)))
    H = curved(lambda made: made.background[0] ** 2 - made.background[1] ** 2)
    torch.testing.assert_close(H, torch.diag(torch.tensor([2.0, 0.0, 0.0], dtype=F64)), rtol=0, atol=1e-6)
    assert not curved(lambda made: made.meshes[0].verts.square().mean()).any()


def test_is_far_quicker_than_adam_by_steps():
    view = camera(32)
    scene = eg.Scene([bracket()], BACKGROUND)
    target = eg.render(scene, view, spp=64, seed=1 << 20)
    start = Pose(rotation(0.1, -0.1, 0.05), torch.tensor([0.05, 0.0, 0.1], dtype=F64))
    seen = []
    wanted = {"meshes.0.pose": PoseParameter(start, rotation=0.02, shift=0.01)}
    fit = fit_scene(scene, target, view, wanted, **arranged(method="gauss-newton", callback=seen.append, **QUIET))
    assert fit.converged and fit.steps < 40 and [record.step for record in seen] == list(range(fit.steps))
    assert float((fit.poses["meshes.0.pose"].R - torch.eye(3)).norm()) < 0.02
    assert set(seen[0].gradient) == {"meshes.0.pose.rotation", "meshes.0.pose.shift"}


# -- what it refuses --------------------------------------------------------------------------------------------------


class NoForward(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return x.clone()

    @staticmethod
    def backward(ctx, g):
        return g


@pytest.mark.parametrize(
    ("change", "error", "parts"),
    [
        ({"method": "newton"}, V, ["method: expected one of adam, gauss-newton, got 'newton'"]),
        ({"parameters": {"texture": 0.1}}, V, ["expected at most 400 numbers", "got 3072; give method=", "adam"]),
        ({"views_per_step": 1}, V, ["views_per_step: expected None for method"]),
        ({"loss": losses.multiscale()}, V, ["loss: expected a loss of each pixel by itself"]),
        ({"loss": "iou"}, V, ["loss: expected a loss of each pixel by itself"]),
        ({"scene": lambda values: quad().replace(verts=NoForward.apply(values["v"]))}, T, ["method: expected", "forward mode"]),
    ],
)  # fmt: skip
def test_errors_name_the_argument(change, error, parts):
    parameters = {"v": Parameter(0.01, quad().verts)} if "scene" in change else {"verts": 0.01}
    view = eg.Camera.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), size=(16, 16))
    given = {"scene": quad(), "parameters": parameters, "method": "gauss-newton", **QUIET, **change}
    check_message(lambda: fit_scene(images=torch.zeros(16, 16, 3), cameras=view, **arranged(**given)), error, *parts)


def quad():
    square = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    return eg.Mesh(square, faces, texture=torch.rand(32, 32, 3), uvs=0.5 + 0.5 * square[:, :2], uv_faces=faces)
