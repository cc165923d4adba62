"""What is written of the package in several files agrees: version, addresses, requirements, the Pythons it is tested with."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

import edgegrad

ROOT = Path(__file__).parents[2]
PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
# conda-forge's names. Its `embree` is the library that PyPI has in embreex.
CONDA = {"torch": "pytorch", "embreex": "embree", "OpenImageIO": "py-openimageio"}


def loaded(file: str) -> Any:
    return yaml.safe_load((ROOT / file).read_text(encoding="utf-8"))


def strings(key: str) -> list[str]:
    """Return the strings of a list of pyproject.toml, which Python 3.10 has no reader for."""
    (block,) = re.findall(rf"^{key} = \[(.*?)\]$", PROJECT, re.MULTILINE | re.DOTALL)
    return re.findall(r'"([^"]+)"', re.sub(r"(?<=[\s,])#.*", "", block))


def urls() -> dict[str, str]:
    (block,) = re.findall(r"^\[project\.urls\]\n(.*?)^\[", PROJECT, re.MULTILINE | re.DOTALL)
    return dict(re.findall(r'^(\w+) = "([^"]+)"$', block, re.MULTILINE))


def conda(requirement: str) -> str:
    """Return a requirement of pip as conda writes it."""
    name, versions = re.fullmatch(r"([\w.-]+)(.*)", requirement).groups()  # pyright: ignore[reportOptionalMemberAccess]
    return f"{CONDA.get(name, name)} {versions}".strip()


def test_versions_are_equal() -> None:
    (version,) = re.findall(r'^version = "(.*)"$', PROJECT, re.MULTILINE)
    found = [
        edgegrad.__version__,
        loaded("CITATION.cff")["version"],
        loaded("recipe/recipe.yaml")["context"]["version"],
    ]
    assert found == [version] * 3


def test_addresses_are_equal() -> None:
    known, citation, about = urls(), loaded("CITATION.cff"), loaded("recipe/recipe.yaml")["about"]
    assert set(known) >= {"Homepage", "Documentation", "Source", "Issues", "Changelog"}
    assert {citation["repository-code"], about["repository"], about["homepage"]} == {known["Source"]}
    assert {citation["url"], about["documentation"]} == {known["Documentation"]}
    pages = [ROOT / "SECURITY.md", ROOT / "README.md", *(ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    own = re.findall(r"https://[\w./-]*edgegrad[\w./-]*", text)
    assert own and all(url.startswith((known["Source"], known["Documentation"])) for url in own)


@pytest.mark.parametrize(("key", "section"), [("dependencies", "run"), ("requires", "host")])
def test_the_recipe_has_all_requirements(key: str, section: str) -> None:
    listed = loaded("recipe/recipe.yaml")["requirements"][section]
    lacking = {conda(requirement) for requirement in strings(key)} - set(listed)
    assert not lacking, f"recipe/recipe.yaml lacks {sorted(lacking)}"


def test_pythons_are_those_of_the_workflows() -> None:
    """The oldest is required; each that is named runs the tests or, in nightly.yml, the wheel's."""
    (oldest,) = re.findall(r'^requires-python = ">=(.*)"$', PROJECT, re.MULTILINE)
    named = [word.rpartition(" ")[2] for word in strings("classifiers") if re.search(r":: 3\.\d+$", word)]
    flows = "".join(
        (ROOT / ".github" / "workflows" / f"{name}.yml").read_text(encoding="utf-8") for name in ("test", "nightly")
    )
    assert named[0] == oldest and set(named) <= set(re.findall(r"\b3\.\d+\b", flows))


def test_bugs_are_reported_with_what_doctor_says() -> None:
    fields = {field["id"]: field for field in loaded(".github/ISSUE_TEMPLATE/bug.yml")["body"]}
    assert "edgegrad doctor" in fields["doctor"]["attributes"]["label"] and fields["doctor"]["validations"]["required"]
