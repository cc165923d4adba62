"""The order of the packages: who may import whom, the figure of it, and what a process imports when."""

from __future__ import annotations

import subprocess
import sys
from graphlib import CycleError
from pathlib import Path

import grimp
import pytest
import trimesh
from importlinter.cli import EXIT_STATUS_ERROR, EXIT_STATUS_SUCCESS, lint_imports
from PIL import Image

from edgegrad.files.load import load_mesh

pytestmark = pytest.mark.quick

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "docs"))
import layers  # noqa: E402


def test_imports_run_downward(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    assert lint_imports(no_cache=True) == EXIT_STATUS_SUCCESS, capsys.readouterr().out


def test_an_import_upward_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    build = grimp.build_graph

    def with_one_more(*args: object, **kwargs: object) -> grimp.ImportGraph:
        graph = build(*args, **kwargs)  # pyright: ignore[reportArgumentType, reportCallIssue]
        graph.add_import(importer="edgegrad.scene.mesh", imported="edgegrad.files.save")
        return graph

    monkeypatch.setattr("grimp.build_graph", with_one_more)
    assert lint_imports(no_cache=True) == EXIT_STATUS_ERROR


def test_the_figure_is_that_of_the_imports() -> None:
    """`python docs/layers.py` was run after the last change."""
    every = layers.layers(layers.imports())
    assert layers.description(every) in (ROOT / "docs" / "layers.svg").read_text(encoding="utf-8")
    assert len(every) > 8


def test_a_circle_has_no_layers() -> None:
    with pytest.raises(CycleError):
        layers.layers({"a": {"b"}, "b": {"a"}, "c": set()})


FIRST_STEP = """
import pickle, sys
import edgegrad as eg
assert not {"torch", "numpy", "edgegrad._core"} & set(sys.modules)
assert {"render", "Mesh", "fit", "points"} <= set(dir(eg)) and set(eg.__all__) == set(dir(eg))
for wrong in ("rendr", "fit.fit_pos"):
    try: eval(f"eg.{wrong}")
    except AttributeError as error: assert wrong.split(".")[-1] in str(error) and error.obj is not None
assert "torch" not in sys.modules
import edgegrad.render
assert callable(eg.render) and callable(eg.plan) and callable(eg.profile) and callable(eg.textures.bake)
assert "edgegrad.fit.rig" not in sys.modules and callable(eg.fit.fit_pose)
assert pickle.loads(pickle.dumps(eg.Camera)) is eg.Camera
from edgegrad import *
from edgegrad.fit import *
assert render is eg.render and fit_rig is eg.fit.fit_rig
import edgegrad.bop
for part in (eg, eg.bop, eg.fit, eg.points, eg.rig):
    assert set(part.__all__) == set(dir(part)) and all(hasattr(part, name) for name in part.__all__), part
assert callable(eg.points.trace) and callable(eg.rig.load) and callable(eg.shapes.box) and callable(eg.bop.evaluate)
import torch
verts = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
mesh = eg.Mesh(verts, torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]), colors=verts)
camera = eg.Camera.look_at((0.8, 0.6, 3.0), (0.3, 0.3, 0.3), (0.0, 1.0, 0.0), 40.0, (32, 32))
target = eg.render(mesh.transformed(t=torch.tensor([0.05, 0.0, 0.0])), camera)
def stop(*fit):
    raise KeyboardInterrupt
options = eg.fit.FitOptions(seed=0, callback=stop, progress=False)
fit = eg.fit.fit_pose(mesh, target, camera, init=torch.eye(4), options=options)
assert fit.interrupted and fit.steps
eg.fit.fit_scene(mesh, [target], camera, {"verts": 1e-3}, options=eg.fit.FitOptions(steps=1, seed=0, progress=False))
libraries = {"roma", "trimesh", "matplotlib", "OpenImageIO", "PIL", "viser"}
slow = sorted({"torch._dynamo", "torch._inductor", "torch._decomp.decompositions_for_jvp", *libraries} & set(sys.modules))
assert not slow, slow
sys.modules["PIL"] = None
for path in sys.argv[1:]:
    try: eg.load_mesh(path)
    except ImportError as error: print(error)
"""


def test_a_fit_imports_no_compiler(tmp_path: Path) -> None:
    """torch's compiler takes longer to import than torch itself, and than a fit; its rules of forward mode take
    seconds. Names of the package are imported on first use, libraries for files late, and errors say how to get them."""
    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, :2], image=Image.new("RGB", (2, 2)))
    files = [tmp_path / "a.glb", tmp_path / "a.obj"]
    for file in files:
        box.export(file)
        assert len(load_mesh(file).faces) == 12
    command = [sys.executable, "-c", FIRST_STEP, *map(str, files)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    said = done.stdout.splitlines()
    assert len(said) == len(files)
    for line in said:
        assert line.startswith("reading") and "pip install 'edgegrad[files]'" in line


def test_names_of_the_package_are_public() -> None:
    """They are the public names and the packages below, and nothing that was imported on the way."""
    import edgegrad as eg

    inside = {name for layer in layers.layers(layers.imports()) for name in layer} | layers.LEFT_OUT
    found = {name for name in vars(eg) if not name.startswith("_")}
    assert found <= {*eg.__all__, *inside}, sorted(found - set(eg.__all__) - inside)
