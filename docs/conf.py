"""Settings of Sphinx: `make docs` builds this folder into build/docs."""

from __future__ import annotations

import dataclasses
import inspect
import shutil
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

from docstrings import to_rst

import edgegrad
import edgegrad.fit.losses
import edgegrad.fit.regularizers

project = "edgegrad"
author = "the authors of edgegrad"
copyright = author
version = release = edgegrad.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.viewcode", "sphinx_copybutton"]
extensions += ["mathml", "offline"]  # this folder's own
exclude_patterns = ["_build"]
smartquotes = False
html_theme = "furo"
html_math_renderer = "mathml"
html_title = f"edgegrad {version}"
html_static_path = ["static"]
html_css_files = ["edgegrad.css"]
copybutton_exclude = ".linenos, .gp, .go"

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # tests run the notebooks

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_use_legacy_class_based = False
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 88
python_use_unqualified_type_names = True
# No inventories of other projects: the site builds without a network. So their types have nothing to link to.
OTHERS = r"(torch|numpy|collections|os|pathlib|typing)\..*|Tensor|Vector|Figure|Path"
nitpick_ignore_regex = [
    ("py:.*", OTHERS),
    (
        "py:class",
        r"edgegrad\.(fit\.views\.Observation|fit\.placement\.Placement|camera\.fields\.CameraT|points\.discontinuities\.Discontinuities|rig\.rig\.Deformer|raster\.rasterize\.RasterizeContext)|PoseTask|RenderOptions",
    ),
]
# Nobody calls these: functions return them.
RETURNED = {
    "Hits", "Plan", "Profile", "PrimaryHits", "SurfaceSamples", "EdgeSamples", "PoseFit", "CameraFit", "Fit", "Model", "Frame",
    "Truth", "Evaluation", "Recalls", "Row", "PairErrors", "Refined", "PoseError",
}  # fmt: skip


def references() -> dict[str, str]:
    """Roles by the names under which docstrings speak of public things."""
    found = {}
    parts = edgegrad.lights, edgegrad.points, edgegrad.rig, edgegrad.shapes, edgegrad.textures
    for module in (edgegrad, edgegrad.fit, *parts):
        for name in module.__all__:
            thing, path = getattr(module, name), f"{module.__name__}.{name}"
            if inspect.isclass(thing):
                found |= {name: f":py:class:`~{path}`"} if module is not edgegrad.fit else {}
                for member, value in inspect.getmembers(thing):
                    if not member.startswith("_") and inspect.isfunction(value) and value.__doc__:
                        found[f"{name}.{member}"] = f":py:meth:`{name}.{member} <{path}.{member}>`"
            elif callable(thing):
                found[name] = f":py:func:`~{path}`"
    return found


REFERENCES = references()


def docstring(app: Any, what: str, name: str, thing: object, options: Any, lines: list[str]) -> None:
    if dataclasses.is_dataclass(thing) and lines and lines[0].startswith(f"{getattr(thing, '__name__', '')}("):
        lines.clear()  # the one that dataclasses make up
    own = name.rpartition(".")[2]
    lines[:] = to_rst(lines, {name: role for name, role in REFERENCES.items() if name != own})


def signature(app: Any, what: str, name: str, *_: Any) -> tuple[str, str] | None:
    return ("", "") if what == "class" and name.rpartition(".")[2] in RETURNED else None


def notebooks() -> None:
    """Copies them here, for Sphinx reads nothing outside of its folder."""
    into = HERE / "notebooks"
    shutil.rmtree(into, ignore_errors=True)
    into.mkdir()
    for notebook in sorted((HERE.parent / "notebooks").glob("*.ipynb")):
        shutil.copy(notebook, into)


notebooks()


def setup(app: Any) -> None:
    app.connect("autodoc-process-docstring", docstring)
    app.connect("autodoc-process-signature", signature)
