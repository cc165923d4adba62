"""fit_pose and fit_camera where pictures are not as they should be: covered, cluttered, of something else, from several sides."""

import io
import json
import math
import warnings

import numpy as np
import pytest
import torch
from PIL import Image
from test_fit import BACKGROUND, START, about_center, bracket, camera, errors, picture, rotation, silhouette

import edgegrad as eg
from edgegrad.files.image import linear_to_srgb, srgb_to_linear
from edgegrad.fit import fit_camera, fit_pose, fit_scene, fit_texture
from edgegrad.fit.pose import color_search
from edgegrad.fit.pose.blur_estimate import estimate_blur
from edgegrad.fit.pose.inputs import ArgumentNames
from edgegrad.fit.pose.pose import pose_from_matrix
from edgegrad.fit.pose.robust_loss import Comparison
from edgegrad.fit.pose.target_images import blurred, is_clutter
from edgegrad.fit.pose.task import STEP_PARTS, PoseTask, Unknowns
from edgegrad.fit.views import over_black


def covered(view, image):
    """The left third of the bracket behind a white board."""
    seen = torch.nonzero(silhouette(view)[..., 0] > 0.5)[:, 1].sort().values
    edge = int(seen[len(seen) // 4])
    cover = torch.zeros(*view.size, 1)
    cover[:, : edge + 1] = 1.0
    return cover + (1.0 - cover) * image, 1.0 - cover


@pytest.mark.parametrize(("how", "steps"), [("alone", 12), pytest.param("weight", 40, marks=pytest.mark.slow)])
def test_a_quarter_covered(how, steps):
    view = camera(64)
    image, free = covered(view, picture(view))
    told = {"background": BACKGROUND}
    if how == "weight":
        told["weight"] = free
    fit = fit_pose(bracket(), image, view, init=START, steps=steps, progress=False, **told)
    degrees, percent = errors(fit)
    assert degrees < 1.0 and percent < 1.0, (degrees, percent)
    assert fit.converged and fit.explained > 0.5


@pytest.mark.parametrize("looks", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_wrong_place_nearby_is_left_for_a_better_one(looks, monkeypatch):
    """Where something covers the object, as a board does, turned poses are looked at."""
    view = camera(64)
    image, _ = covered(view, picture(view))
    down, aside = color_search.ColorSearch._down, []

    def ends_aside(self, pose, levels):
        if aside:
            return down(self, pose, levels)
        aside.append(self.task.moved(pose_from_matrix("", torch.eye(4)), [0], torch.tensor([0.12]).double()))
        return aside[0], True

    monkeypatch.setattr(color_search.ColorSearch, "_down", ends_aside)
    monkeypatch.setattr(color_search, "MIN_EDGE_SUPPORT", 0.0)  # all ends are taken for right
    if not looks:
        monkeypatch.setattr(color_search, "MIN_BLOCK_ERROR", math.inf)
    fit = fit_pose(bracket(), image, view, init=START, background=BACKGROUND, steps=24, progress=False)
    assert (errors(fit)[0] < 1.0) == looks and fit.converged
    assert torch.equal([step for step in fit.history if step.best][-1].pose.matrix, fit.matrix)


def compressed(image, quality):
    """Through a JPEG file."""
    file = io.BytesIO()
    Image.fromarray((255.0 * linear_to_srgb(image.clamp(0, 1))).round().byte().numpy()).save(
        file, "JPEG", quality=quality
    )
    return srgb_to_linear(torch.from_numpy(np.array(Image.open(file))).float() / 255.0)


WORN = {
    "sharp": lambda image: image,
    "soft": lambda image: blurred(image, 1.0),
    "compressed": lambda image: compressed(image, 85),
    "both": lambda image: compressed(blurred(image, 0.7), 70),
}


@pytest.mark.parametrize("kind", ["sharp", "soft", pytest.param("compressed", marks=pytest.mark.slow), "both"])
def test_blur_and_compression_cost_no_second_search(kind):
    """One way down is enough, and ends as near."""
    view = camera(80)
    fit = fit_pose(bracket(), WORN[kind](picture(view)), view, init=START, background=BACKGROUND, progress=False)
    degrees, percent = errors(fit)
    limit = 0.15 if kind in ("sharp", "soft") else 1.0  # without the blur of renders: 0.5 for soft
    shown = 0.9 if kind in ("sharp", "soft") else 0.75  # what compression makes stronger is not the render's
    assert degrees < limit and percent < limit and fit.converged and fit.explained > shown, (degrees, percent)
    sizes = [step.size for step in fit.history]
    assert sizes == sorted(sizes) and fit.steps < 60  # a second search begins at a coarse level again


def test_the_softness_of_a_picture():
    view = camera(64)
    for sigma in (0.0, 0.6, 1.0):
        task = PoseTask.from_arguments(
            bracket(), blurred(picture(view), sigma), view, None, None, BACKGROUND, Unknowns(), 1.0, ArgumentNames()
        )
        pose = pose_from_matrix("", torch.eye(4))
        level = task.level(1.0, 0.0, 1.0, 64, task.dofs)
        renders = [task.images(level, pose, 64, seed) for seed in (0, 1)]
        assert estimate_blur(task, level, *renders) == pytest.approx(sigma, abs=0.1)


def lit():
    """The bracket under a sun and a sky; for each face by its normal."""
    mesh = bracket()
    a, b, c = (mesh.verts[mesh.faces[:, corner]] for corner in range(3))
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
    sun = torch.nn.functional.normalize(torch.tensor([-1.0, 0.8, 0.0]).double(), dim=0)
    sky = torch.tensor([0.35, 0.45, 0.6]).double() * (0.6 + 0.4 * normal[:, 1:2])
    light = sky + torch.tensor([1.3, 1.15, 0.9]).double() * (normal @ sun).clamp(min=0)[:, None]
    return mesh.replace(face_colors=(mesh.face_colors * light).float())


@pytest.mark.parametrize("further", [pytest.param(True, marks=pytest.mark.slow), False])
def test_an_unlit_mesh_in_a_lit_picture_stays_near_its_start(further):
    """The loss alone is lowest where the object is out of view: 69° and three sizes away."""
    view = camera(64)
    target = picture(view, lit())
    start = about_center(rotation(0.03, -0.03, 0.02), (0.02, 0.01, 0.0))
    fit = fit_pose(bracket(), target, view, init=start, background=BACKGROUND, search=further, progress=False)
    degrees, percent = errors(fit)
    assert degrees < 3.0 and percent < 2.0, (degrees, percent)
    if not further:
        sizes = [step.size for step in fit.history]
        assert sizes == sorted(sizes)


def test_an_answer_shows_as_much_of_the_edges():
    start = color_search.Score(loss=1.0, edge_support=0.5, block_error=0.1, edges=10.0)
    assert start._replace(loss=0.9, edge_support=0.6).beats(start)
    assert not start._replace(loss=1.1, edge_support=0.9).beats(start)
    assert not start._replace(loss=0.9, edge_support=0.4).beats(start)
    assert not start._replace(loss=0.9, edge_support=0.9, edges=5.0).beats(start)  # hardly in view


def test_a_border_of_many_colours_is_clutter():
    view = camera(32)
    clutter = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0))
    assert is_clutter(picture(view, background=clutter)) and not is_clutter(picture(view))


# On few pixels one of hundreds of places is alike by chance, but not known exactly; the last has other starts.
@pytest.mark.parametrize(
    ("size", "steps", "alike"),
    [
        pytest.param(64, 4, 0.6, marks=pytest.mark.slow),
        pytest.param(32, 4, 0.8, marks=pytest.mark.slow),  # quick for photographs, in test_fit_photo.py
        pytest.param(32, 21, 0.8, marks=pytest.mark.slow),
    ],
)
def test_what_is_not_in_the_picture_is_not_found(size, steps, alike):
    """A picture of something else: the fit ends somewhere, and says that the picture does not show it."""
    cells = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    image = torch.nn.functional.interpolate(cells, (size, size), mode="bicubic")[0].movedim(0, -1)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # nor turned over
        fit = fit_pose(bracket(), image, camera(size), background=BACKGROUND, steps=steps, progress=False)
    assert not fit.converged and fit.explained < alike
    assert fit.reason.startswith(("edges not explained: the pictures show", "directions unknown: rotation about"))


@pytest.mark.parametrize("masked", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_picture_from_the_bottom_up_is_named(masked):
    view = camera(32)
    target, mask = picture(view).flip(0), silhouette(view).flip(0) if masked else None
    told = {"mask": mask} if masked else {"background": BACKGROUND}
    with pytest.warns(UserWarning, match=r"^target: expected the upper row first.*image\.flip\(0\)"):
        fit = fit_pose(bracket(), target, view, init=START, progress=False, steps=4, **told)
    assert not fit.converged


def test_masks_from_the_bottom_up_are_named():
    views = [camera(32), camera(32, distance=5.0)]
    masks = [silhouette(view).flip(0) for view in views]
    sought = {"verts": 1e-4}
    options = {"masks": masks, "steps": 2, "spp": 2, "progress": False}
    with pytest.warns(UserWarning, match=r"^masks: expected the upper row first.*IoU of \d+%, as given at \d+%"):
        fit_scene(bracket(), views, None, sought, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        fit_scene(bracket(), views, None, sought, **options | {"masks": [mask.flip(0) for mask in masks]})


def test_several_pictures_share_the_pose():
    """Two views show the scale from the distance, as one cannot."""
    first = camera(48)
    center = torch.tensor([1.0, 0.75, 0.4]).double()
    second = eg.Camera.look_at(center + torch.tensor([4.0, 1.0, 0.5]).double(), center, fov_y=45.0, size=(36, 48))
    larger = bracket().transformed(torch.eye(3).double(), -0.08 * center, 1.08)
    views = [first, second]
    images = [picture(view, larger) for view in views]
    fit = fit_pose(
        bracket(), images, views, init=START, background=BACKGROUND, fit_scale=True, steps=12, progress=False
    )
    assert max(errors(fit)) < 0.5 and fit.scale == pytest.approx(1.08, rel=0.01) and fit.converged
    figure = fit.plot()
    assert len(figure.axes) == 8


@pytest.mark.slow
def test_the_start_is_placed_where_the_picture_shows_the_object():
    view, away = camera(48), torch.tensor([40.0, -30.0, 25.0]).double()
    far = bracket().transformed(t=away)
    mask = silhouette(view)
    fit = fit_pose(far, picture(view), view, mask, steps=12, progress=False)
    where = fit.R @ (torch.tensor([1.0, 0.75, 0.4]).double() + away) + fit.t
    assert float((where - torch.tensor([1.0, 0.75, 0.4]).double()).norm()) < 0.1
    started = fit.history[0].pose
    assert torch.equal(started.R, torch.eye(3, dtype=torch.float64))


@pytest.mark.parametrize("clutter", [False, True])
def test_residuals_have_the_gradient_of_the_loss(clutter):
    """Σ f ∂f is half the derivative of Σ ρ − (1 − (1 − α)²) c²/2 for weights at rest and gains that make it least; here by finite
    differences of the loss, on renders that are functions of one number."""
    view = camera(16)
    background = None if clutter else BACKGROUND
    image = picture(
        view, background=torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(1)) if clutter else BACKGROUND
    )
    task = PoseTask.from_arguments(
        bracket(), image, view, None, torch.rand(16, 16), background, Unknowns(), 1.0, ArgumentNames()
    )
    assert task.clutter == clutter
    level = task.level(1.0, 0.0, 1.0, 4, task.dofs)
    g = torch.Generator().manual_seed(0)
    with torch.no_grad():
        (base,) = (layer.double() for layer in task.images(level, pose_from_matrix("", torch.eye(4)), 16, 0))
    base, way = (
        base + 0.05 * torch.rand(base.shape, generator=g),
        torch.rand(base.shape, generator=g, dtype=torch.float64),
    )
    c, h = 0.3, 1e-5

    def at(x):
        return Comparison(task, level, [base + x * way])

    x = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (found,) = torch.autograd.grad(sum(0.5 * f.square().sum() for f in at(x).residuals(c)), x)
    weight = level.shots[0].weight
    count = float(weight.sum()) * 3
    assert at(x).count == pytest.approx(count)
    expected = 0.5 * count * (at(h).loss(c)[0] - at(-h).loss(c)[0]) / (2 * h)
    assert float(found) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"camera": []}, ValueError, "camera: expected at least one"),
        (
            {"camera": [camera(8)] * 2},
            ValueError,
            "target: expected 2, one for each camera, got one of shape (8, 8, 3)",
        ),
        (
            {"camera": [camera(8)], "target": [torch.zeros(8, 8, 3)], "mask": [torch.ones(4, 4)]},
            ValueError,
            "mask[0]: expected",
        ),
        (
            {"target": "photo.png"},
            TypeError,
            "target: expected an image (H, W, C) of numbers, got the path 'photo.png'; read",
        ),
        (
            {"target": None},
            TypeError,
            "target: expected an image (H, W, C) of numbers, got None; read one with read_image",
        ),
        ({"weight": -torch.ones(8, 8)}, ValueError, "weight: expected numbers from 0 up"),
        ({"weight": torch.ones(8, 8, 3)}, ValueError, "weight: expected shape (8, 8) or (8, 8, 1)"),
    ],
)
def test_errors_name_the_argument(change, error, message):
    with pytest.raises(error) as caught:
        fit_pose(
            **{"mesh": bracket(), "target": torch.zeros(8, 8, 3), "camera": camera(8), "progress": False, **change}
        )
    assert message in str(caught.value)


def test_a_camera_and_its_focal_length():
    true = camera(96, distance=2.6)
    off = torch.linalg.inv(about_center(rotation(0.05, -0.06, 0.04), (0.04, -0.03, 0.05)))
    K = true.K.clone()
    K[:2, :2] *= 1.1
    start = true.replace(world_to_camera=true.world_to_camera @ off, K=K)
    fit = fit_camera(bracket(), picture(true), start, background=BACKGROUND, steps=16, progress=False)
    found = fit.camera
    assert float(found.K[0, 0] / true.K[0, 0]) == pytest.approx(1.0, abs=0.02)
    assert fit.converged and fit.reason == "converged"
    # Rendered from there, the scene looks like the picture.
    again = eg.render(eg.Scene([bracket()], BACKGROUND), found, spp=64, seed=3)
    assert float((again - picture(true)).square().mean()) < 1e-4
    turned = found.world_to_camera[:3, :3] @ true.world_to_camera[:3, :3].T
    assert math.degrees(math.acos(min(1.0, (float(turned.trace()) - 1.0) / 2.0))) < 1.0


def started_aside(true, zoom=1.0):
    """A camera some degrees and some percent off."""
    off = torch.linalg.inv(about_center(rotation(0.05, -0.06, 0.04), (0.04, -0.03, 0.05)))
    K = true.K.clone()
    K[:2, :2] *= zoom
    return true.replace(world_to_camera=true.world_to_camera @ off, K=K)


def test_the_history_of_a_camera(tmp_path):
    """Loss, gradient and cameras of each step; that of a fit that goes on is the same to the last bit."""
    true = camera(48)
    start = started_aside(true, 1.05)

    def fit(**options):
        told = {"background": BACKGROUND, "steps": 4, "progress": False, **options}
        return fit_camera(bracket(), picture(true), start, **told)

    whole = fit()
    history = whole.history
    assert whole.steps == len(history) == len(whole.search.history) and whole.seconds == whole.search.seconds > 0
    assert [record.step for record in history] == list(range(whole.steps))
    assert set(history[0].values) == {"cameras.0.world_to_camera", "cameras.0.K"}
    for record, one in ((history[0], start), (history[-1], whole.camera)):
        torch.testing.assert_close(record.values["cameras.0.K"], one.K.double())
        torch.testing.assert_close(record.values["cameras.0.world_to_camera"], one.world_to_camera.double())
    assert history[-1].loss == whole.loss < history[0].loss
    # The focal length is not sought on blurred levels, and the last record is no step.
    assert set(history[0].gradient) == {"world_to_camera"} and not history[-1].gradient
    assert any(set(record.gradient) == {"world_to_camera", "K"} for record in history)

    def after_step(fit):
        if fit.steps == 8:
            raise KeyboardInterrupt

    kept = {"checkpoint": tmp_path / "fit.ckpt"}
    assert len(fit(**kept, callback=after_step).history) == 8
    for record, again in zip(history, fit(**kept, resume=True).history, strict=True):
        assert (record.step, record.loss, record.gradient) == (again.step, again.loss, again.gradient)
        assert all(torch.equal(value, again.values[name]) for name, value in record.values.items())


@pytest.mark.parametrize("part", ["rotation", "shift"])
def test_the_gradient_in_the_history(part):
    """That of the loss, by finite differences of renders with the same samples, which leave some percent."""
    true = camera(48)
    fit = fit_camera(
        bracket(), picture(true), started_aside(true), background=BACKGROUND, focal=False, steps=1, spp=64, progress=False
    )  # fmt: skip
    task, first, h = fit.search.task, fit.search.history[0], 2e-3
    assert task is not None
    level = task.pyramid(first.pose, 512, 64)[0]
    assert level.size == first.size

    def loss(entry, step, c=None):
        moved = task.moved(first.pose, [entry], torch.tensor([step], dtype=torch.float64))
        compared = Comparison(task, level, task.images(level, moved, 4096, 0))
        return compared.loss(c or compared.scale())[0], compared.scale()

    c = loss(0, 0.0)[1]
    slopes = [(loss(entry, h, c)[0] - loss(entry, -h, c)[0]) / (2 * h) for entry in STEP_PARTS[part]]
    assert first.gradient[part] == pytest.approx(math.hypot(*slopes), rel=0.05)


def test_a_camera_is_saved(tmp_path):
    view = camera(32)
    fit = fit_camera(bracket(), picture(view), view, background=BACKGROUND, focal=False, steps=2, progress=False)
    names = fit.save(tmp_path)
    assert names == ["camera.json", "history.json", "pose.json", "fit.png", "loss.png", "fit.webp"]
    assert {path.name for path in tmp_path.iterdir()} == set(names) and torch.equal(fit.camera.K, view.K)
    history = json.loads((tmp_path / "history.json").read_text())
    assert [record["loss"] for record in history] == [record.loss for record in fit.history]
    assert history[0]["values"] == {"cameras.0.world_to_camera": view.world_to_camera.tolist()}
    assert {axes.get_ylabel() for axes in fit.plot_history().axes} == {"mean squared difference", "|gradient|"}
    torch.testing.assert_close(eg.load_camera(tmp_path / "camera.json").K.double(), view.K.double())


def test_pictures_and_masks_of_bytes_are_named():
    view = camera(16)
    image = picture(view)
    bytes_ = (255 * image / image.max()).round()
    with pytest.warns(UserWarning, match=r"target: expected linear radiance.*whole numbers up to 255.*srgb_to_linear"):
        fit_pose(bracket(), bytes_, view, silhouette(view), init=START, steps=1, search=False, progress=False)
    resized = 40.0 + 0.7 * bytes_  # no whole numbers any more
    with pytest.warns(
        UserWarning, match=r"target: expected linear radiance.*got numbers up to 218.*srgb_to_linear\(x / 255"
    ):
        fit_pose(bracket(), resized, view, silhouette(view), init=START, steps=1, search=False, progress=False)
    with pytest.raises(
        ValueError, match=r"mask: expected numbers from 0 to 1, got 0 to 255; of 8-bit numbers take x / 255"
    ):
        fit_pose(bracket(), image, view, 255.0 * torch.eye(16), progress=False)
    with pytest.raises(ValueError, match=r"masks\[0\]: expected numbers from 0 to 1"):
        masks = [255.0 * torch.eye(16)]
        fit_scene(bracket(), [view], None, {"meshes[0].verts": 0.01}, masks=masks, progress=False)


def test_alpha_is_no_colour_of_a_picture():
    """It would show nothing of what surrounds the object, or more than a photograph knows."""
    view = camera(16)
    image = torch.cat([picture(view), silhouette(view)[..., None].reshape(16, 16, 1)], -1)
    words = (
        r"expected grey or colours, got 4 channels.*read_image\(path, channels=3\), or, .* x\[\.\.\., -1:\] as its mask"
    )
    with pytest.raises(ValueError, match="target: " + words):
        fit_pose(bracket(plain=True), image, view, progress=False)
    with pytest.raises(ValueError, match="images: " + words):
        fit_scene(bracket(plain=True), view, image, {"verts": 0.01}, loss="region", progress=False)


def test_faint_masks_are_named():
    def stop(_):
        raise KeyboardInterrupt

    view, other = camera(16), camera(16, distance=2.6)
    mask, options = silhouette(view), {"callback": stop, "progress": False}
    with pytest.warns(
        UserWarning, match=r"mask: expected 1 where the object covers .* got at most 0\.216; .* read_mask"
    ):
        fit_pose(bracket(), picture(view), view, 0.216 * mask, init=START, **options)
    what = {"verts": 0.01}
    with pytest.warns(UserWarning, match=r"masks: expected 1 where the object covers .* got at most 0\.00392"):
        fit_scene(bracket(), view, None, what, masks=mask / 255, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # In one of two views the object is hardly seen.
        fit_scene(bracket(), [view, other], None, what, masks=[mask, 0.1 * silhouette(other)], **options)


@pytest.mark.slow
def test_a_rig_of_cameras(tmp_path):
    """Two cameras that keep their places to one another find where they are, and the lens that they share."""
    left = camera(64, distance=2.6)
    apart = about_center(rotation(0.0, 0.5, 0.0))
    true = [left, left.replace(world_to_camera=left.world_to_camera @ apart)]
    off = torch.linalg.inv(about_center(rotation(0.05, -0.06, 0.04), (0.04, -0.03, 0.05)))
    wide = torch.diag(torch.tensor([1.05, 1.05, 1.0], dtype=torch.float64))
    start = [
        one.replace(world_to_camera=one.world_to_camera @ off, K=(wide @ one.K.double()).to(one.K)) for one in true
    ]
    for one, was in zip(start, true, strict=True):
        one.K[:2, 2] = was.K[:2, 2]
    fit = fit_camera(bracket(), [picture(one) for one in true], start, background=BACKGROUND, progress=False)
    assert fit.converged and len(fit.cameras) == 2 and fit.camera is fit.cameras[0]
    for found, one in zip(fit.cameras, true, strict=True):
        assert float(found.K[0, 0] / one.K[0, 0]) == pytest.approx(1.0, abs=0.01)
        assert float((found.eye - one.eye).norm()) < 0.02 * 2.6
    names = fit.save(tmp_path)
    assert {"camera-0.json", "camera-1.json"} < set(names) and "camera.json" not in names
    eye = eg.load_camera(tmp_path / "camera-1.json").eye
    torch.testing.assert_close(eye.double(), fit.cameras[1].eye.double(), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"camera": 3}, "camera: expected a Camera"),
        ({"camera": []}, "camera: expected at least one"),
        ({"camera": [camera(8), camera(8)]}, "image: expected 2, one for each camera"),
        ({"distortion": 9}, "distortion: expected at most 8 for a camera that is perspective"),
        ({"focal": 1}, "focal: expected True or False"),
        ({"image": None}, "image: expected a picture, or a mask"),
        ({"image": torch.zeros(8, 9, 3)}, "image: expected "),
        ({"image": torch.ones(8, 8, 3)}, "image: expected "),
        ({"image": None, "mask": torch.zeros(9, 8)}, "mask: expected "),
        ({"scene": 3}, "scene: expected a Mesh or a Scene"),
    ],
)
def test_errors_of_fit_camera(change, message):
    arguments = {"scene": bracket(), "image": torch.zeros(8, 8, 3), "camera": camera(8), "progress": False, **change}
    with pytest.raises((TypeError, ValueError)) as caught:
        fit_camera(**arguments)
    assert message in str(caught.value)


# -- soft masks -------------------------------------------------------------------------------------------------------


def of_object(kind, image, alpha):
    """A picture whose pixels at the object's border hold its colour times alpha, as it is, or mixed with what lies behind."""
    if kind == "straight":
        return torch.where(alpha > 0.0, image / alpha.clamp(min=1e-6), 0.0)
    return image + (1.0 - alpha) * {"before black": 0.0, "photograph": 0.9}[kind]


@pytest.mark.parametrize(
    "kind", ["straight", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("before black", "photograph"))]
)
def test_what_a_picture_holds_at_a_soft_mask_does_not_matter(kind):
    view = camera(64)
    seen = eg.render_aovs(bracket(), view, ["image", "alpha"], spp=256, seed=1 << 40)
    image = of_object(kind, seen["image"], seen["alpha"])
    fit = fit_pose(bracket(), image, view, seen["alpha"], START, spp=128, progress=False)
    degrees, percent = errors(fit)
    assert degrees < 0.08 and percent < 0.15, (degrees, percent)  # mostly 0.02 and 0.01; a hard mask: 0.7 and 0.8


def test_the_object_over_black():
    mask = torch.tensor([0.0, 0.0, 0.3, 0.6, 1.0, 1.0, 1.0, 0.5])[None, :, None]
    inside = torch.tensor([9.0, 9.0, 9.0, 9.0, 2.0, 3.0, 4.0, 9.0])[None, :, None]
    image, sure = over_black(inside, mask)
    torch.testing.assert_close(image.flatten(), torch.tensor([0.0, 0.0, 0.6, 1.2, 2.0, 3.0, 4.0, 2.0]))
    assert sure.flatten().tolist() == [1, 1, 0, 0, 1, 1, 1, 0]
    for same in (mask.round(), 0.5 * mask):  # nothing between, nothing full
        image, sure = over_black(inside, same)
        assert torch.equal(image, inside * same) and sure is None


@pytest.mark.parametrize("kind", ["before black", "straight", "photograph"])
def test_a_texture_under_a_soft_mask(kind):
    """A square of one colour: at its border, the texture is that colour too."""
    uvs = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    square = eg.Mesh(torch.cat([2.0 * uvs - 1.0, torch.zeros(4, 1)], 1), torch.tensor([[0, 1, 2], [0, 2, 3]]))
    square = square.replace(uvs=uvs, uv_faces=square.faces)
    view = eg.Camera.look_at((0.3, 0.2, 3.0), (0, 0, 0), size=(32, 32))
    colour = torch.tensor([0.8, 0.5, 0.2])
    seen = eg.render_aovs(square.replace(texture=colour.expand(8, 8, 3)), view, ["image", "alpha"], spp=256, seed=9)
    image = of_object(kind, seen["image"], seen["alpha"])
    options = {"steps": 80, "spp": 8, "progress": False}
    fit = fit_texture(square, view, image, 8, masks=seen["alpha"], **options)
    torch.testing.assert_close(fit.mesh.texture, colour.expand(8, 8, 3), atol=0.03, rtol=0)
