"""Names of the package, and libraries that files need, are imported late, and errors name what is missing."""

import os
import subprocess
import sys

import pytest
import torch

from edgegrad import Mesh, read_image, save_mesh
from edgegrad.files.image import write_image
from edgegrad.files.load import load_mesh

pytestmark = pytest.mark.unsanitized

trimesh = pytest.importorskip("trimesh")


def test_libraries_that_are_missing_are_named(tmp_path, monkeypatch):
    """test_layers.py shows in a whole fit that they are imported late."""
    write_image(tmp_path / "a.png", torch.zeros(1, 1, 3))
    mesh = Mesh([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    for name in ("OpenImageIO", "trimesh", "trimesh.exchange.load"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match="pip install OpenImageIO"):
        read_image(tmp_path / "a.png")
    with pytest.raises(ImportError, match="pip install trimesh"):
        save_mesh(tmp_path / "a.ply", mesh)


def alone(code: str) -> subprocess.CompletedProcess[str]:
    """Run the code in a process of its own."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run([sys.executable, "-c", code], text=True, capture_output=True, env=env)


def test_a_wrong_name_is_corrected() -> None:
    assert "Did you mean: 'render'?" in alone("import edgegrad; edgegrad.rendr").stderr


def test_ipython_knows_the_pictures_of_meshes_and_scenes() -> None:
    done = alone(
        "import sys; from IPython.core.interactiveshell import InteractiveShell as Shell; shell = Shell.instance()\n"
        "import edgegrad; known = shell.display_formatter.formatters['image/png'].deferred_printers\n"
        "assert {name for _, name in known} >= {'Mesh', 'Scene'} and 'torch' not in sys.modules"
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_library_is_asked_for_by_its_extra(tmp_path):
    """test_layers.py does the same for Pillow."""
    trimesh.creation.box().export(tmp_path / "a.3mf")
    assert len(load_mesh(tmp_path / "a.3mf").faces) == 12
    code = (
        "import sys\nsys.modules['lxml'] = None\nimport edgegrad as eg\n"
        "try: eg.load_mesh('a.3mf')\nexcept ImportError as error: print(error)"
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    (line,) = subprocess.check_output([sys.executable, "-c", code], text=True, cwd=tmp_path, env=env).splitlines()
    assert line.startswith("reading") and "pip install 'edgegrad[files]'" in line
