"""Pictures in any unit of radiance, and what a fit says of one that is brighter than its renders."""

from __future__ import annotations

import math

import pytest
import torch
from brackets import BACKGROUND, START, about_center, before_sky, bracket, camera, errors, picture, rotation
from photographs import clutter
from quiet_fits import arranged, quiet

import edgegrad as eg
from edgegrad.files.image import srgb_to_linear
from edgegrad.fit import PoseParameter, fit_pose, fit_scene
from edgegrad.fit.edge_support import edge_support
from edgegrad.fit.placement import pose_from_matrix
from edgegrad.fit.pose.result import PoseFit
from edgegrad.fit.views import has_levels, white_level


@pytest.fixture(scope="module")
def expected() -> PoseFit:
    view = camera(48)
    return fit_pose(before_sky(), picture(view), view, init=START, search=False, options=quiet())


@pytest.mark.parametrize(
    "gain", [pytest.param(1 / 256, marks=pytest.mark.slow), pytest.param(16.0, marks=pytest.mark.slow), 256.0]
)
def test_a_picture_of_any_unit_has_one_pose(gain: float, expected: PoseFit) -> None:
    """The background is given in the unit of the mesh's colours."""
    view = camera(48)
    fit = fit_pose(before_sky(), gain * picture(view), view, init=START, search=False, options=quiet())
    off = errors(fit)
    assert off[0] < 0.1 and off[1] < 0.15 and fit.reason == "converged" and fit.explained > 0.95, (off, fit.explained)
    assert errors(expected)[0] < 0.1 and fit.loss == pytest.approx(expected.loss, rel=0.3)


def test_a_broken_pixel_does_not_stop_a_fit() -> None:
    """Pixels brighter than white say nothing of the range of the others."""
    view = camera(48)
    image = picture(view)
    image[3, 3] = 1e5
    fit = fit_pose(before_sky(), image, view, init=START, search=False, options=quiet())
    off = errors(fit)
    assert off[0] < 0.2 and off[1] < 0.2 and fit.reason == "converged", off


@pytest.mark.parametrize("gain", [0.1, pytest.param(16.0, marks=pytest.mark.slow)])
def test_a_dim_picture_before_clutter(gain: float) -> None:
    view = camera(48)
    with torch.no_grad():
        image = gain * eg.render(eg.Scene([bracket()], clutter(48)), view, 64, seed=0)
    fit = fit_pose(bracket(), image, view, init=START, search=False, options=quiet(spp=8))
    assert errors(fit)[0] < 2.0 and fit.reason == "converged", errors(fit)


@pytest.mark.parametrize(("gain", "share"), [(0.5, 0.5), (1.0, 1.0), (2.0, 0.5), (16.0, 1 / 16)])
def test_stronger_edges_are_not_those_of_the_render(gain: float, share: float) -> None:
    view = camera(48)
    with torch.no_grad():
        one, other = (eg.render(eg.Scene([bracket()], BACKGROUND), view, 64, seed) for seed in (1, 2))
    assert edge_support([(one, other, gain * one, None)]) == pytest.approx(share, rel=0.03)


@pytest.mark.parametrize("noise", [0.03, 0.1])
def test_noise_makes_no_edge_stronger(noise: float) -> None:
    view = camera(48)
    with torch.no_grad():
        one, other = (eg.render(eg.Scene([bracket()], BACKGROUND), view, 64, seed) for seed in (1, 2))
    noisy = one + noise * torch.randn(one.shape, generator=torch.Generator().manual_seed(0))
    assert edge_support([(one, other, noisy, None)]) > 0.95


@pytest.mark.parametrize("gain", [1.0, 2.5])
def test_a_scene_whose_pictures_are_brighter_is_not_converged(gain: float) -> None:
    """fit_scene() takes colours as they are, so the scene does not explain stronger edges than its own."""
    view = camera(32)
    start = pose_from_matrix("", about_center(rotation(0.03, -0.1, 0.04), (0.04, 0.0, 0.0)))
    wanted = {"meshes.0.pose": PoseParameter(start, rotation=0.02, shift=0.01)}
    options = {"steps": 20, "spp": 4, "progress": False, "method": "gauss-newton"}
    fit = fit_scene(eg.Scene([bracket()], BACKGROUND), gain * picture(view), view, wanted, **arranged(**options))
    assert (fit.explained > 0.9) == (gain == 1.0) and (fit.explained < 0.6) == (gain > 1.0), fit.explained
    assert gain == 1.0 or fit.reason != "converged"


def test_the_deviation_that_noise_leaves() -> None:
    """The root mean square of errors over the stated deviations is 1 where these are right."""
    view, ratios = camera(32), []
    clean = picture(view)
    for seed in range(3):
        noise = 0.05 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(seed))
        fit = fit_pose(before_sky(), clean + noise, view, init=torch.eye(4), search=False, options=quiet())
        assert fit.uncertainty is not None and fit.task is not None
        degrees, percent = errors(fit)
        ratios += [degrees / fit.uncertainty.degrees, 0.01 * percent * fit.task.size / fit.uncertainty.shift]
    assert 0.2 < math.sqrt(sum(ratio**2 for ratio in ratios) / len(ratios)) < 2.0, ratios


def test_the_uncertainty_is_saved(expected: PoseFit) -> None:
    known = expected.uncertainty
    assert known is not None and known.degrees < 0.6
    assert known.words.startswith(f"±{known.degrees:.2g}° about (") and " along (" in known.words
    again = PoseFit.from_json(expected.to_json())
    assert again.uncertainty is not None and again.uncertainty.words == known.words
    assert '"reason": "converged"' in expected.to_json()


def test_the_white_level_of_a_picture() -> None:
    levels = torch.randint(0, 40, (32, 32, 3), generator=torch.Generator().manual_seed(0))
    dark = srgb_to_linear(levels / 255.0)
    assert has_levels(dark) and not has_levels(0.5 * dark) and not has_levels(2.0 * picture(camera(32)))
    assert white_level((7.0 * dark).flatten(0, 1)) == pytest.approx(7.0 * white_level(dark.flatten(0, 1)), rel=1e-5)
    assert white_level(torch.zeros(5, 3)) == 1.0
