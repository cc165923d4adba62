"""profile(): how long each part of a step takes, and from how many samples."""

from __future__ import annotations

import importlib

import pytest
import torch
from planned_scenes import CAMERA, creased, requiring
from scenes import cube, icosphere

import edgegrad as eg
from edgegrad.kernel import operators


def test_profile():
    scene, camera = requiring(creased(), CAMERA, ("verts", "colors"))
    found = eg.profile(scene, camera, spp=4, repeats=3)
    assert list(found)[:2] == ["update", "forward"] and list(found)[-1] == "python"
    assert all(
        (seconds > 0) == (not name.startswith("discontinuity ")) for name, seconds in found.items()
    )  # no face has discontinuities
    assert found.seconds == pytest.approx(sum(found.values()))
    planned = eg.plan(scene, camera, 4)
    assert found.samples["image_samples"] == planned["image"].samples
    assert planned["boundary"].samples / 4 < found.samples["edge_samples"] <= planned["boundary"].samples
    assert 0 < found.samples["surface_samples"] <= planned["interior"].samples
    lines = str(found).splitlines()
    assert len(lines) == len(found) + 3 and "█" in str(found) and "edge samples" in lines[-1]
    with pytest.raises(KeyError, match=r"update, forward.*'shadows'"):
        found["shadows"]


def test_profile_of_what_requires_no_gradient_is_that_of_the_vertices():
    vertices = eg.profile(requiring(cube(), CAMERA, ("verts",))[0], CAMERA, repeats=1).samples
    assert eg.profile(cube(), CAMERA, repeats=1).samples == vertices
    with torch.no_grad():
        assert eg.profile(*requiring(cube(), CAMERA, ("colors",)), repeats=1).samples == vertices
    assert eg.profile(*requiring(cube(), CAMERA, ("colors",)), repeats=1)["curves"] == 0


def test_profile_rebuilds_for_every_repeat(monkeypatch):
    """Once elsewhere, once where the vertices are."""
    built = []

    def forward_kernel(request):
        output = operators.forward_kernel(request)
        built.append(bool(output[2][0]["built rays"]))
        return output

    monkeypatch.setattr(importlib.import_module("edgegrad.profile"), "forward_kernel", forward_kernel)
    eg.profile(icosphere(3), CAMERA, spp=1, repeats=3)
    assert built == [True] * 6


def test_profile_of_a_lit_scene():
    light = eg.lights.PointLight(torch.tensor([1.0, 2.0, 4.0]))
    mesh = cube(0.5).replace(material=eg.Material(), face_colors=None)
    scene = eg.Scene([mesh, mesh.transformed(t=torch.tensor([0.5, 1.0, 2.0]), scale=0.2)], lights=[light])
    found = eg.profile(scene, CAMERA, spp=4, repeats=2)
    assert list(found) == [
        "image",
        "samples",
        "surface shading",
        "edge shading",
        "discontinuities",
        "shadows",
        "backward",
        "python",
    ]
    assert all((seconds > 0) == (name != "discontinuities") for name, seconds in found.items())
    assert found.samples["image_samples"] == eg.plan(scene, CAMERA, 4)["image"].samples
    assert min(found.samples[name] for name in ("surface_samples", "edge_samples", "shadow_samples")) > 0
    unshadowed = eg.profile(scene, CAMERA, spp=4, repeats=1, shadows=False).samples
    assert "shadow_samples" not in unshadowed and unshadowed["edge_samples"] == found.samples["edge_samples"]
    lit = scene.replace(lights=[light.replace(intensity=torch.ones((), requires_grad=True))])
    still = eg.profile(lit, CAMERA, spp=4, repeats=1)
    assert "edge_samples" not in still.samples and still["edge shading"] == 0 and still["backward"] > 0
    with pytest.raises(ValueError, match="adjoint"):
        eg.profile(scene, CAMERA, torch.ones(2, 2, 3))


def test_profile_of_bounces_has_the_rows_of_indirect_light():
    mesh = cube(0.5).replace(material=eg.Material(), face_colors=None)
    scene = eg.Scene(
        [mesh, mesh.transformed(t=torch.tensor([0.5, 1.0, 2.0]), scale=0.2)],
        lights=[eg.lights.Environment(torch.ones(3))],
    )
    found = eg.profile(scene, CAMERA, spp=1, repeats=1, bounces=2)
    assert list(found)[-4:] == ["indirect shadows", "secondary edges", "backward", "python"]
    assert found["indirect shadows"] > 0 and found["secondary edges"] > 0
    assert list(eg.profile(scene, CAMERA, spp=1, repeats=1))[-3:] == ["shadows", "backward", "python"]
    dark = eg.profile(scene, CAMERA, spp=1, repeats=1, bounces=2, shadows=False)
    assert "indirect shadows" not in dark and "secondary edges" in dark


def test_profile_of_mipmaps():
    mesh = eg.Mesh(
        cube().verts, cube().faces, texture=torch.rand(8, 8, 3), uvs=cube().verts[:, :2], uv_faces=cube().faces
    )
    found = eg.profile(mesh.replace(filter="mipmap"), CAMERA, spp=1, repeats=1)
    assert found["surface shading"] > 0 and found["shadows"] < found["surface shading"]
