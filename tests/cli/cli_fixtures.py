"""Commands of the shell, run in this process; tests name this module as a plugin of pytest for its fixture."""

import pytest
from bracket_files import write_bracket
from brackets import camera, silhouette

from edgegrad import cli
from edgegrad.files.image import srgb_to_linear, write_image


@pytest.fixture
def files(tmp_path):
    """Return a folder with mesh.ply, camera.json, target.png, mask.png and init.json."""
    write_image(
        tmp_path / "mask.png", srgb_to_linear(silhouette(camera(48)))
    )  # a mask's greys are coverage as they are
    return write_bracket(tmp_path, 48)


def run(*arguments):
    return cli.main([str(argument) for argument in arguments])


def fit(files, *more):
    """Run fit-pose on the files."""
    return run("fit-pose", files / "mesh.ply", files / "target.png", "--camera", files / "camera.json", *more)
