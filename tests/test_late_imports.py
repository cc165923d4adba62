"""Libraries that files need are imported late, and missed by name."""

import os
import subprocess
import sys

import pytest
import torch
from PIL import Image

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


@pytest.mark.parametrize(
    "missing, names",
    [
        ("PIL", ["a.glb", "a.obj"]),
        pytest.param("lxml", ["a.3mf"], marks=pytest.mark.slow),
    ],
)
def test_missing_libraries_are_asked_for_by_their_extra(tmp_path, missing, names):
    for name in names:
        box = trimesh.creation.box()
        if missing == "PIL":
            box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, :2], image=Image.new("RGB", (2, 2)))
        box.export(tmp_path / name)
        assert len(load_mesh(tmp_path / name).faces) == 12
    code = (
        f"import sys\nsys.modules['{missing}'] = None\nimport edgegrad as eg\nfor name in {names}:\n"
        "    try: eg.load_mesh(name)\n    except ImportError as error: print(error)"
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    text = subprocess.check_output([sys.executable, "-c", code], text=True, cwd=tmp_path, env=env)
    lines = text.splitlines()
    assert len(lines) == len(names)
    for line in lines:
        assert line.startswith("reading") and "pip install 'edgegrad[files]'" in line
