"""A live view, which tests get by naming this module as a plugin of pytest, and a fit to look at."""

import pytest
from brackets import bracket
from quiet_fits import arranged
from small_scenes import QUIET, pictures, views

import edgegrad as eg
from edgegrad.fit import Parameter, fit_scene
from edgegrad.live.browser import Browser


@pytest.fixture
def viewer():
    with eg.viewer(port=0, share=1.0) as made:
        yield made


def page(viewer) -> Browser:
    return viewer._display


def colour_fit(**options):
    cameras = views(1)
    return fit_scene(
        bracket(), pictures(bracket(), cameras), cameras, {"face_colors": Parameter(0.01)},
        **arranged(**{**QUIET, **options}),
    )  # fmt: skip
