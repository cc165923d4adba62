"""Fits run in full precision, whatever modes of torch they are called in, and whatever their callbacks do."""

from contextlib import contextmanager

import pytest
import torch
from brackets import START, bracket, camera, picture, silhouette
from quiet_fits import quiet

import edgegrad as eg
from edgegrad.fit import fit_pose, fit_poses, fit_scene


@contextmanager
def default_dtype(dtype):
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


MODES = {
    "float64": lambda: default_dtype(torch.float64),
    "autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
}


@pytest.mark.parametrize("masked", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_pose_is_the_same_in_all_modes(masked):
    view, mesh = camera(24), bracket()
    image, masks = picture(view), silhouette(view)[..., 0] if masked else None

    def found():
        return fit_pose(mesh, image, view, masks, START, search=False, options=quiet(steps=2, spp=4, seed=0)).matrix

    expected = found()
    for mode in MODES.values():
        with mode():
            assert torch.allclose(found(), expected, atol=1e-9)


@pytest.mark.parametrize("mode", list(MODES))
def test_colours_are_the_same_in_all_modes(mode):
    view, mesh = camera(16), bracket()
    image, start = picture(view), mesh.replace(face_colors=torch.full((20, 3), 0.4))

    def found():
        return fit_scene(start, image, view, {"face_colors": 0.03}, options=quiet(steps=3, spp=4, seed=0)).values

    expected = found()["face_colors"]
    with MODES[mode]():
        assert torch.allclose(found()["face_colors"], expected)


def test_a_callback_may_change_what_it_gets():
    view, mesh = camera(16), bracket()
    image = picture(view)

    def pose(fit):
        for tensor in (
            fit.R,
            fit.t,
            fit.camera.K,
            fit.cameras[0].world_to_camera,
            *(step.pose.R for step in fit.history),
        ):
            tensor.mul_(2.0)

    def found(callback):
        options = quiet(steps=1, spp=4, callback=callback)
        return fit_pose(mesh, image, view, init=START, search=False, options=options).matrix

    assert torch.equal(found(pose), found(None))

    def several(callback):
        options = quiet(steps=1, spp=4, callback=callback)
        return fit_poses([mesh], image, view, init=[START], search=False, options=options)[0].matrix

    assert torch.equal(several(lambda fits: pose(fits[0])), several(None))

    def scene(progress):
        progress.scene.meshes[0].verts.mul_(2.0)
        progress.cameras[0].K.mul_(2.0)
        progress.values["background"].mul_(2.0)

    def colour(callback):
        start, options = eg.Scene([mesh], torch.zeros(3)), quiet(steps=3, spp=4, callback=callback)
        return fit_scene(start, image, view, {"background": 0.03}, options=options)

    changed, kept = colour(scene), colour(None)
    assert torch.equal(changed.values["background"], kept.values["background"])
    assert torch.equal(changed.history[1].values["background"], kept.history[1].values["background"])
