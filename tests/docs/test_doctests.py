"""Docstrings of all that is public: their sections, their length, and their examples."""

from __future__ import annotations

import doctest
import importlib
import inspect
import re
from collections.abc import Iterator
from types import ModuleType

import pytest
import torch
from doc_pages import FOLDER

import edgegrad

pytestmark = pytest.mark.unsanitized

MOST_LINES = 40
MODULES = (
    "edgegrad", "edgegrad.bop", "edgegrad.bop.errors", "edgegrad.bop.files", "edgegrad.fit", "edgegrad.fit.losses",
    "edgegrad.fit.priors", "edgegrad.fit.regularizers", "edgegrad.image", "edgegrad.lights", "edgegrad.points",
    "edgegrad.raster", "edgegrad.rig", "edgegrad.shapes", "edgegrad.textures",
)  # fmt: skip
SECTION = re.compile(r"^(Parameters|Attributes|Returns|Yields)\n-{4,}$", re.MULTILINE)
# What has no sections, since its first sentence says all.
WITHOUT_SECTIONS = {
    "edgegrad.image.linear_to_srgb": "one argument, as of srgb_to_linear()",
    "edgegrad.raster.get_log_level": "nvdiffrast's",
    "edgegrad.raster.set_log_level": "nvdiffrast's",
    "edgegrad.raster.RasterizeCudaContext": "its only argument is ignored",
    "edgegrad.lights.Light": "a base class without arguments",
    "edgegrad.points.Hits": "users do not make them; its properties are what it has",
}


def public() -> Iterator[tuple[str, object]]:
    """Yield functions and classes by the paths that users write."""
    for name in MODULES:
        module = importlib.import_module(name)
        for member in getattr(module, "__all__", [n for n, v in vars(module).items() if own(v, name)]):
            thing = getattr(module, member)
            if not isinstance(thing, ModuleType) and not member.startswith("_"):
                yield f"{name}.{member}", thing


def own(thing: object, module: str) -> bool:
    """Return whether a module without __all__ made it."""
    return callable(thing) and getattr(thing, "__module__", None) == module


PUBLIC = dict(public())


def methods(thing: object) -> Iterator[tuple[str, object]]:
    """Yield the public methods and properties of a class that have docstrings of their own."""
    for name, value in inspect.getmembers(thing) if inspect.isclass(thing) else ():
        if not name.startswith("_") and not isinstance(value, type) and inspect.getdoc(value) and documented(value):
            yield name, value


def documented(value: object) -> bool:
    """Return whether it is a function or a property, and of this package."""
    of = getattr(value, "fget", None) or getattr(value, "func", None) or value
    return inspect.isroutine(of) and str(getattr(of, "__module__", "")).startswith("edgegrad")


@pytest.mark.parametrize("path", PUBLIC)
def test_docstrings_have_the_sections_of_numpydoc(path: str) -> None:
    thing = PUBLIC[path]
    text = inspect.getdoc(thing) or ""
    summary = text.split("\n\n")[0]
    assert summary and "\n" not in summary and summary[0].isupper() and summary.endswith((".", ":"))
    assert len(text.splitlines()) <= MOST_LINES
    if path in WITHOUT_SECTIONS:
        assert not SECTION.search(text), "take it from the list of exceptions"
    elif inspect.signature(thing).parameters:  # pyright: ignore[reportArgumentType]
        assert SECTION.search(text), "it has arguments, and neither Parameters nor Returns"


def test_summaries_of_the_reference_are_one_line() -> None:
    reference = "".join(page.read_text(encoding="utf-8") for page in (FOLDER / "api").glob("*.md"))
    for path in re.findall(r"^\.\. auto(?:class|function):: (\S+)$", reference, re.MULTILINE):
        module, _, name = path.rpartition(".")
        thing = getattr(importlib.import_module(module), name)
        for member, value in ((path, thing), *methods(thing)):
            text = inspect.getdoc(value) or ""
            assert "\n" not in text.split("\n\n")[0], f"{path}: {member}"
            assert text[0].isupper() and len(text.splitlines()) <= MOST_LINES, f"{path}: {member}"


def examples() -> Iterator[tuple[str, object]]:
    for path, thing in PUBLIC.items():
        for name, value in ((path, thing), *((f"{path}.{name}", value) for name, value in methods(thing))):
            if ">>> " in (inspect.getdoc(value) or ""):
                yield name, value


EXAMPLES = dict(examples())


@pytest.mark.parametrize("path", EXAMPLES)
def test_examples_print_what_they_say(path: str) -> None:
    torch.manual_seed(0)
    text = inspect.getdoc(EXAMPLES[path]) or ""
    test = doctest.DocTestParser().get_doctest(text, {}, path, None, None)
    said: list[str] = []
    doctest.DocTestRunner(verbose=False, optionflags=doctest.NORMALIZE_WHITESPACE).run(test, out=said.append)
    assert not said, "".join(said)


def test_what_users_call_first_has_examples() -> None:
    first = {
        "Camera.look_at", "Material", "Mesh", "Scene", "lights.DirectionalLight", "lights.Environment", "points.Hits",
        "points.primary_hits", "points.trace", "raster.rasterize", "render", "rig.Rig", "save_mesh", "shapes.sphere",
        "textures.unwrap",
    }  # fmt: skip
    assert {f"{edgegrad.__name__}.{name}" for name in first} <= set(EXAMPLES)
