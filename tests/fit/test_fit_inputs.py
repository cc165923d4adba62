"""Arguments of pose searches: arrays of any kind that work, and errors and warnings that name what is wrong with the others."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch
from brackets import START, about_center, bracket, camera, picture, rotation, silhouette
from photographs import coverage, depth_of, photograph
from quiet_fits import arranged, quiet

import edgegrad as eg
from edgegrad.fit import FitOptions, fit_camera, fit_pose, fit_poses, fit_scene, fit_texture, track
from edgegrad.fit.options import DESCENT_OPTIONS, POSE_OPTIONS, UNUSED, Settings
from edgegrad.fit.pose.fit_poses import _masks
from edgegrad.fit.pose.inputs import warn_of_units
from edgegrad.fit.pose.settings import POSE
from edgegrad.fit.views import views_of

SIZE = 48
QUICK = {"init": START, "search": False, "progress": False, "steps": 1, "spp": 2, "max_size": 24}


@pytest.fixture(scope="module")
def taken():
    view = camera(SIZE)
    return view, photograph(view)


def one_pixel(value=1.0):
    mask = torch.zeros(SIZE, SIZE)
    mask[20, 20] = value
    return mask


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"weights": torch.zeros(SIZE, SIZE)}, r"weights: expected numbers above 0 somewhere, got zero"),
        ({"masks": one_pixel()}, r"masks: expected the object in 10 pixels or more, got it in 1;"),
        ({"masks": one_pixel(), "init": None}, r"masks: expected the object in 10 pixels"),
        ({"max_size": 1}, r"max_size: expected an int from 8 "),
    ],
)
def test_what_shows_nothing_is_named(taken, given, message):
    view, image = taken
    with pytest.raises(ValueError, match=message):
        fit_pose(bracket(), image, view, **arranged(**{**QUICK, **given}))
    if "masks" in given:
        given = {**given, "masks": given["masks"].int()}
    with pytest.raises(ValueError, match=message.replace("masks:", r"masks\[0\]:")):
        fit_poses([bracket()], image, view, **arranged(**{**QUICK, **given, "init": [START]}))


@pytest.mark.parametrize("side", [1, 3, 7])
@pytest.mark.parametrize("plain", [False, True])
def test_a_tiny_picture_is_named(side, plain):
    picture = torch.rand(side, side, 3, generator=torch.Generator().manual_seed(0))
    message = rf"{{}}: expected a picture of 8 × 8 pixels or more, got {side} × {side}"
    with pytest.raises(ValueError, match=message.format("images")):
        fit_pose(bracket(plain), picture, camera(side), **arranged(**QUICK))
    with pytest.raises(ValueError, match=message.format("images")):
        fit_camera(bracket(plain), picture, camera(side), options=quiet())


def test_arrays_of_numpy_and_single_pictures_of_a_list(taken):
    """Labels and masks as tensors, as arrays and as lists of one all come to a mask for each mesh and camera."""
    view, _ = taken
    labels = (torch.arange(SIZE) // 20).expand(SIZE, SIZE)
    masks = [(labels == 1).float(), (labels == 2).float()]
    one, several = labels.numpy(), [view]
    for mask, cameras in (
        (labels, view), (one, view), (one.astype(np.uint16), view), (masks, view), ([m.numpy() for m in masks], view),
        (labels, several), (one, several), (one[..., None], several), ([one.astype(np.uint8)], several), (one[None], several),
        (masks, several), ([[m] for m in masks], several), ([m[None].numpy() for m in masks], several),
    ):  # fmt: skip
        for own, expected in zip(_masks(mask, 2, [view]), masks, strict=True):
            (found,) = views_of(cameras, torch.zeros(SIZE, SIZE, 3), own)
            assert torch.equal(found.mask[..., 0], expected), (type(mask), cameras)
    for target in (torch.zeros(SIZE, SIZE, 3), np.zeros((1, SIZE, SIZE, 3)), [np.zeros((SIZE, SIZE, 3))]):
        assert views_of([view], target)[0].image.shape == (SIZE, SIZE, 3)


def test_poses_to_start_from_may_be_an_array(taken):
    view, image = taken
    labels = (coverage(view)[..., 0] > 0.5).numpy().astype(np.int32)
    (fit,) = fit_poses([bracket()], image, view, labels, **arranged(**{**QUICK, "init": START[None].numpy()}))
    assert fit.steps > 0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"masks": torch.ones(9, 9).int()}, r"masks: expected shape \(48, 48\) .*, got \(9, 9\); an image of labels"),
        ({"masks": np.ones((9, 9), int)}, r"masks: expected shape \(48, 48\) .*, got \(9, 9\)"),
        ({"masks": np.ones((SIZE, SIZE))}, r"masks: expected an image of labels, of integers.*float64"),
        ({"init": START}, r"init: expected a list with one for each mesh, got Tensor; give \[init\]"),
    ],
)
def test_errors_of_labels(taken, given, message):
    view, image = taken
    with pytest.raises((TypeError, ValueError), match=message):
        fit_poses([bracket()], image, view, **arranged(**{**QUICK, "init": [START], **given}))


def test_one_picture_for_two_cameras(taken):
    view, image = taken
    with pytest.raises(ValueError, match=r"images: expected 2, one for each camera, got 1 in shape \(48, 48, 3\)"):
        fit_pose(bracket(), image, [view, view], **arranged(**QUICK))
    mask = coverage(view)[..., 0]
    for given in (mask, [mask]):
        with pytest.raises(ValueError, match=r"masks.*: expected 2, one for each camera, got 1"):
            fit_poses([bracket()], [image] * 2, [view] * 2, given, **arranged(**{**QUICK, "init": [START]}))


def test_units_of_depth(taken):
    view, _ = taken
    depth, scene = depth_of(view)[..., 0], eg.Scene([bracket()])
    depth[depth == 0.0] = torch.nan
    for factor, scale in ((1e-3, r"1e\+03"), (10.0, r"0\.1"), (6.56, r"0\.15")):
        with pytest.warns(UserWarning, match=rf"depths: expected distances in world units.* multiply it by {scale}"):
            warn_of_units(scene, [view], [factor * depth], "at the start")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for given in (depth, 1.5 * depth, None, torch.full_like(depth, torch.nan)):
            warn_of_units(scene, [view], [given], "at the start")


@pytest.mark.parametrize("fit", [fit_pose, fit_poses, track])
def test_depth_in_other_units_is_warned_of(taken, fit):
    view, image = taken
    depth = 1000.0 * depth_of(view)[..., 0]
    with pytest.warns(UserWarning, match=r"depths: expected .* multiply it by 0\.001"):
        if fit is track:
            next(track(bracket(), [image], view, START, depths=[depth], options=FitOptions(seed=0)))
        elif fit is fit_poses:
            fit_poses([bracket()], image, view, depths=depth, **arranged(**{**QUICK, "init": [START]}))
        else:
            fit_pose(bracket(), image, view, depths=depth, **arranged(**QUICK))


@pytest.mark.parametrize(
    ("along", "message"),
    [(0, "init: expected a pose at which the camera sees the mesh"), (2, "init: expected the object in front of")],
)
def test_a_film_begins_where_the_object_is_seen(taken, along, message):
    view, image = taken
    init = START.clone()
    init[:3, 3] -= 50.0 * view.world_to_camera[along, :3].double()
    with pytest.raises(ValueError, match=message):
        track(bracket(), [image], view, init, options=FitOptions(seed=0))  # at once


def test_what_is_not_explained_is_not_blamed_on_steps(taken):
    """A plain mesh has to show more of its edges than one with colours."""
    view, image = taken
    start = about_center(rotation(0.4, -0.4, 0.3), (0.1, -0.1, 0.1))
    fit = fit_pose(bracket(True), image, view, init=start, search=False, options=quiet(steps=1))
    assert fit.explained < POSE.plain_support and fit.reason != "converged", fit.explained
    assert fit.reason.startswith("edges not explained"), fit.reason


BLANK = torch.zeros(64, 64, 3)


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"mesh": "bracket.obj"}, TypeError, "mesh: expected a Mesh or a Scene, got str"),
        ({"images": torch.zeros(32, 64, 3)}, ValueError, "images: expected shape (64, 64, C), got (32, 64, 3)"),
        ({"images": torch.zeros(64, 64, 4)}, ValueError, "images: expected 3 channels"),
        ({"images": [BLANK] * 2}, ValueError, "images: expected 1, one for each camera, got 2; give as many cameras"),
        ({"images": BLANK}, ValueError, "images: expected a picture of the object, got the same in every"),
        ({"images": BLANK, "masks": torch.ones(64, 64)}, ValueError, "masks: expected a picture of the object"),
        ({"images": torch.full((64, 64, 3), math.nan)}, ValueError, "images: expected finite"),
        ({"images": "photo.png"}, TypeError, "images: expected an image (H, W, C) of numbers, got the path 'photo.png'; read"),
        ({"images": None}, ValueError, "images: expected pictures or masks to compare with, got neither"),
        ({"cameras": np.eye(4)}, TypeError, "cameras: expected a Camera or a sequence of them, got ndarray"),
        ({"cameras": eg.Camera.stack([camera(), camera()])}, ValueError, "images: expected 2, one for each camera"),
        ({"cameras": []}, ValueError, "cameras: expected one for each picture, got an empty list"),
        ({"masks": torch.ones(8, 8)}, ValueError, "masks: expected shape (64, 64) or (64, 64, 1), got (8, 8)"),
        ({"cameras": [camera()], "images": [BLANK], "masks": [torch.ones(4, 4)]}, ValueError, "masks: expected"),
        ({"mesh": eg.Scene([bracket()], torch.ones(9, 9, 3))}, ValueError, "background: expected shape"),
        ({"weights": -torch.ones(64, 64)}, ValueError, "weights: expected numbers from 0 up"),
        ({"weights": torch.ones(64, 64, 3)}, ValueError, "weights: expected shape (64, 64) or (64, 64, 1)"),
        ({"init": torch.eye(3)}, ValueError, "init: expected shape (4, 4), got (3, 3)"),
        ({"init": about_center(torch.eye(3).double(), (20.0, 0.0, -8.0))}, ValueError, "init: expected a pose at which"),
        ({"init": about_center(torch.eye(3).double(), (3.0, 3.0, 9.0))}, ValueError, "init: expected the object in front"),
        ({"steps": 0}, ValueError, "steps: expected an int from 1"),
        ({"spp": 1.5}, TypeError, "spp: expected an int"),
        ({"step_tolerance": 0.0}, ValueError, "step_tolerance: expected a number from 1e-30 to 1, got 0"),
    ],
)  # fmt: skip
def test_errors_name_the_argument(change, error, message):
    something = torch.eye(64)[..., None].expand(-1, -1, 3)
    with pytest.raises(error) as caught:
        fit_pose(
            **arranged(**{"mesh": bracket(), "images": something, "cameras": camera(), "progress": False, **change})
        )
    assert message in str(caught.value)


def test_pictures_and_masks_of_bytes_are_named():
    view = camera(16)
    image = picture(view)
    bytes_ = (255 * image / image.max()).round()
    with pytest.warns(UserWarning, match=r"images: expected linear radiance.*whole numbers up to 255.*srgb_to_linear"):
        fit_pose(bracket(), bytes_, view, silhouette(view), init=START, search=False, options=quiet(steps=1))
    resized = 40.0 + 0.7 * bytes_  # no whole numbers any more
    with pytest.warns(
        UserWarning, match=r"images: expected linear radiance.*got numbers up to 218.*srgb_to_linear\(x / 255"
    ):
        fit_pose(bracket(), resized, view, silhouette(view), init=START, search=False, options=quiet(steps=1))
    with pytest.raises(
        ValueError, match=r"masks: expected numbers from 0 to 1, got 0 to 255; of 8-bit numbers take x / 255"
    ):
        fit_pose(bracket(), image, view, 255.0 * torch.eye(16), options=quiet())
    with pytest.raises(ValueError, match=r"masks: expected numbers from 0 to 1"):
        masks = [255.0 * torch.eye(16)]
        fit_scene(bracket(), None, [view], {"meshes[0].verts": 0.01}, masks=masks, options=quiet())


def test_alpha_is_no_colour_of_a_picture():
    """Alpha would show nothing of what surrounds the object, or more than a photograph knows."""
    view = camera(16)
    image = torch.cat([picture(view), silhouette(view)[..., None].reshape(16, 16, 1)], -1)
    words = (
        r"expected grey or colours, got 4 channels.*read_image\(path, channels=3\), or, .* x\[\.\.\., -1:\] as its mask"
    )
    with pytest.raises(ValueError, match="images: " + words):
        fit_pose(bracket(plain=True), image, view, options=quiet())
    with pytest.raises(ValueError, match="images: " + words):
        fit_scene(bracket(plain=True), image, view, {"verts": 0.01}, options=quiet(loss="region"))


def test_faint_masks_are_named():
    def stop(_):
        raise KeyboardInterrupt

    view, other = camera(16), camera(16, distance=2.6)
    mask, options = silhouette(view), {"callback": stop, "progress": False}
    with pytest.warns(
        UserWarning, match=r"masks: expected 1 where the object covers .* got at most 0\.216; .* read_mask"
    ):
        fit_pose(bracket(), picture(view), view, 0.216 * mask, init=START, **arranged(**options))
    what = {"verts": 0.01}
    with pytest.warns(UserWarning, match=r"masks: expected 1 where the object covers .* got at most 0\.00392"):
        fit_scene(bracket(), None, view, what, masks=mask / 255, **arranged(**options))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # In one of two views the object is hardly seen.
        fit_scene(bracket(), None, [view, other], what, masks=[mask, 0.1 * silhouette(other)], **arranged(**options))


@pytest.mark.parametrize("channels", [1, 2, 4])
@pytest.mark.parametrize("method", ["adam", "gauss-newton"])
def test_pictures_of_scenes_have_the_channels_of_the_scene(channels, method):
    image = torch.rand(16, 16, channels)
    with pytest.raises(ValueError, match=f"images: expected 3 channels like the scene's colours, got {channels}"):
        fit_scene(bracket(), image, camera(16), parameters={"verts": 0.1}, options=quiet(method=method, steps=1))


def test_pictures_of_a_texture_have_its_channels():
    corners = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    faces = torch.tensor([[0, 1, 2]])
    verts = torch.cat([corners, torch.zeros(3, 1)], 1)
    mesh = eg.Mesh(verts, faces, texture=torch.rand(4, 4, 3), uvs=corners, uv_faces=faces)
    with pytest.raises(ValueError, match="images: expected 3 channels like the mesh's texture, got 4"):
        fit_texture(mesh, torch.rand(16, 16, 4), camera(16), options=quiet(steps=1))


@pytest.mark.parametrize("used", [POSE_OPTIONS, DESCENT_OPTIONS, ("max_size", "spp")])
def test_options_that_a_fit_does_not_use_are_refused(used):
    values = dict.fromkeys(UNUSED, 8) | dict.fromkeys(("step_tolerance", "loss_tolerance"), 0.5)
    values |= {"loss": "l1", "mask_loss": "l1", "method": "adam", "callback": print, "checkpoint": "fit.pt"}
    for name, value in (values | {"sampling": eg.Sampling(), "shadows": True}).items():
        given = FitOptions(seed=0, **{name: value})
        if name in used:
            Settings.from_options(given, "this", used)
        else:
            with pytest.raises(ValueError, match=rf"options\.{name}: this .*; leave it out"):
                Settings.from_options(given, "this", used)


@pytest.mark.parametrize("search", [None, 0, 1, 10**6])
def test_a_search_that_is_none_is_named(taken, search):
    view, image = taken
    message = r"search: expected (True, False, a number|an int)"
    with pytest.raises((TypeError, ValueError), match=message):
        fit_pose(bracket(), image, view, search=search)
