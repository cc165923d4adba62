"""The Python of the docs runs, and prints what they say it prints.

Blocks marked `python` run one after the other, as a reader would type them, in a folder of their own; those marked `py` are code
of other libraries, or need files that nobody has here. A block of `text` is what the block before it prints: the same words, and
numbers within a fifth.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import pkgutil
import re
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import get_args, get_type_hints

import matplotlib
import pytest
import torch
from doc_pages import FENCE, FOLDER
from torch import Tensor

import edgegrad
import edgegrad.bop
import edgegrad.fit
import edgegrad.points
import edgegrad.raster
import edgegrad.rig
from edgegrad.fit.descent.result import Fit
from edgegrad.fit.pose.result import PoseFit

pytestmark = pytest.mark.unsanitized

PAGES = ["quick-start.md", "concepts.md", *(str(p.relative_to(FOLDER)) for p in sorted(FOLDER.glob("how-to/*.md")))]
LONG = ("how-to/shape-from-depth.md", "how-to/bop.md", "how-to/calibrate.md", "how-to/training-loop.md")
NUMBER = re.compile(r"[-−+]?\d[\d,]*\.?\d*(?:e[-+]?\d+)?")
TOLERANCE = 0.2


def same(said: str, printed: str) -> bool:
    """Return whether words are equal, spaces and numbers aside, and numbers close."""
    words = [" ".join(NUMBER.sub("#", text).split()) for text in (said, printed)]
    values = [[float(n.replace(",", "").replace("−", "-")) for n in NUMBER.findall(text)] for text in (said, printed)]
    close = (abs(a - b) <= TOLERANCE * max(abs(a), abs(b)) for a, b in zip(*values, strict=True))
    return words[0] == words[1] and all(close)


def test_outputs_are_compared() -> None:
    assert same("loss  1.00e-3, 12 faces", "loss 1.1e-03, 12  faces")
    assert not same("loss 1.0", "loss 1.5") and not same("loss 1.0", "error 1.0")


@pytest.mark.parametrize("page", [pytest.param(p, marks=pytest.mark.slow) if p in LONG else p for p in PAGES])
def test_page(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    torch.manual_seed(0)
    text = (FOLDER / page).read_text(encoding="utf-8")
    names: dict[str, object] = {"__name__": "__main__"}
    printed = ""
    for block in FENCE.finditer(text):
        kind, source = block.groups()
        if kind == "python":
            line = text[: block.start(2)].count("\n")
            out = io.StringIO()
            with contextlib.redirect_stdout(out):
                exec(compile("\n" * line + source, str(FOLDER / page), "exec"), names)
            printed = out.getvalue()
        elif kind == "text":
            assert same(source, printed), f"{page}: it says\n{source}\nand prints\n{printed}"


def test_readme_is_short() -> None:
    text = (FOLDER.parent / "README.md").read_text(encoding="utf-8")
    assert len(text.split()) <= 1100


def test_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small model and its picture stand for the reader's, with few steps."""
    monkeypatch.chdir(tmp_path)
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0], [0, 0, 1]])
    faces = torch.tensor([[0, 1, 3], [1, 2, 3], [2, 0, 3], [2, 1, 0]])
    model = edgegrad.Mesh(corners, faces, face_colors=0.2 + 0.6 * torch.eye(4)[:, :3])
    edgegrad.save_mesh("model.glb", model)
    camera = edgegrad.Camera.look_at(eye=(0, 0, 3), target=(0, 0, 0), up=(0, 1, 0), fov_y=40, size=(32, 32))
    shown = edgegrad.render_aovs(model, camera, ["image", "alpha"], spp=64, seed=0)
    edgegrad.write_image("photo.png", shown["image"])
    edgegrad.write_image("mask.png", edgegrad.image.srgb_to_linear(shown["alpha"]))
    frames = []
    for k, eye in enumerate([(0, 0, 3), (3, 0, 0.5), (0, 3, 0.4)]):
        view = edgegrad.Camera.look_at(eye, target=(0, 0, 0), up=(0.1, 1, 0.1), fov_y=60, size=(32, 32))
        mask = edgegrad.render_aovs(model, view, ["alpha"], spp=64, seed=0)["alpha"]
        edgegrad.write_image(f"mask_{k}.png", edgegrad.image.srgb_to_linear(mask))
        to_opengl = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
        pose = torch.linalg.inv(view.world_to_camera) @ to_opengl
        frames.append({"file_path": f"mask_{k}.png", "transform_matrix": pose.tolist()})
    lens = {"fl_x": float(view.K[0, 0]), "fl_y": float(view.K[1, 1]), "cx": 16, "cy": 16, "w": 32, "h": 32}
    Path("transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    names: dict[str, object] = {}
    text = (FOLDER.parent / "README.md").read_text(encoding="utf-8")
    blocks = [source for kind, source in FENCE.findall(text) if kind == "python"]
    assert len(blocks) == 4
    fits = []
    for source in blocks:
        quick = source.replace("range(200)", "range(3)").replace("steps=200", "steps=8, progress=False")
        exec(compile(quick, "README.md", "exec"), names)
        fits.append(names["fit"])
    (pose, shape, *_), sun = fits, names["sun"]
    assert isinstance(pose, PoseFit) and isinstance(shape, Fit) and isinstance(sun, torch.Tensor)
    assert pose.loss < 1e-3 and sun.grad is not None and sun.grad.abs().max() > 0
    assert len(shape.mesh.faces) > len(names["sphere"].faces) and Path("shape.glb").is_file()


def test_equations_are_typeset() -> None:
    """No integral, sum or partial derivative is written as code."""
    for page in FOLDER.rglob("*.md"):
        text = FENCE.sub("", page.read_text(encoding="utf-8"))
        code = re.findall(r"`[^`\n]+`|^    \S.*$", text, re.MULTILINE)
        assert not [found for found in code if re.search("[∫∮∂∇]", found)], page.name


@pytest.mark.parametrize(
    "module",
    [
        edgegrad,
        edgegrad.bop,
        edgegrad.fit,
        edgegrad.image,
        edgegrad.lights,
        edgegrad.points,
        edgegrad.raster,
        edgegrad.rig,
        edgegrad.shapes,
        edgegrad.textures,
    ],
)
def test_reference_has_all_that_is_public(module: ModuleType) -> None:
    reference = "".join(page.read_text(encoding="utf-8") for page in (FOLDER / "api").glob("*.md"))
    listed = set(re.findall(r"^\.\. auto\w+:: (\S+)$", reference, re.MULTILINE))
    public = [name for name in module.__all__ if not isinstance(getattr(module, name), ModuleType)]  # those have pages
    names = {f"{module.__name__}.{name}" for name in public}
    assert names <= listed, f"docs/api lacks {sorted(names - listed)}"
    assert all(resolves(name) for name in listed)


def resolves(name: str) -> bool:
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError):
        return False
    return True


def test_pages_are_found_from_the_first() -> None:
    """Each page is in a table of contents, perhaps by a pattern."""
    listed = []
    for index in FOLDER.rglob("*.md"):
        for entries in re.findall(
            r"^```\{toctree\}\n(.*?)^```", index.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
        ):
            listed += [
                (index.parent / line).relative_to(FOLDER) for line in entries.splitlines() if not line.startswith(":")
            ]
    pages = {page.relative_to(FOLDER).with_suffix("") for page in FOLDER.rglob("*.md")} - {Path("index")}
    lost = [page for page in pages if not any(fnmatch(str(page), str(entry)) for entry in listed)]
    assert not lost


def tensors_of(kind: type) -> str:
    """Return the fields of a dataclass that may be fitted, floating-point tensors, as a cell of a table."""
    hints = get_type_hints(kind)
    fields = [field.name for field in dataclasses.fields(kind)]  # pyright: ignore[reportArgumentType]
    may_hold = {name: (hints[name], *get_args(hints[name])) for name in fields}
    return ", ".join(f"`{name}`" for name in fields if Tensor in may_hold[name] and not name.endswith("faces"))


def textures_of(kind: type) -> list[str]:
    """Return the fields of a dataclass that may hold a Texture."""
    hints = get_type_hints(kind)
    return [name for name, hint in hints.items() if edgegrad.Texture in (hint, *get_args(hint))]


def test_names_of_parameters_are_those_of_the_classes() -> None:
    """The table of docs/fits.md can be copied from the message of a failure."""
    lights = (
        edgegrad.lights.PointLight, edgegrad.lights.SpotLight, edgegrad.lights.DirectionalLight, edgegrad.lights.Environment,
        edgegrad.lights.SphericalHarmonics,
    )  # fmt: skip
    rows = [("", edgegrad.Scene), ("meshes.0.", edgegrad.Mesh), ("meshes.0.material.", edgegrad.Material)]
    rows += [(f"meshes.0.material.{name}.", edgegrad.Texture) for name in textures_of(edgegrad.Material)]
    rows += [*(("lights.0.", light) for light in lights), ("cameras.0.", edgegrad.Camera)]
    table = [f"| {f'`{start}`' if start else '—'} | `{kind.__name__}` | {tensors_of(kind)} |" for start, kind in rows]
    table[-1] = table[-1].replace("`world_to_camera`, ", "")  # a camera moves by its pose
    text = (FOLDER / "fits.md").read_text(encoding="utf-8")
    assert "\n".join(table) in text, "docs/fits.md lacks these rows:\n" + "\n".join(table)


MAINTAINERS = [
    "contributing.md",
    "checks.md",
    *(f"how-it-works/{p.name}" for p in sorted((FOLDER / "how-it-works").glob("*.md"))),
]


@pytest.mark.quick
@pytest.mark.parametrize("page", MAINTAINERS)
def test_files_that_a_page_names_exist(page: str) -> None:
    """Names are paths from the root, or the last parts of paths; NAME stands for the reader's own file."""
    root = FOLDER.parent
    tops = ("csrc", "edgegrad", "benchmarks", "tests", "docs", "examples")
    paths = [str(path.relative_to(root)) for top in tops for path in (root / top).rglob("*.*")] + ["pyproject.toml"]
    text = (FOLDER / page).read_text(encoding="utf-8")
    names = {name for name in re.findall(r"`([\w./*]+\.(?:py|pyi|h|cpp|toml|\*))`", text) if "NAME" not in name}
    names |= {f"{name}.py" for name in re.findall(r"`(test_[\w*]+)`", text)}
    lost = [name for name in names if not any(fnmatch("/" + path, "*/" + name) for path in paths)]
    assert not lost


SOURCES = ("*.py", "*.pyi", "*.cpp", "*.h", "*.yml", "*.toml", "Makefile", "CMakeLists.txt", "mutants.txt")


@cache
def words_of_sources() -> frozenset[str]:
    """All words of the sources but this file, and the names of files without their endings."""
    root = FOLDER.parent
    tops = ("csrc", "edgegrad", "tests", "benchmarks", "examples", "docs", "notebooks", ".github")
    files = [*root.iterdir(), *(path for top in tops for path in (root / top).rglob("*"))]
    files = [path for path in files if path.is_file() and path != Path(__file__)]
    known = {path.name.partition(".")[0] for path in files}
    for path in files:
        if any(fnmatch(path.name, pattern) for pattern in SOURCES):
            known |= set(re.findall(r"\w+", path.read_text(encoding="utf-8")))
    return frozenset(known)


def unknown_identifiers(text: str) -> list[str]:
    """Return the names in code spans that the sources do not have. NAME and VERSION stand for others, * for any ending."""
    spans = " ".join(re.findall(r"`([^`\n]+)`", FENCE.sub("", text)))
    names = re.findall(r"(?<!\w)[A-Za-z_]\w*(?![\w*])", spans)
    return [name for name in names if name not in words_of_sources() and not re.search("NAME|VERSION", name)]


@pytest.mark.quick
@pytest.mark.parametrize("page", [page for page in MAINTAINERS if page != "checks.md"])
def test_identifiers_are_those_of_the_sources(page: str) -> None:
    assert not unknown_identifiers((FOLDER / page).read_text(encoding="utf-8"))


def test_made_up_identifiers_are_found() -> None:
    text = "`Camera.look_at()` and `with_cube_face_lens`, not `with_side_lens` nor `csrc/camera/side_lens.h`"
    assert unknown_identifiers(text) == ["with_side_lens", "side_lens"]


@pytest.mark.quick
@pytest.mark.parametrize("page", MAINTAINERS)
def test_pages_for_maintainers_are_short(page: str) -> None:
    assert len((FOLDER / page).read_text(encoding="utf-8").split()) <= (1800 if page == "contributing.md" else 1500)
