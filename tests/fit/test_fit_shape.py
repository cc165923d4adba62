"""fit_shape and fit_texture on an egg and a square."""

import math

import pytest
import torch
from quiet_fits import arranged
from small_scenes import QUIET, ball, egg_views, pictures

import edgegrad as eg
from edgegrad.fit import Refinement, fit_shape, fit_texture


def test_finds_a_texture():
    square = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    uvs = 0.5 + 0.5 * square[:, :2]
    g = torch.Generator().manual_seed(0)
    image = torch.nn.functional.interpolate(torch.rand(1, 3, 6, 6, generator=g), (24, 24), mode="bicubic")
    mesh = eg.Mesh(square, faces, texture=image[0].movedim(0, -1).clamp(0.05, 1.0), uvs=uvs, uv_faces=faces)
    cameras = [eg.Camera.look_at((x, 0.3, 3.0), (0, 0, 0), size=(48, 48)) for x in (-1.0, 0.5, 1.5)]
    bare = eg.Mesh(square, faces, uvs=uvs, uv_faces=faces)
    fit = fit_texture(bare, pictures(mesh, cameras[:2]), cameras[:2], 24, **arranged(steps=80, **QUIET))
    (truth,), (found,) = pictures(mesh, cameras[2:]), pictures(fit.mesh, cameras[2:])
    assert -10.0 * math.log10(float((truth - found).square().mean())) > 30.0
    assert fit.mesh.texture.shape == (24, 24, 3) and float(fit.mesh.texture.min()) >= 0.0


def test_finds_a_shape_from_masks():
    pytest.importorskip("gpytoolbox")
    cameras, masks = egg_views()
    fit = fit_shape(
        ball(1), None, cameras, masks=masks, refinement=Refinement(levels=2, faces=600),
        **arranged(steps=40, mask_loss="l2", **QUIET),
    )  # fmt: skip
    v = fit.mesh.verts - 0.05
    off = ((v / torch.tensor([0.7, 1.1, 0.8])).norm(dim=1) - 1.0).abs()
    assert float(off.mean()) < 0.04, float(off.mean())
    assert 400 < len(fit.mesh.faces) < 900 and fit.steps <= 80
    assert [record.step for record in fit.history] == list(range(fit.steps))


def test_a_shape_that_cannot_be_remeshed_is_refused_before_the_first_level():
    pytest.importorskip("gpytoolbox")
    cameras, masks = egg_views()
    mesh = ball(1)
    fin = torch.cat([mesh.faces[0, :2], torch.tensor([len(mesh.verts)])])[None]
    finned = eg.Mesh(torch.cat([mesh.verts, mesh.verts[:1] * 2]), torch.cat([mesh.faces, fin]))
    with pytest.raises(ValueError, match=r"mesh: expected no more than two triangles at each edge, .* got 1 edges"):
        fit_shape(finned, None, cameras, masks=masks, refinement=Refinement(levels=2), **arranged(steps=2, **QUIET))
    assert (
        fit_shape(
            finned, None, cameras, masks=masks, refinement=Refinement(levels=1), **arranged(steps=2, **QUIET)
        ).steps
        == 2
    )


def test_colours_without_an_appearance_are_named():
    cameras, masks = egg_views()
    mesh = ball(1).replace(face_colors=torch.full((len(ball(1).faces), 1), 0.5))
    images = [mask.reshape(*mask.shape[:2], 1).expand(-1, -1, 3) for mask in masks]
    with pytest.warns(UserWarning, match="mesh: expected bare vertices and faces, got colours.*appearance="):
        fit_shape(mesh, images, cameras, refinement=Refinement(levels=1), **arranged(steps=1, **QUIET))
