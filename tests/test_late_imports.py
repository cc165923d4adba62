"""Libraries that files need are imported late, and missed by name."""

import os
import subprocess
import sys

import pytest
import torch

from edgegrad import Mesh, read_image, save_mesh
from edgegrad.files.image import write_image
from edgegrad.files.load import load_mesh

trimesh = pytest.importorskip("trimesh")


def test_libraries_that_are_missing_are_named(tmp_path, monkeypatch):
    """That they are imported late is seen where a whole fit must do without them, in test_house.py."""
    write_image(tmp_path / "a.png", torch.zeros(1, 1, 3))
    mesh = Mesh([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    for name in ("OpenImageIO", "trimesh", "trimesh.exchange.load"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match="pip install OpenImageIO"):
        read_image(tmp_path / "a.png")
    with pytest.raises(ImportError, match="pip install trimesh"):
        save_mesh(tmp_path / "a.ply", mesh)


@pytest.mark.slow
def test_a_library_is_asked_for_by_its_extra(tmp_path):
    """As Pillow is, in test_house.py."""
    trimesh.creation.box().export(tmp_path / "a.3mf")
    assert len(load_mesh(tmp_path / "a.3mf").faces) == 12
    code = (
        "import sys\nsys.modules['lxml'] = None\nimport edgegrad as eg\n"
        "try: eg.load_mesh('a.3mf')\nexcept ImportError as error: print(error)"
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    (line,) = subprocess.check_output([sys.executable, "-c", code], text=True, cwd=tmp_path, env=env).splitlines()
    assert line.startswith("reading") and "pip install 'edgegrad[files]'" in line
