"""Measured depths, normals and positions in fits: how they are compared, and what they find that masks do not."""

import math

import pytest
import torch
from messages import T, V, check_message
from quiet_fits import arranged, quiet
from small_scenes import QUIET, ball, egg_views

import edgegrad as eg
from edgegrad.fit import Measured, Refinement, fit_shape
from edgegrad.fit.measured import measured_loss, measurements
from edgegrad.fit.views import views_of

CAMERA = eg.Camera.look_at((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), fov_y=40.0, size=(4, 6))
nan = math.nan


def one(name, value, **trust):
    (found,) = measurements({name: Measured(value, **trust)}, [CAMERA])
    return next(iter(found.values()))


# -- what is compared -------------------------------------------------------------------------------------------------


def test_what_was_not_measured_does_not_count():
    depth = torch.full((4, 6), 3.0)
    depth[0] = torch.tensor([nan, 0.0, math.inf, -math.inf, 3.0, 3.0])
    weights = torch.ones(4, 6)
    weights[1, :2] = 0.0
    given = one("depths", depth, weights=weights, scale=0.1)
    assert given.weight[..., 0].sum() == 24 - 4 - 2 and bool(given.value.isfinite().all())
    render = torch.full((1, 4, 6, 1), 3.0)
    render[:, 0, :4] = 9.0
    render[:, 1, :2] = 9.0
    assert float(measured_loss(render, torch.ones_like(render), [given], covers=False)) == 0.0
    render[:, 2, 3] += 0.1  # one pixel, by the scale: 2x² / (x² + 4) = 0.4
    assert float(measured_loss(render, torch.ones_like(render), [given], covers=False)) == pytest.approx(
        0.4 / 24, rel=1e-5
    )
    doubled = one("depths", depth, weights=2.0 * weights, scale=0.1, factor=3.0)
    assert float(measured_loss(render, torch.ones_like(render), [doubled], False)) == pytest.approx(2.4 / 24, rel=1e-5)


def test_pixels_that_are_covered_in_part_compare_their_own_share():
    """render_aovs() gives depth · alpha; where that share lies as far as was measured, nothing is to be done."""
    alpha = torch.linspace(0.0, 1.0, 24).reshape(1, 4, 6, 1)
    given = one("depths", torch.full((4, 6, 1), 3.0), scale=0.1)
    assert float(measured_loss(3.0 * alpha, alpha, [given], covers=False)) == pytest.approx(0.0, abs=1e-12)
    assert float(measured_loss(3.05 * alpha, alpha, [given], covers=False)) > 0.01
    covers = float(measured_loss(3.0 * alpha, alpha, [given], covers=True))
    assert covers == pytest.approx(float((1.0 - alpha).square().mean()))  # all pixels around were measured
    holes = one("depths", torch.full((4, 6, 1), 3.0) * (torch.arange(6) % 2)[:, None], scale=0.1)
    assert float(measured_loss(3.0 * alpha, alpha, [holes], covers=True)) == pytest.approx(0.0, abs=1e-12)


def test_outliers_level_off_once_most_fits():
    given = one("depths", torch.full((4, 6), 3.0), scale=0.01)
    far = torch.full((1, 4, 6, 1), 3.5, requires_grad=True)
    measured_loss(far, torch.ones(1, 4, 6, 1), [given], covers=False).backward()
    assert float(far.grad.min()) > 0.2 / 24 / 0.01  # a shape that is far away as a whole is drawn near
    near = torch.full((1, 4, 6, 1), 3.005)
    near[0, 0, 0] = 3.5
    near.requires_grad_()
    measured_loss(near, torch.ones(1, 4, 6, 1), [given], covers=False).backward()
    assert float(near.grad[0, 0, 0]) < 1e-3 * float(near.grad[0, 1, 1])


def test_masks_take_out_mixed_pixels_and_what_is_not_the_object():
    depth = torch.full((4, 6), 3.0)
    mask = torch.ones(4, 6)
    mask[0], mask[1] = 0.0, 0.5
    (view,) = views_of(CAMERA, None, mask, None, {"depths": depth})
    assert view.aovs == ["alpha", "depth"] and view.measured["depth"].weight[..., 0].sum(1).tolist() == [0, 0, 6, 6]
    (view,) = views_of(CAMERA, None, None, None, {"depths": depth})
    assert view.aovs == ["depth", "alpha"] and not view.wanted


def test_smaller_pictures_are_means_of_what_was_measured():
    depth = torch.full((4, 6), nan)
    depth[0, 0], depth[0, 1], depth[1, 0] = 2.0, 3.0, 4.0  # of four; the other pixels have none or one
    depth[2, 2] = 5.0
    given = one("depths", depth).resized((2, 3))
    assert given.value[..., 0].tolist() == [[3.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    assert given.scale == pytest.approx(2.0 * one("depths", depth).scale)
    assert one("depths", depth, scale=0.5).resized((2, 3)).scale == 0.5
    up = torch.tensor([0.0, 0.0, 1.0]).expand(4, 6, 3)
    assert one("normals", up).resized((2, 3)).scale == one("normals", up).scale == 0.1


def test_the_scale_is_what_a_pixel_covers():
    pixel = 3.0 * 2.0 * math.tan(math.radians(20.0)) / 4
    assert one("depths", torch.full((4, 6), 3.0)).scale == pytest.approx(pixel, rel=1e-5)
    flat = eg.Camera.orthographic((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), height=2.0, size=(4, 6))
    (found,) = measurements({"depths": torch.full((4, 6), 3.0)}, [flat])
    assert found["depth"].scale == pytest.approx(0.5)
    (found,) = measurements({"positions": torch.tensor([0.0, 0.0, 1.0]).expand(4, 6, 3)}, [CAMERA])
    assert found["position"].scale == pytest.approx(pixel, rel=1e-5)


GOOD = torch.full((4, 6), 3.0)


@pytest.mark.parametrize(
    ("given", "error", "parts"),
    [
        ({"depths": GOOD[:2]}, V, ["depths: expected shape (4, 6, 1) or (4, 6)", "camera.resized"]),
        ({"depths": GOOD.long()}, T, ["depths: expected floating-point numbers, got torch.int64; of a sensor's"]),
        ({"depths": -GOOD}, V, ["depths: expected depths along", "from 0 up, got -3; OpenGL's"]),
        ({"depths": GOOD * nan}, V, ["depths: expected a pixel that was measured, got none"]),
        ({"depths": [GOOD, GOOD]}, V, ["depths: expected 1, one for each camera, got 2"]),
        ({"depths": Measured(GOOD, weights=-GOOD)}, V, ["weights of depths: expected finite numbers from 0 up"]),
        ({"depths": Measured([None], weights=GOOD)}, V, ["depths: expected a picture with its weights, got None"]),
        ({"normals": GOOD}, V, ["normals: expected shape (4, 6, 3)"]),
        ({"normals": torch.full((4, 6, 3), 128.0)}, V, ["normals: expected vectors of length 1", "x / 127.5 − 1"]),
        ({"positions": GOOD[..., None]}, V, ["positions: expected shape (4, 6, 3)"]),
    ],
)
def test_errors_name_the_argument(given, error, parts):
    check_message(
        lambda: fit_shape(ball(1), None, CAMERA, refinement=Refinement(1), **arranged(**given)), error, *parts
    )


def test_errors_of_weights_and_of_views_without_pictures():
    with pytest.raises(ValueError, match="scale: expected a number from"):
        Measured(GOOD, scale=0.0)
    with pytest.raises(ValueError, match="factor: expected a number from"):
        Measured(GOOD, factor=-1.0)
    with pytest.raises(ValueError, match=r"images: expected pictures or masks .* got neither for cameras\[1\]"):
        fit_shape(ball(1), None, [CAMERA, CAMERA], depths=[GOOD, None], refinement=Refinement(1), options=quiet())


# -- what they find ---------------------------------------------------------------------------------------------------


def radius(direction):
    """Return the radius (V,) of a ball with a dent that no silhouette shows."""
    x, y, z = direction.unbind(1)
    return 1.0 - 0.4 * torch.exp(-((x - 0.3) ** 2 + y**2) / 0.12) * (z > 0)


EYES = torch.tensor([[0.6, 0.3, 4.0], [3.5, 1.5, 2.0], [-3.5, 1.0, 2.0], [0.5, -3.5, -2.0], [0.2, 3.0, -3.0]])


def seen(size=40):
    mesh = ball(4)
    mesh = mesh.replace(verts=mesh.verts * radius(mesh.verts)[:, None])
    cameras = [eg.Camera.look_at(eye, (0, 0, 0), (0.1, 0.9, 0.3), fov_y=35.0, size=(size, size)) for eye in EYES]
    names = ["alpha", "depth", "shading_normal", "position"]
    return cameras, [eg.render_aovs(mesh, c, names, spp=64, seed=5 + k) for k, c in enumerate(cameras)]


def error(found):
    """Return the mean distance of vertices in the dent from the surface, along their rays from the middle."""
    far = found.verts.norm(dim=1)
    true = radius(found.verts / far[:, None])
    return float((far - true)[true < 0.9].abs().mean())


def covered(views, name):
    """Keep what a sensor measures: nothing where the object does not fill the pixel."""
    return [torch.where(v["alpha"] > 0.999, v[name], nan) for v in views]


@pytest.fixture(scope="module")
def dent():
    pytest.importorskip("gpytoolbox")
    return seen()


OPTIONS = {"refinement": Refinement(2, 1600), "steps": 60, **QUIET}


@pytest.mark.slow
def test_depths_find_a_dent_that_masks_do_not_show(dent):
    cameras, views = dent
    masks = [v["alpha"] for v in views]
    start = ball(2).replace(verts=1.15 * ball(2).verts)
    assert error(start) > 0.2
    kinds = {"depths": covered(views, "depth"), "normals": covered(views, "shading_normal")}
    depths, normals = (
        error(fit_shape(start, None, cameras, masks=masks, **arranged(**{name: given}, **OPTIONS)).mesh)
        for name, given in kinds.items()
    )
    assert depths < 0.03 and normals < 0.03, (depths, normals)  # of a dent 0.4 deep; by masks alone 0.07


@pytest.mark.slow
def test_a_sensor_with_holes_noise_and_mixed_pixels(dent):
    """The fit has only its pictures: positions in five views, two of them given as depths."""
    cameras, views = dent
    g = torch.Generator().manual_seed(0)
    depths, positions = [], []
    for k, (camera, v) in enumerate(zip(cameras, views, strict=True)):
        depth = v["depth"] + (1.0 - v["alpha"]) * 8.0  # before a wall: pixels at the contour are between
        depth = depth + 0.01 * torch.randn(depth.shape, generator=g)
        depth[v["alpha"] < 0.02] = 0.0
        depth[torch.rand(depth.shape, generator=g) < 0.1] = nan
        y, x = torch.meshgrid(*(torch.arange(n) + 0.5 for n in camera.size), indexing="ij")
        rays = torch.stack([x, y, torch.ones_like(x)], -1) @ torch.linalg.inv(camera.K).T
        pose = camera.world_to_camera
        there = (rays * depth - pose[:3, 3]) @ pose[:3, :3]
        there[(depth == 0)[..., 0]] = 0.0
        depths.append(depth if k in (1, 3) else None)
        positions.append(None if k in (1, 3) else there)
    start = ball(2).replace(verts=1.15 * ball(2).verts)
    found = error(fit_shape(start, None, cameras, depths=depths, positions=positions, **arranged(**OPTIONS)).mesh)
    assert found < 0.04, found


def test_views_that_have_only_some_of_it(dent, tmp_path):
    """A sensor next to the camera is a camera of its own. Checkpoints hold what was measured."""
    cameras, views = dent
    masks = [views[0]["alpha"], None, *(v["alpha"] for v in views[2:])]
    depths = [None, *covered(views, "depth")[1:3], None, None]
    normals = [covered(views, "shading_normal")[0], None, None, None, None]
    given = {"masks": masks, "depths": depths, "normals": Measured(normals, factor=0.5)}
    options = {"refinement": Refinement(1), "steps": 4, "checkpoint": tmp_path / "fit.pt", **QUIET}
    fit = fit_shape(ball(2), None, cameras, **arranged(**given, **options))
    assert [view.aovs for view in fit.views] == [
        ["alpha", "shading_normal"], ["depth", "alpha"], ["alpha", "depth"], ["alpha"], ["alpha"],
    ]  # fmt: skip
    assert fit.loss > 0.0 and 0.0 < fit.explained <= 1.0
    assert fit.render(1).shape == (40, 40, 1) and float(fit.render(1).max()) > 2.0
    pytest.importorskip("matplotlib")
    assert "fit.png" in fit.save(tmp_path)
    options["resume"] = True
    again = fit_shape(ball(2), None, cameras, **arranged(**given, **options))
    assert again.steps == 4 and torch.equal(again.mesh.verts, fit.mesh.verts)
    with pytest.raises(ValueError, match=r"made with another measured;"):
        fit_shape(
            ball(2), None, cameras, **arranged(**{**given, "depths": [None, depths[1], None, None, None]}, **options)
        )


def test_without_pictures_of_depth_nothing_changes():
    cameras, masks = egg_views()
    one, other = (
        fit_shape(
            ball(1), None, cameras, masks=masks, refinement=Refinement(levels=1), **arranged(steps=3, **QUIET, **more)
        )
        for more in ({}, {"depths": None, "normals": None, "positions": None})
    )
    assert torch.equal(one.mesh.verts, other.mesh.verts)
