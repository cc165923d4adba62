"""The calls in the right columns of docs/from.md run, and cameras of redner show the same."""

from __future__ import annotations

import math
import re
from typing import Any

import pytest
import torch
from doc_pages import FENCE, FOLDER

import edgegrad as eg

pytestmark = pytest.mark.unsanitized

ROW = re.compile(r"^\| .* \| (.*) \|$", re.MULTILINE)
PAGE = (FOLDER / "from.md").read_text(encoding="utf-8")
INTRODUCTION, *SECTIONS = re.split(r"^(?=## )", PAGE, flags=re.MULTILINE)


def code_of(text: str) -> list[str]:
    """Return the code of blocks and of the last cells of tables, in the order of the page."""
    found = [(block.start(), [block[2]]) for block in FENCE.finditer(text) if block[1] == "python"]
    found += [(row.start(), re.findall(r"`([^`]+)`", row[1])) for row in ROW.finditer(text)]
    return [source for _, sources in sorted(found) for source in sources]


def names_after(section: str) -> dict[str, Any]:
    torch.manual_seed(0)
    names: dict[str, Any] = {}
    for source in code_of(INTRODUCTION + section):
        try:
            exec(source, names)
        except Exception as error:
            raise AssertionError(f"docs/from.md: {source}") from error
    return names


@pytest.mark.parametrize("section", [pytest.param(text, id=text[3:].split("\n")[0]) for text in SECTIONS])
def test_right_columns_run(section: str) -> None:
    rows = [row for row in ROW.findall(section) if row != "edgegrad"]
    assert len(rows) >= 9 and all("`" in row for row in rows)
    names = names_after(section)
    image, verts = names["image"], names["verts"]
    assert image.shape == (48, 64, 3) and image.amin() < image.amax()
    assert verts.grad is None or bool(verts.grad.any())


def test_a_call_that_does_not_run_is_found() -> None:
    with pytest.raises(AssertionError, match=r"eg\.renders"):
        names_after("| theirs | `eg.renders(verts)` |\n")


def test_cameras_of_redner_show_the_same() -> None:
    """The pose and the rays are those of its C++, `look_at_matrix` and `sample_primary`."""
    names = names_after(next(text for text in SECTIONS if text.startswith("## redner")))
    eye, at, up = (names[name] for name in ("eye", "at", "up"))
    forward = torch.nn.functional.normalize(at - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    axes = torch.stack([right, torch.linalg.cross(right, forward), forward], 1)
    pose = torch.eye(4)
    pose[:3] = torch.cat([axes, eye[:, None]], 1)
    points = torch.rand(20, 3) - 0.5
    x, y, z = ((points - eye) @ axes).unbind(1)
    focal = 32 / math.tan(math.radians(45 / 2))  # half the width over the tangent of half the horizontal field of view
    pixels = torch.stack([32 + focal * x / z, 24 - focal * y / z], 1)
    turned = eg.Camera.from_opengl(pose * torch.tensor([1.0, 1, -1, 1]), names["size"], fov_x=45)
    for camera in (names["camera"], turned):
        assert torch.allclose(camera.project(points), pixels, atol=1e-4)
