"""fit_scene(loss="region") finds shapes, poses and cameras from photographs without a mask, in unknown light."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
import trimesh
from brackets import START, bracket, camera, errors
from photographs import clutter, photograph
from quiet_fits import arranged, quiet
from vases import AROUND, RADII, VIEW, vase

import edgegrad as eg
from edgegrad.files.image import linear_to_srgb, srgb_to_linear
from edgegrad.fit import Parameter, PoseParameter, Refinement, fit_scene, fit_shape, fit_texture, losses
from edgegrad.fit.contour_colors import CONTOUR_BLURS
from edgegrad.fit.descent.region_loss import RegionLoss
from edgegrad.fit.placement import Pose
from edgegrad.fit.region import COLORS, Palette, smoothed
from edgegrad.fit.views import region_views, views_of


def picture(lights=1):
    """Render the vase in a light, in front of clutter, and compress it."""
    mesh = vase(RADII)
    colors = 0.45 + 0.25 * torch.sin(3.0 * mesh.verts)
    return photograph(VIEW, mesh.replace(colors=colors), seed=7, sampling=eg.Sampling(lights=lights))


@pytest.fixture(scope="module")
def taken():
    return picture()


def test_finds_a_shape_and_its_translation():
    """The radii of a vase start 20 % off, and its translation 3 % of its size."""
    start = Pose(torch.eye(3), torch.tensor([0.06, -0.04, 0.0]))
    given = {
        "radii": Parameter(0.01, RADII * torch.tensor([1.2, 0.8, 1.2, 0.8]), low=0.05),
        "pose": PoseParameter(start, of=vase(RADII), rotation=0.01, shift=0.005),
    }

    def scene(values):
        pose = values["pose"]
        return vase(values["radii"]).transformed(pose.R, pose.t)

    fit = fit_scene(scene, picture(16), VIEW, given, options=quiet(loss="region", spp=4, steps=200))
    assert fit.converged and fit.steps < 200, (fit.reason, fit.steps)
    torch.testing.assert_close(fit.values["radii"], RADII, rtol=0.08, atol=0.0)
    shown = eg.render_aovs(vase(RADII), VIEW, ["alpha"], spp=64, seed=0)["alpha"]
    assert losses.iou(fit.render(), shown) < 0.04


@pytest.mark.parametrize("method", [pytest.param("adam", marks=pytest.mark.slow), "gauss-newton"])
def test_finds_a_pose(method):
    """A bracket without colours starts 12.3° and 8.4 % of its size off. Rounding errors alone change its end by 0.2°."""
    view = camera(80)
    given = {"pose": PoseParameter(Pose(START[:3, :3], START[:3, 3]))}
    image = photograph(view, seed=2, sampling=eg.Sampling(lights=16))
    fit = fit_scene(bracket(plain=True), image, view, given, options=quiet(loss="region", method=method, spp=8))
    degrees, percent = errors(fit.poses["pose"])
    assert degrees < 2.2 and percent < 2.0 and fit.converged, (degrees, percent, fit.reason)


@pytest.mark.slow
def test_finds_a_camera(taken):
    """The camera starts shifted, and the vase stays."""
    moved = VIEW.replace(
        world_to_camera=VIEW.world_to_camera + torch.tensor([[0.0, 0.0, 0.0, 0.15]] * 2 + [[0.0] * 4] * 2)
    )
    given = {"cameras.0.pose": PoseParameter(rotation=0.005, shift=0.005)}
    fit = fit_scene(vase(RADII), taken, moved, given, options=quiet(loss="region", spp=8))
    corners = vase(RADII).verts
    off = (fit.cameras[0].project(corners) - VIEW.project(corners)).norm(dim=-1)
    assert float((moved.project(corners) - VIEW.project(corners)).norm(dim=-1).mean()) > 4.0
    assert float(off.mean()) < 1.0, off


@pytest.mark.slow
def test_finds_a_shape_from_several_views():
    """A sphere becomes a bumpy ellipsoid, without a mask."""

    def sphere(subdivisions):
        made = trimesh.creation.icosphere(subdivisions=subdivisions)
        return torch.tensor(made.vertices.copy()).float(), torch.tensor(made.faces.copy())

    n, faces = sphere(3)
    verts = n * torch.tensor([1.0, 0.7, 0.8]) * (1.0 + 0.15 * torch.sin(3.0 * n[:, :1]))
    true = eg.Mesh(verts, faces, colors=0.45 + 0.25 * torch.sin(4.0 * n))
    angles = torch.arange(8) * math.pi / 4.0
    eyes = torch.stack([3.6 * angles.cos(), torch.tensor([1.5, -1.5] * 4), 3.6 * angles.sin()], -1)
    views = [eg.Camera.look_at(eye, (0.0, 0.0, 0.0), fov_y=40.0, size=(96, 96)) for eye in eyes]
    images = [photograph(view, true, seed=k) for k, view in enumerate(views)]
    fit = fit_shape(
        eg.Mesh(*sphere(2)), images, views, refinement=Refinement(levels=2), options=quiet(loss="region", steps=80, spp=4),
    )  # fmt: skip

    def off(mesh):
        shown = [[eg.render_aovs(m, view, ["alpha"], spp=32, seed=0)["alpha"] for m in (mesh, true)] for view in views]
        return sum(float(losses.iou(*pair)) for pair in shown) / len(views)

    assert off(fit.mesh) < 0.05 < 0.25 < off(fit.start.meshes[0])


def test_loss_and_curvature_are_those_of_the_likelihood(taken):
    regions = RegionLoss(region_views(views_of(VIEW, taken)), 0)
    alpha = eg.render_aovs(vase(RADII), VIEW, ["alpha"], spp=16, seed=0)["alpha"]
    regions.renew(0, alpha)
    sharp = regions.blur  # what the picture shows
    assert sharp in CONTOUR_BLURS
    P, near = regions.colors[0].posterior[0].double(), regions.shares([0])[0].double()
    inside, outside = (
        float(P[(alpha[..., 0] > 0.99) == side][near[(alpha[..., 0] > 0.99) == side] > 0].mean())
        for side in (True, False)
    )
    assert inside > 0.75 and outside < 0.25
    moving = (0.8 * alpha).requires_grad_()

    def of_regions(soft):
        return -(near * (soft * P + (1 - soft) * (1 - P) + COLORS.outliers).log())

    sides = regions.colors[0].sides
    assert sides is not None and 200 < int(sides.band.sum()) < 2000
    display, variance = regions.pictures[0].display, sides.variance[0]
    front, back = (srgb_to_linear(side[0].clamp(0.0, 1.0)).double() for side in (sides.front, sides.back))

    def mixed(soft):
        return linear_to_srgb(soft * front + (1 - soft) * back)

    def squares(soft):
        return ((mixed(soft) - display).square() / variance).sum(0)

    def of_contour(soft):
        return near * (sides.band[0] > 0) * 0.5 * squares(soft) / (1 + squares(soft) / 12.0)

    for step, blur in (
        (0, 3.0),
        (regions.settings.renewal_steps, 1.8),
        (5 * regions.settings.renewal_steps, sharp),
    ):  # the contour counts where alpha is sharp
        regions.renew(0, alpha, step)
        soft = smoothed(moving[None, ..., 0], blur)[0].double()
        parts = [of_regions(soft)] + [of_contour(soft)] * (blur == sharp)
        expected, found = sum(part.sum() for part in parts), regions.loss([0], moving[None])
        assert float(found) == pytest.approx(float(expected), rel=1e-6)
        by = [torch.autograd.grad(loss, moving, retain_graph=True)[0] for loss in (found, expected)]
        torch.testing.assert_close(by[0], by[1], rtol=1e-4, atol=1e-9)
        # Fisher's information is the square of what each pixel gives, by its share of the mean.
        slope = torch.autograd.grad(parts[0].sum(), soft, retain_graph=True)[0]
        expected = torch.where(near > 0.0, slope.square() / near.clamp(min=1e-12), 0.0)
        if blur == sharp:  # of the contour that of a squared difference, with a weight that is held fixed
            weight = (1 + squares(soft) / 12.0).pow(-2) * near * (sides.band[0] > 0)
            along = (mixed(soft + 1e-5) - mixed(soft - 1e-5)) / 2e-5
            expected = expected + weight * (along.square() / variance).sum(0)
        torch.testing.assert_close(regions.curvature([0], moving[None])[0].double(), expected, rtol=1e-4, atol=1e-9)


def test_colours_are_counted_anew_where_the_object_has_moved(taken):
    """They stay if the object has left the picture."""
    regions = RegionLoss(region_views(views_of(VIEW, taken)), 0)
    alpha = eg.render_aovs(vase(RADII), VIEW, ["alpha"], seed=0)["alpha"]
    regions.renew(0, alpha)
    first = regions.colors[0].posterior
    regions.renew(0, torch.roll(alpha, 10, 1))
    second = regions.colors[0].posterior
    assert not torch.equal(first, second)
    regions.renew(0, torch.zeros_like(alpha))
    assert (
        torch.equal(regions.colors[0].posterior, second)
        and float(regions.loss([0], torch.zeros_like(alpha)[None])) > 0.5
    )


def test_weights_leave_pixels_out(taken):
    weights = torch.ones(96, 96)
    weights[:, 60:] = 0.0
    malformed = torch.where(weights[..., None] > 0.0, taken, taken.flip(0))
    alpha = eg.render_aovs(vase(RADII), VIEW, ["alpha"], seed=0)["alpha"]
    found = []
    for image in (taken, malformed):
        views = region_views(views_of(VIEW, image, None, weights))
        regions = RegionLoss(views, 0)
        colors = Palette(torch.rand(64, 3, generator=torch.Generator().manual_seed(1)))
        labels = colors.labels(regions.pictures[0].display.movedim(0, -1))
        regions.pictures = [replace(regions.pictures[0], palette=colors, labels=labels)]
        regions.renew(0, alpha)
        found.append(float(regions.loss([0], alpha[None])))
    assert found[0] == pytest.approx(found[1], rel=1e-6)


def test_radiance_and_weights_of_any_unit(taken):
    alpha = eg.render_aovs(vase(RADII), VIEW, ["alpha"], seed=0)["alpha"]
    found = []
    for unit, weight in ((1.0, 1.0), (40.0, 0.01)):
        regions = RegionLoss(region_views(views_of(VIEW, unit * taken, None, torch.full((96, 96), weight))), 0)
        regions.renew(0, alpha)
        found.append(regions.edge_support([alpha]))
    assert found[1] == pytest.approx(found[0], abs=0.05) and found[0] > 0.5


def test_colours_are_as_sure_in_larger_pictures():
    """A disc with spots of the background's colours, and the other way round: their share at the contour is the same at any
    resolution, and blurred pixels are fewer in larger pictures."""
    found, spots = [], (torch.rand(1, 1, 24, 24, generator=torch.Generator().manual_seed(0)) < 0.15).float()
    for n in (96, 384):
        at = (torch.arange(n) + 0.5) / n - 0.5
        alpha = (n * (0.25 - torch.hypot(at, at[:, None])) + 0.5).clamp(0.0, 1.0)
        mixed = torch.lerp(alpha, 1.0 - alpha, torch.nn.functional.interpolate(spots, (n, n))[0, 0])
        front, behind = torch.tensor([0.6, 0.3, 0.1]), torch.tensor([0.1, 0.2, 0.4])
        image = torch.lerp(behind, front, smoothed(mixed[None], 0.7)[0, ..., None])
        view = eg.Camera.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), size=(n, n))
        regions = RegionLoss(region_views(views_of(view, image)), 0)
        regions.renew(0, alpha[..., None])
        found.append(regions.edge_support([alpha[..., None]]))
    assert found[1] == pytest.approx(found[0], abs=0.01) and 0.3 < found[0] < 0.9, found


def test_edge_support_is_low_without_the_object():
    fit = fit_scene(
        vase(RADII), clutter(96, 3), VIEW, {"pose": PoseParameter()}, options=quiet(loss="region", spp=4, steps=30)
    )
    assert not fit.converged and fit.explained < 0.5


def test_plot_draws_contours_into_the_picture(taken):
    fit = fit_scene(vase(RADII), taken, VIEW, {"pose": PoseParameter()}, options=quiet(loss="region", spp=4, steps=2))
    assert fit.render().shape == (96, 96, 1) and len(fit.plot().axes) == 3  # target, start, fit; no difference


MESH = vase(RADII).replace(colors=torch.full((6 * AROUND, 3), 0.5))
FIRST = {"pose": PoseParameter()}


@pytest.mark.parametrize(
    ("scene", "given", "error", "message"),
    [
        (MESH, {"images": None, "masks": torch.ones(96, 96)}, ValueError, r"masks: expected none with loss=\"region\""),
        (MESH, {"masks": torch.ones(96, 96)}, ValueError, r"masks: expected none with loss=\"region\".*leave out the masks"),
        (MESH, {"parameters": {"colors": 0.01}}, ValueError, r"parameters: expected what moves the outline.*'colors'"),
        (MESH, {"mask_loss": "region"}, ValueError, r"mask_loss: expected one of l1, l2, huber, robust, iou, or"),
        (MESH, {"loss": "regions"}, ValueError, r"loss: expected one of l1, .*iou, region, or a function, got 'regions'"),
        (MESH.transformed(t=torch.tensor([0.0, 0.0, -90.0])), {}, ValueError, r"scene: expected an object that the pict"),
        (MESH, {"images": torch.zeros(96, 96, 3)}, ValueError, r"images: expected the object before .*one colour alone"),
        (MESH.transformed(scale=9.0), {}, ValueError, r"scene: .* that fills picture 0 at the start; leave out ground and walls"),
    ],
)  # fmt: skip
def test_errors_name_the_argument(taken, scene, given, error, message):
    whole = {"images": taken, "parameters": FIRST, "loss": "region", "progress": False, **given}
    with pytest.raises(error, match=message):
        fit_scene(scene, cameras=VIEW, **arranged(**whole))


def test_other_fits_refuse_the_region_loss(taken):
    with pytest.raises(ValueError, match=r"loss: expected .* got 'region'"):
        fit_texture(
            MESH.replace(uvs=torch.rand(6 * AROUND, 2), uv_faces=MESH.faces, colors=None), taken, VIEW, 8,
            options=quiet(loss="region"),
        )  # fmt: skip
    with pytest.raises(ValueError, match=r"depths: expected none with loss=\"region\""):
        fit_shape(
            MESH, taken, VIEW, depths=torch.ones(96, 96), refinement=Refinement(levels=1), options=quiet(loss="region")
        )
